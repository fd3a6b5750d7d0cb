"""MJCF: compiled by MuJoCo, read from what it compiled: masses, inertias, sites, and the actuators on them."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from flytune.errors import BadInput, require
from flytune.physics.found_vehicle import TO_MEASURE, FoundVehicle
from flytune.simulation.reading import markup
from flytune.simulation.reading.bodies import Body, Pose, combined
from flytune.simulation.reading.rotors import Rotor, check_four, frame_tables

ROTORS = 'four sites, each with an actuator <motor site=... gear="0 0 1 0 0 k">, k the torque over thrust in m'
SMALL = 1e-9


@dataclasses.dataclass(frozen=True)
class Actuator:
    """An actuator on a site: force and torque for a control of 1, in the frame of the vehicle, and its limits."""

    name: str
    site: int
    force: np.ndarray
    torque: np.ndarray
    largest: float  # infinite where it is not limited
    lag: float  # s, 0 where it has none


def read_mjcf(path: Path) -> FoundVehicle:
    """The vehicle of an MJCF file.

    Raises:
        BadInput: MuJoCo is not installed or cannot compile the file, or the file has no four rotors.
    """
    mujoco = require("mujoco", "mujoco")
    file = markup.short_name(path)
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, RuntimeError) as error:
        raise BadInput(
            f"{path}: MuJoCo cannot compile it: {' '.join(str(error).split()).rstrip('.')}. Files that it "
            "names have to lie where it says."
        ) from None
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    sited = [
        index
        for index in range(model.nu)
        if int(model.actuator_trntype[index]) == int(mujoco.mjtTrn.mjTRN_SITE) and model.actuator_trnid[index, 1] < 0
    ]
    if not sited:
        raise BadInput(f"{path}: has no motors: {model.nu} actuators, none on a site. Missing: {ROTORS}.")
    roots = {int(model.body_rootid[model.site_bodyid[model.actuator_trnid[index, 0]]]) for index in sited}
    if len(roots) != 1:
        raise BadInput(f"{path}: has {len(roots)} vehicles with motors. Allowed: one.")
    root = roots.pop()
    base = Pose(data.xpos[root].copy(), data.xmat[root].reshape(3, 3).copy()).inverse()
    actuators = [_actuator(mujoco, model, data, base, index) for index in sited]
    pushing = [each for each in actuators if abs(each.force[2]) > SMALL]
    frames = {each.site: base @ _site(data, each.site) for each in actuators}
    lifting = _apart_from_centre(pushing, frames, bodies := _bodies(model, data, base, root))
    _check_rotors(file, lifting, [each for each in actuators if each not in lifting])
    ratios = [_ratio(each) for each in lifting]
    rotors = [
        Rotor(each.name, Pose(frames[each.site].position, _along(each.force)), int(np.sign(ratio)))
        for each, ratio in zip(lifting, ratios, strict=True)
    ]
    table, notes = frame_tables(file, bodies, rotors)
    values, sources, hints = _numbers(file, model, table["mass"], lifting, ratios)
    if radius := _radius(mujoco, model, data, lifting):
        values["propeller_radius"] = radius
    sources |= {
        **dict.fromkeys(("mass", "inertia", "products_of_inertia"), f"{file}, all bodies of the vehicle together"),
        **dict.fromkeys(
            ("arm", "rotors"), f"{file}, sites of the actuators" + ("; sign of gear" if all(ratios) else "")
        ),
        "propeller_radius": f"{file}, shape at the rotors",
    }
    unread = [each.name for each in actuators if each not in lifting]
    if unread:
        notes.append(f"actuators {', '.join(unread)} are not read")
    if model.opt.density or model.opt.viscosity:
        notes.append("the drag that MuJoCo computes from density, viscosity and shapes is not read")
    return FoundVehicle(file, table | values, sources, tuple(notes), hints)


def _site(data: Any, site: int) -> Pose:
    return Pose(data.site_xpos[site].copy(), data.site_xmat[site].reshape(3, 3).copy())


def _actuator(mujoco: Any, model: Any, data: Any, base: Pose, index: int) -> Actuator:
    site = int(model.actuator_trnid[index, 0])
    turn = (base @ _site(data, site)).rotation
    gear = model.actuator_gear[index]
    gain = float(model.actuator_gainprm[index, 0])
    limits = [np.inf]
    if model.actuator_ctrllimited[index]:
        limits.append(float(model.actuator_ctrlrange[index, 1]))
    if model.actuator_forcelimited[index] and gain:
        limits.append(float(model.actuator_forcerange[index, 1]) / gain)
    filters = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
    lag = float(model.actuator_dynprm[index, 0]) if int(model.actuator_dyntype[index]) in filters else 0.0
    name = model.actuator(index).name or f"actuator {index}"
    return Actuator(name, site, gain * turn @ gear[:3], gain * turn @ gear[3:6], min(limits), lag)


def _apart_from_centre(pushing: list[Actuator], frames: dict[int, Pose], bodies: list[Body]) -> list[Actuator]:
    """Those that push, without one at the centre of mass where four others are: it is no rotor, but a force."""
    mass = sum(body.mass for body in bodies)
    if len(pushing) <= 4 or not mass > 0:
        return pushing
    centre = combined(bodies)[1]
    away = [float(np.linalg.norm(frames[each.site].position[:2] - centre[:2])) for each in pushing]
    return [each for each, distance in zip(pushing, away, strict=True) if distance > 1e-6 * max(away)]


def _check_rotors(file: str, lifting: list[Actuator], others: list[Actuator]) -> None:
    """Refuse a wrench on the whole body in place of rotors, other than four rotors, and two at one place."""
    if not lifting:
        raise BadInput(f"{file}: has no motors: no actuator pushes along z. Missing: {ROTORS}.")
    if len(lifting) < 4 and len(others) > 1:
        names = ", ".join(each.name for each in (*lifting, *others))
        raise BadInput(
            f"{file}: has thrust and torques of the whole body ({names}) in place of rotors. Missing: {ROTORS}."
        )
    check_four(lifting, file, "actuators that push along z")
    if len({each.site for each in lifting}) != len(lifting):
        raise BadInput(f"{file}: two actuators push on one site. Allowed: one that pushes, for each rotor.")


def _along(force: np.ndarray) -> np.ndarray:
    """A rotation whose z axis lies along a force; only its z axis counts."""
    upward = force / np.linalg.norm(force)
    across = np.linalg.svd(upward[None])[2][1:]
    return np.column_stack([*across, upward])


def _ratio(actuator: Actuator) -> float:
    """Torque over thrust in m, above 0 where the propeller turns clockwise; 0 where the actuator gives no torque."""
    return float(actuator.torque @ actuator.force / (actuator.force @ actuator.force))


def _bodies(model: Any, data: Any, base: Pose, root: int) -> list[Body]:
    """All bodies that move with the root, in its frame."""
    return [
        Body(
            float(model.body_mass[body]),
            base @ Pose(data.xipos[body].copy(), data.ximat[body].reshape(3, 3).copy()),
            np.diag(model.body_inertia[body]),
        )
        for body in range(model.nbody)
        if body and model.body_rootid[body] == root
    ]


def _numbers(
    file: str, model: Any, mass: float, lifting: list[Actuator], ratios: list[float]
) -> tuple[dict[str, Any], dict[str, str], dict[str, str]]:
    """What the actuators and options tell: fields, their sources, and hints for what they do not tell."""
    table: dict[str, Any] = {}
    sources: dict[str, str] = {}
    hints: dict[str, str] = {}
    gravity = float(-model.opt.gravity[2])
    if gravity > 0:
        table["gravity"], sources["gravity"] = gravity, f"{file}, option gravity"
    full = [float(np.linalg.norm(each.force)) * each.largest for each in lifting]
    if np.isfinite(full).all() and min(full) > 0:
        _check_alike(file, "largest thrust in N", full)
        table["thrust_to_weight"] = sum(full) / (mass * table.get("gravity", 9.81))
        sources["thrust_to_weight"] = f"{file}, ctrlrange: {full[0]:g} N for each rotor"
    if lag := [each.lag for each in lifting if each.lag]:
        _check_alike(file, "time constant in s", [each.lag for each in lifting])
        table |= dict.fromkeys(("motor_rise_time_constant", "motor_fall_time_constant"), lag[0])
        sources |= dict.fromkeys(
            ("motor_rise_time_constant", "motor_fall_time_constant"), f"{file}, dynprm, a lag of the thrust"
        )
    sizes = [abs(ratio) for ratio in ratios]
    _check_alike(file, "torque over thrust in m", sizes)
    if sizes[0]:
        hints["torque_coefficient"] = f"{sizes[0]:g} m times thrust_coefficient ({file}, gear)"
    hints["thrust_coefficient"] = f"the file gives thrust, not rotor speeds; {TO_MEASURE['thrust_coefficient']}"
    return table, sources, hints


def _check_alike(file: str, what: str, values: list[float]) -> None:
    if max(values) - min(values) > 1e-6 * max(values):
        shown = ", ".join(f"{value:g}" for value in values)
        raise BadInput(f"{file}: {what}: the rotors differ: {shown}. Allowed: the same for all rotors.")


def _radius(mujoco: Any, model: Any, data: Any, lifting: list[Actuator]) -> float:
    """The radius of the flat cylinders or ellipsoids that stand at the sites of the rotors, or 0."""
    thickness = {int(mujoco.mjtGeom.mjGEOM_CYLINDER): 1, int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): 2}  # where size has it
    found = []
    for geom in range(model.ngeom):
        kind, size = int(model.geom_type[geom]), model.geom_size[geom]
        near = min(np.linalg.norm(data.geom_xpos[geom] - data.site_xpos[each.site]) for each in lifting)
        if kind in thickness and max(near, size[thickness[kind]]) < 0.5 * size[0]:
            found.append(float(size[0]))
    return max(found, default=0.0)
