"""SDF of Gazebo: links with poses and inertias, models that include others, and motor models."""

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

from scipy.spatial.transform import Rotation

from flytune.errors import BadInput
from flytune.physics.found_vehicle import FoundVehicle
from flytune.simulation.reading import gazebo_motors, markup
from flytune.simulation.reading.bodies import INERTIA, Body, Pose, inertia_matrix
from flytune.simulation.reading.markup import Element, number, numbers
from flytune.simulation.reading.rotors import Rotor, check_four, frame_tables

DEEPEST = 8  # models that include each other
MODEL = "__model__"


@dataclasses.dataclass
class Contents:
    """The links and motors of a model and of those that it includes; names carry the models they are in."""

    links: dict[str, tuple[Element, Pose]] = dataclasses.field(default_factory=dict)
    motors: list[tuple[str, Element]] = dataclasses.field(default_factory=list)
    absent: list[str] = dataclasses.field(default_factory=list)  # what is said of included models that are not there


def read_sdf(root: Element, path: Path) -> FoundVehicle:
    """The vehicle of an SDF file.

    Args:
        root: the element `sdf`.
        path: the file; what it includes is looked for beside its folder.

    Raises:
        BadInput: no motors, other than four rotors, a model that is not there, or what no vehicle has.
    """
    file = markup.short_name(path)
    contents = [_contents(model, path, 0) for model in _models(root)]
    flying = [each for each in contents if each.motors]
    if len(flying) != 1:
        what = f"has {len(flying)} models with motors" if flying else "has no motors"
        absent = "; ".join(line for each in contents for line in each.absent)
        raise BadInput(
            f"{path}: {what}. Allowed: one model with motor models of Gazebo, gz-sim-multicopter-motor-model or "
            f"gazebo_motor_model, one for each rotor.{f' Of what it includes, {absent}.' if absent else ''}"
        )
    model = flying[0]
    motors = gazebo_motors.motors([plugin for _, plugin in model.motors], file)
    check_four(motors, file, "motor models")
    scopes = {id(plugin): scope for scope, plugin in model.motors}
    names = [_link_of(motor, scopes[id(motor.plugin)], model, file) for motor in motors]
    rotors = [
        Rotor(f"link {name!r}", model.links[name][1], motor.spin) for name, motor in zip(names, motors, strict=True)
    ]
    bodies, notes = [], [f"{line}; its mass is not counted" for line in model.absent]
    for name, (link, frame) in model.links.items():
        body, note = _body(name, link, frame, file)
        bodies += [body] if body else []
        notes += note
    table, more = frame_tables(file, bodies, rotors)
    values, sources, others = gazebo_motors.motor_tables(motors, file)
    if radius := max((_radius(model.links[name][0], file) for name in names), default=0.0):
        values["propeller_radius"] = radius
    sources |= {
        **dict.fromkeys(
            ("mass", "inertia", "products_of_inertia"), f"{file}, inertial of {len(bodies)} links together"
        ),
        **dict.fromkeys(("arm", "rotors"), f"{file}, poses of the links {', '.join(names)}; turningDirection"),
        "propeller_radius": f"{file}, shape of the rotors",
    }
    return FoundVehicle(file, table | values, sources, (*notes, *more, *others))


def _models(root: Element) -> list[Element]:
    """The models of a file, or of the worlds in it."""
    return [*root.findall("model"), *root.findall("world/model")]


def _contents(model: Element, path: Path, depth: int) -> Contents:
    """The links and motors of a model, in its own frame."""
    if depth > DEEPEST:
        raise BadInput(
            f"{path}: includes models more than {DEEPEST} deep. Allowed: models that do not include themselves."
        )
    made = Contents()
    frames = _Frames(model, markup.short_name(path))
    parts = [*((part, True) for part in model.findall("include")), *((part, False) for part in model.findall("model"))]
    for part, is_include in parts:
        inner_path = _included(part, path) if is_include else path
        if isinstance(inner_path, str):
            made.absent.append(inner_path)
            continue
        inner = _model_in(inner_path) if is_include else part
        pose = part if part.find("pose") is not None else inner
        frame = frames.placed(pose)
        name = (part.findtext("name") or inner.get("name") or "").strip()
        scope = "" if part.get("merge") == "true" else f"{name}::"
        contents = _contents(inner, inner_path, depth + 1)
        made.links |= {f"{scope}{link}": (each, frame @ place) for link, (each, place) in contents.links.items()}
        made.motors += [(f"{scope}{outer}", plugin) for outer, plugin in contents.motors]
        made.absent += contents.absent
        frames.known |= {f"{scope}{link}": frame @ place for link, (_, place) in contents.links.items()}
    for link in model.findall("link"):
        name = link.get("name", "")
        made.links[name] = (link, frames.of(name))
    made.motors += [("", plugin) for plugin in model.findall("plugin") if gazebo_motors.is_motor(plugin)]
    return made


