"""URDF: as gym-pybullet-drones writes it, with a tag `properties`, or with the motor models of Gazebo."""

import math
import re

from flytune.errors import BadInput
from flytune.physics.found_vehicle import FoundVehicle
from flytune.physics.rotors import X_SIDES
from flytune.simulation.reading import gazebo_motors
from flytune.simulation.reading.bodies import INERTIA, Body, Pose, inertia_matrix
from flytune.simulation.reading.markup import Element, number, numbers
from flytune.simulation.reading.rotors import Rotor, check_four, frame_tables, rotor_frame

PROPERTIES = {  # attribute -> field of a vehicle
    "kf": "thrust_coefficient",
    "km": "torque_coefficient",
    "kf_linear": "thrust_linear",
    "km_linear": "torque_linear",
    "min_rpm": "minimum_rotor_speed_rpm",
    "thrust2weight": "thrust_to_weight",
    "prop_radius": "propeller_radius",
    "gnd_eff_coeff": "ground_effect",
}
DRAG = ("drag_coeff_xy", "drag_coeff_z")
SPINS = (-1, 1, -1, 1)  # gym-pybullet-drones, BaseAviary: torque about z of motors 0 to 3
PROPELLER = re.compile(r"(?:prop(?:eller)?|rotor|motor)_?(\d+)(?:_link)?")
MOTORS = "a tag <properties kf= km= ...> as in gym-pybullet-drones, or the motor models of Gazebo"


def read_urdf(root: Element, file: str) -> FoundVehicle:
    """The vehicle of a URDF file.

    Args:
        root: the element `robot`.
        file: the file's name, for messages and sources.

    Raises:
        BadInput: no motors, other than four rotors, or what no vehicle has.
    """
    frames = link_frames(root, file)
    bodies = [
        body for link in root.iter("link") if (body := _body(link, frames[link.get("name", "")], file)) is not None
    ]
    plugins = [plugin for plugin in root.iter("plugin") if gazebo_motors.is_motor(plugin)]
    properties = root.find("properties")
    if plugins:
        return _with_motor_models(root, file, frames, bodies, plugins)
    if properties is None or properties.get("kf") is None:
        raise BadInput(f"{file}: has no motors. Missing: {MOTORS}.")
    return _with_properties(root, properties, file, frames, bodies)


