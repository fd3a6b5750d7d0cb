"""Every vehicle and every number at the ends of what is allowed flies with finite numbers, or is refused."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from tests.airframes import AIRFRAMES, airframe
from tests.corners import edits_at_the_ends, vehicles

from flytune.control.classical import CLASSICAL, classical_controller
from flytune.control.policy import load_policy
from flytune.errors import BadInput
from flytune.evaluation.fly import fly
from flytune.runs.shipped import shipped_files
from flytune.task.files import load_task

pytestmark = pytest.mark.slow

CONTROLLERS = (*CLASSICAL, "policy")
PARTS = ("target", "initial_state", "noise", "termination", "vehicle")
BASELINE = load_task("baseline")
FIELDS = ("position", "attitude", "velocity", "body_rate", "rotor_speed_rpm", "action")
# numbers are leaves: all flights of a controller share one compiled program


@cache
def policy():
    """A policy that ships."""
    return load_policy(shipped_files("baseline-refined")[0])


def flown(task, name):
    """A short flight of a controller on a task."""
    controller = policy() if name == "policy" else classical_controller(name, task)
    return fly(controller, task, trials=2, duration=2.0)


def check(flights):
    """Every number that a flight holds is finite, also where the vehicle crashed."""
    assert all(np.isfinite(getattr(flights, field)).all() for field in FIELDS)
    assert all(np.isfinite(margin).all() for margin in flights.margins.values())
    assert np.abs(flights.action).max() <= 1 and flights.rotor_speed_rpm.min() >= 0


@pytest.mark.parametrize("latency", [0, pytest.param(20, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", CONTROLLERS)
def test_every_controller_flies_vehicles_at_the_corners_of_what_is_plausible(name, latency):
    for vehicle in vehicles(8, latency):
        check(flown(dataclasses.replace(BASELINE, vehicle=vehicle), name))


@pytest.mark.parametrize("name", CONTROLLERS)
def test_every_controller_flies_with_each_number_at_an_end_of_its_range(name):
    flights, refusals = 0, []
    for edit in edits_at_the_ends("baseline", PARTS):
        try:
            check(flown(load_task("baseline", edit), name))
            flights += 1
        except BadInput as error:
            refusals.append((next(iter(edit)).split(".")[0], str(error)))
    assert all(text.startswith((part, "starts clear: ")) and "\n" not in text for part, text in refusals)
    assert flights > 30 and len(refusals) > 10


@pytest.mark.parametrize("name", CLASSICAL)
@pytest.mark.parametrize("scale", [1.0, 1.45, 3.0])
def test_a_rotor_that_stands_still_gives_no_square_root_of_a_negative_number(name, scale):
    vehicle = dataclasses.replace(BASELINE.vehicle, action_scale=scale, maximum_rotor_speed_rpm=64_000.0)
    flights = flown(dataclasses.replace(BASELINE, vehicle=vehicle), name)
    check(flights)
    assert not flights.crashed.any()


@pytest.mark.parametrize("airframe_name", AIRFRAMES)
@pytest.mark.parametrize("name", CLASSICAL)
def test_airframes_from_20_g_to_25_kg_fly(name, airframe_name):
    task = dataclasses.replace(BASELINE, vehicle=airframe(airframe_name))
    flights = flown(task, name)
    check(flights)
    # the gains are for motors as quick as those of the Crazyflie; with a lag of 0.3 s they may lose the vehicle
    assert airframe_name == "lifter" or not flights.crashed.any()
