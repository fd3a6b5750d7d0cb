"""Rotors of a model file: four of them, upright, about the centre of mass, as the tables of a vehicle."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from flytune.errors import BadInput
from flytune.physics.found_vehicle import TO_MEASURE
from flytune.physics.rotors import X_SIDES, X_SPINS
from flytune.simulation.reading.bodies import Body, Pose, combined

UPRIGHT = 0.9986  # cosine of 3 degrees: thrust of a rotor that leans more is not along the body's z axis
OFF_CENTRE = 0.1  # of the reach: farther from the centre of mass the middle of the rotors cannot lie


@dataclasses.dataclass(frozen=True)
class Rotor:
    """A rotor: its frame in the model, thrust along its z axis, and its spin, 1 for clockwise; 0 where not known."""

    name: str
    frame: Pose
    spin: int


def check_four(rotors: Sequence[Any], file: str, what: str) -> None:
    """Refuse another number of rotors than four.

    Raises:
        BadInput: there are more, or fewer.
    """
    if len(rotors) != 4:
        raise BadInput(f"{file}: has {len(rotors)} {what}. Allowed: four rotors.")


def frame_tables(file: str, bodies: Sequence[Body], rotors: Sequence[Rotor]) -> tuple[dict[str, Any], list[str]]:
    """Mass, inertia and rotors as the tables of a vehicle, and notes for the user.

    The bodies move as one, about their common centre of mass, which is the origin of the places.

    Args:
        file: the name of the file, for messages.
        bodies: all that has a mass, in the frame of the model: x forward, y left, z up.
        rotors: four, in the order of the actions.

    Raises:
        BadInput: no mass, or a rotor that leans, or rotors whose middle is not at the centre of mass.
    """
    if not sum(body.mass for body in bodies) > 0:
        raise BadInput(f"{file}: has no mass. Allowed: a mass above 0 kg, {TO_MEASURE['mass']}.")
    mass, centre, inertia = combined(bodies)
    for rotor in rotors:
        lean = rotor.frame.rotation[2, 2]
        if lean < UPRIGHT:
            angle = np.degrees(np.arccos(np.clip(lean, -1, 1)))
            raise BadInput(
                f"{file}: {rotor.name} leans by {angle:.3g} deg. Allowed: rotors whose thrust is along the z axis of "
                "the body, within 3 deg."
            )
    places = np.array([rotor.frame.position[:2] - centre[:2] for rotor in rotors])
    table: dict[str, Any] = {"mass": float(mass), "inertia": [float(part) for part in np.diag(inertia)]}
    products = np.array([inertia[0, 1], inertia[0, 2], inertia[1, 2]])
    products[np.abs(products) < 1e-9 * max(table["inertia"])] = 0  # of rounding
    if products.any():
        table["products_of_inertia"] = [float(part) for part in products]
    places, notes = _about_the_middle(file, places, rotors)
    spins = [rotor.spin for rotor in rotors]
    side = np.abs(places).mean()
    if spins == list(X_SPINS) and np.allclose(places, np.array(X_SIDES) * side, rtol=0, atol=1e-9 * side):
        return {**table, "arm": _rounded(side * np.sqrt(2))}, notes
    layout: dict[str, Any] = {"place": [[_rounded(part) for part in place] for place in places]}
    return {**table, "rotors": layout | ({"spin": spins} if all(spins) else {})}, notes


def _about_the_middle(file: str, places: np.ndarray, rotors: Sequence[Rotor]) -> tuple[np.ndarray, list[str]]:
    """The places from the middle of the rotors, at which flytune needs the centre of mass."""
    middle = places.mean(axis=0)
    around = places - middle
    reach, off = np.linalg.norm(around, axis=1).max(), np.linalg.norm(middle)
    if off > OFF_CENTRE * reach or reach == 0:
        raise BadInput(
            f"{file}: the middle of the rotors lies {1000 * off:.3g} mm from the centre of mass, and the rotors "
            f"{1000 * reach:.3g} mm from their middle. Allowed: a middle within a tenth of that."
        )
    if off <= 1e-6 * reach:
        return around, []
    x, y = 1000 * middle
    return around, [
        f"the middle of the rotors lies ({x:.3g}, {y:.3g}) mm from the centre of mass; flytune takes it to be "
        "there, as a balanced vehicle has it"
    ]


def _rounded(value: float) -> float:
    return float(f"{value:.12g}")


def rotor_frame(position: Sequence[float]) -> Pose:
    """An upright rotor at a place."""
    return Pose(np.array(position, float))