def link_frames(root: Element, file: str) -> dict[str, Pose]:
    """The frame of each link, from that of the link at the root.

    Raises:
        BadInput: the joints do not make one tree of the links.
    """
    names = [link.get("name", "") for link in root.iter("link")]
    above: dict[str, tuple[str, Pose]] = {}
    for joint in root.iter("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is None or child is None:
            continue  # of a transmission, which names a joint
        ends = parent.get("link", ""), child.get("link", "")
        if not set(ends) <= set(names) or ends[1] in above:
            raise BadInput(f"{file}: joint {joint.get('name')!r}: does not join two links of the file as a tree.")
        above[ends[1]] = (ends[0], _origin(joint, f"{file}: joint {joint.get('name')!r}"))
    roots = [name for name in names if name not in above]
    if len(roots) != 1 or len(set(names)) != len(names):
        raise BadInput(f"{file}: its {len(names)} links are no tree. Allowed: links with joints, and one at the root.")
    frames = {roots[0]: Pose()}
    waiting = dict(above)
    while ready := [name for name, (parent, _) in waiting.items() if parent in frames]:
        for name in ready:
            parent, origin = waiting.pop(name)
            frames[name] = frames[parent] @ origin
    if waiting:
        raise BadInput(f"{file}: links {sorted(waiting)} hang on each other. Allowed: links with joints as a tree.")
    return frames


def _origin(element: Element, where: str) -> Pose:
    origin = element.find("origin")
    if origin is None:
        return Pose()
    return Pose.of(
        numbers(origin.get("xyz", "0 0 0"), 3, f"{where}: origin xyz"),
        numbers(origin.get("rpy", "0 0 0"), 3, f"{where}: origin rpy"),
    )


def _body(link: Element, frame: Pose, file: str) -> Body | None:
    inertial = link.find("inertial")
    if inertial is None:
        return None
    where = f"{file}: link {link.get('name')!r}"
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    value = number(None if mass is None else mass.get("value"), f"{where}: mass")
    if value < 0:
        raise BadInput(f"{where}: mass: {value:g} is not allowed. Allowed: 0 or more kg.")
    parts = {
        name: number(inertia.get(name, "0"), f"{where}: inertia {name}") if inertia is not None else 0.0
        for name in INERTIA
    }
    return Body(value, frame @ _origin(inertial, where), inertia_matrix(parts))


def _with_properties(
    root: Element, properties: Element, file: str, frames: dict[str, Pose], bodies: list[Body]
) -> FoundVehicle:
    """The vehicle of gym-pybullet-drones."""
    used = {*PROPERTIES, *DRAG, "arm"}
    given = {name: number(text, f"{file}: properties {name}") for name, text in properties.items() if name in used}
    places, source, notes = _places(root, given.get("arm", 0.0), file, frames)
    spins, told = _spins(root, properties, file, [place for _, place in places])
    rotors = [Rotor(name, place, spin) for (name, place), spin in zip(places, spins, strict=True)]
    notes = [*notes, *told]
    table, more = frame_tables(file, bodies, rotors)
    sources = {
        **dict.fromkeys(("mass", "inertia", "products_of_inertia"), f"{file}, inertial of all links"),
        **dict.fromkeys(("arm", "rotors"), f"{source}; spins as gym-pybullet-drones has them" if told else source),
    }
    for name, field in PROPERTIES.items():
        if name in given:
            table[field], sources[field] = given[name], f"{file}, properties {name}"
    if any(name in given for name in DRAG):
        across, along = (given.get(name, 0.0) for name in DRAG)
        table["rotor_drag"] = [across, across, along]
        sources["rotor_drag"] = f"{file}, properties drag_coeff_xy and drag_coeff_z"
    if unused := set(properties.keys()) - used - {"spin"}:
        notes.append(f"properties {', '.join(sorted(unused))}: flytune has no such number")
    return FoundVehicle(file, table, sources, (*notes, *more))


def _places(
    root: Element, arm: float, file: str, frames: dict[str, Pose]
) -> tuple[list[tuple[str, Pose]], str, list[str]]:
    """Name and frame of each rotor, where they come from, and notes.

    They are the links prop0 to prop3 of gym-pybullet-drones, the shapes of this name that flytune writes, or, where
    there are none, the ends of the arm in x configuration.
    """
    found: dict[int, tuple[str, Pose]] = {}
    for link in root.iter("link"):
        name = link.get("name", "")
        if match := PROPELLER.fullmatch(name):
            inertial = link.find("inertial")
            inner = Pose() if inertial is None else _origin(inertial, f"{file}: link {name!r}")
            found[int(match[1])] = (f"link {name!r}", frames[name] @ inner)
        for shape in link.iter("visual"):
            if match := PROPELLER.fullmatch(shape.get("name", "")):
                where = f"shape {shape.get('name')!r}"
                found.setdefault(int(match[1]), (where, frames[name] @ _origin(shape, f"{file}: {where}")))
    if not found and arm > 0:
        side = arm / math.sqrt(2)
        ends = [(f"motor {index}", rotor_frame([side * x, side * y, 0])) for index, (x, y) in enumerate(X_SIDES)]
        return ends, f"{file}, properties arm, in x configuration", []
    check_four(list(found), file, "links named prop0, prop1, ...")
    places = [found[index] for index in sorted(found)]
    reach = max(math.hypot(*place.position[:2]) for _, place in places)
    notes = []
    if arm and abs(arm - reach) > 1e-6 * reach:
        notes.append(f"properties arm {arm:g} m is not used; the links place the rotors {reach:.6g} m out")
    return places, f"{file}, {places[0][0]} to {places[-1][0]}", notes


def _spins(root: Element, properties: Element, file: str, places: list[Pose]) -> tuple[tuple[int, ...], list[str]]:
    """The spins, and a note where the file does not give them; 0 where those of gym-pybullet-drones cannot be meant."""
    if (text := properties.get("spin")) is not None:
        given = numbers(text, 4, f"{file}: properties spin")
        if not set(given) <= {-1, 1}:
            raise BadInput(f"{file}: properties spin: {text!r} is not allowed. Allowed: four times 1 or -1.")
        return tuple(int(spin) for spin in given), []
    is_racer = root.get("name") == "racer"
    spins = tuple(-spin for spin in SPINS) if is_racer else SPINS
    around = [math.atan2(place.position[1], place.position[0]) for place in places]
    order = [index for _, index in sorted(zip(around, range(4), strict=True))]
    if any(spins[one] == spins[other] for one, other in zip(order, order[1:] + order[:1], strict=True)):
        return (0, 0, 0, 0), []
    return spins, [
        "the spins are not in the file; they are those with which gym-pybullet-drones flies "
        f"{'its racer' if is_racer else 'it'}: {list(spins)}; look at the propellers"
    ]


def _with_motor_models(
    root: Element, file: str, frames: dict[str, Pose], bodies: list[Body], plugins: list[Element]
) -> FoundVehicle:
    """The vehicle of RotorS and PX4."""
    motors = gazebo_motors.motors(plugins, file)
    check_four(motors, file, "motor models")
    for motor in motors:
        if motor.link not in frames:
            raise BadInput(f"{file}: motor {motor.number}: linkName: there is no link {motor.link!r}.")
    rotors = [Rotor(f"link {motor.link!r}", frames[motor.link], motor.spin) for motor in motors]
    table, notes = frame_tables(file, bodies, rotors)
    values, sources, more = gazebo_motors.motor_tables(motors, file)
    radius = _radius([link for link in root.iter("link") if link.get("name") in {motor.link for motor in motors}], file)
    if radius:
        values["propeller_radius"] = radius
    sources |= {
        **dict.fromkeys(("mass", "inertia", "products_of_inertia"), f"{file}, inertial of all links"),
        **dict.fromkeys(("arm", "rotors"), f"{file}, joints of the rotors; turningDirection"),
        "propeller_radius": f"{file}, shape of the rotors",
    }
    return FoundVehicle(file, table | values, sources, (*notes, *more))


def _radius(links: list[Element], file: str) -> float:
    """The radius of the cylinders that the rotors are, or 0."""
    cylinders = [cylinder for link in links for cylinder in link.iter("cylinder")]
    return max((number(each.get("radius"), f"{file}: cylinder radius") for each in cylinders), default=0.0)