class _Frames:
    """The frames that a model names, each found when it is asked for."""

    def __init__(self, model: Element, file: str):
        self.file = file
        self.known: dict[str, Pose] = {MODEL: Pose(), "": Pose()}
        self.elements = {each.get("name", ""): each for kind in ("link", "frame") for each in model.findall(kind)}
        self.elements |= {
            each.get("name", ""): each for each in model.findall("joint") if each.get("name") not in self.elements
        }
        self.asked: list[str] = []

    def of(self, name: str) -> Pose:
        """A named frame in that of the model."""
        if name in self.known:
            return self.known[name]
        if name not in self.elements or name in self.asked:
            raise BadInput(f"{self.file}: pose: {name!r} is no frame that it can be relative to.")
        self.asked.append(name)
        self.known[name] = self.placed(self.elements[name])
        return self.known[name]

    def placed(self, element: Element) -> Pose:
        """The frame of an element in that of the model, from its `pose`."""
        pose = element.find("pose")
        usual = element.findtext("child") if element.tag == "joint" else element.get("attached_to")
        relative = (pose.get("relative_to") if pose is not None else None) or usual or MODEL
        return self.of(relative.strip()) @ _pose(pose, self.file)


def _pose(pose: Element | None, file: str) -> Pose:
    if pose is None or not (pose.text or "").strip():
        return Pose()
    if pose.get("rotation_format") == "quat_xyzw":
        values = numbers(pose.text, 7, f"{file}: pose")
        if not any(values[3:]):
            raise BadInput(f"{file}: pose: {(pose.text or '').strip()!r} has a quaternion of 0. Allowed: any other.")
        frame = Pose.of(values[:3])
        return Pose(frame.position, Rotation.from_quat(values[3:]).as_matrix())
    values = numbers(pose.text, 6, f"{file}: pose")
    angles = [math.radians(angle) for angle in values[3:]] if pose.get("degrees") == "true" else values[3:]
    return Pose.of(values[:3], angles)


def _included(include: Element, path: Path) -> Path | str:
    """The file of an included model, `model://NAME` being the folder NAME beside that of the file; or what is amiss."""
    uri = (include.findtext("uri") or "").strip()
    name = uri.removeprefix("model://").rstrip("/")
    if not name or "/" in name or "\\" in name or name in (".", "..") or ":" in name:
        return f"the model {uri!r} is not read; only model://NAME is, a folder beside that of the file"
    folders = [folder / name for folder in (path.resolve().parent.parent, path.resolve().parent)]
    for folder in folders:
        for candidate in _candidates(folder, name):
            if candidate.is_file():
                return candidate
    return f"the model {uri!r} is not there; its folder has to be {folders[0]}"


def _candidates(folder: Path, name: str) -> Iterator[Path]:
    """Where the model of a folder may be: the file that model.config names last, or one of the usual names."""
    config = folder / "model.config"
    if config.is_file():
        named = [(each.text or "").strip() for each in markup.parse(config).iter("sdf")]
        yield from (folder / each for each in reversed(named) if each and "/" not in each)
    yield from (folder / "model.sdf", folder / f"{name}.sdf")


def _model_in(path: Path) -> Element:
    models = _models(markup.parse(path))
    if len(models) != 1:
        raise BadInput(f"{path}: has {len(models)} models. Allowed: one, as it is included.")
    return models[0]


def _link_of(motor: gazebo_motors.Motor, scope: str, model: Contents, file: str) -> str:
    """The name of the link that a motor turns."""
    for name in (f"{scope}{motor.link}", motor.link):
        if name in model.links:
            return name
    absent = f" Of what it includes, {'; '.join(model.absent)}." if model.absent else ""
    raise BadInput(f"{file}: motor {motor.number}: linkName: there is no link {motor.link!r}.{absent}")


def _body(name: str, link: Element, frame: Pose, file: str) -> tuple[Body | None, list[str]]:
    where = f"{file}: link {name!r}"
    inertial = link.find("inertial")
    if inertial is None or inertial.find("mass") is None:
        return None, [f"link {name!r} gives no mass and counts as 0 kg, where Gazebo takes 1 kg"]
    mass = number(inertial.findtext("mass"), f"{where}: mass")
    if mass < 0:
        raise BadInput(f"{where}: mass: {mass:g} is not allowed. Allowed: 0 or more kg.")
    inertia = inertial.find("inertia")
    notes = [] if inertia is not None else [f"link {name!r} gives no inertia and counts as a point"]
    parts = {
        part: number(inertia.findtext(part), f"{where}: {part}")
        for part in INERTIA
        if inertia is not None and inertia.find(part) is not None
    }
    return Body(mass, frame @ _pose(inertial.find("pose"), file), inertia_matrix(parts)), notes


def _radius(link: Element, file: str) -> float:
    """The radius of the cylinder, or half of the longest side of the box, that a rotor is; 0 where it is none."""
    for shape in (*link.iterfind("collision/geometry/*"), *link.iterfind("visual/geometry/*")):
        if shape.tag == "cylinder" and shape.find("radius") is not None:
            return number(shape.findtext("radius"), f"{file}: radius")
        if shape.tag == "box" and shape.find("size") is not None:
            return max(numbers(shape.findtext("size"), 3, f"{file}: size")) / 2
    return 0.0
