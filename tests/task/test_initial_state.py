"""Where training episodes and trials begin (paper R15, R19)."""

import dataclasses
import math

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytune.config import document
from flytune.errors import BadInput
from flytune.physics.vehicle import load_vehicle
from flytune.task.initial_state import EVALUATION_INITIAL_STATES, InitialState
from flytune.task.target import Point

DRAW = jax.jit(lambda where, vehicle, target, keys: jax.vmap(lambda key: where.draw(vehicle, target, key))(keys))
NUMBER = 20_000
PAPERS_TARGET = Point(position=(0.0, 0.0, 1.0), yaw=0.0)  # R19


def draw(where, target=PAPERS_TARGET):
    """Position [N, 3], ZYX angles [N, 3] in rad (yaw, pitch, roll) and the states of many draws."""
    states = DRAW(where, load_vehicle("crazyflie"), target, jax.random.split(jax.random.key(0), NUMBER))
    angles = Rotation.from_quat(np.stack(states.attitude, axis=-1)).as_euler("ZYX")
    return np.stack(states.position, axis=-1), angles, states


CASES = {  # where, lowest and highest position, largest tilt in rad
    "paper": (-2, -2, 0.0, 2, 2, 2.0, math.radians(15)),  # R19
    "clear": (-2, -2, 0.1, 2, 2, 2.0, math.radians(15)),  # R19 with z0 >= 0.1 m
    "training": (-1, -1, 0.1, 1, 1, 2.0, 0.2),  # R15
}


@pytest.fixture(scope="module", params=CASES)
def case(request, tasks):
    """Of one distribution: its bounds and many draws."""
    where = tasks["baseline"].initial_state if request.param == "training" else EVALUATION_INITIAL_STATES[request.param]
    return CASES[request.param], *draw(where)


def test_positions_fill_their_box_evenly(case):
    # uniform in [a, b]: mean (a + b) / 2, deviation (b - a) / sqrt(12), and 20,000 draws come within 0.1 % of the ends
    bounds, position, _, _ = case
    low, high = np.array(bounds[:3]), np.array(bounds[3:6])
    assert np.all(position >= low - 1e-6) and np.all(position <= high + 1e-6)
    np.testing.assert_allclose(position.min(axis=0), low, atol=2e-3)
    np.testing.assert_allclose(position.max(axis=0), high, atol=2e-3)
    np.testing.assert_allclose(position.mean(axis=0), (low + high) / 2, atol=0.05)
    np.testing.assert_allclose(position.std(axis=0), (high - low) / math.sqrt(12), rtol=0.02)


def test_tilts_fill_their_range_and_the_heading_is_any(case):
    bounds, _, angles, _ = case
    tilt, yaw, lean = bounds[6], angles[:, 0], angles[:, 1:]
    assert np.abs(lean).max() <= tilt + 1e-6
    np.testing.assert_allclose(np.abs(lean).max(axis=0), tilt, rtol=1e-3)
    np.testing.assert_allclose(lean.std(axis=0), 2 * tilt / math.sqrt(12), rtol=0.02)
    assert yaw.min() < -3.13 and yaw.max() > 3.13
    assert yaw.std() == pytest.approx(2 * math.pi / math.sqrt(12), rel=0.02)


def test_coordinates_are_drawn_independently(case):
    _, position, angles, _ = case
    correlation = np.corrcoef(np.hstack([position, angles]).T) - np.eye(6)
    assert np.abs(correlation).max() < 5 / math.sqrt(NUMBER)


def test_a_start_is_at_rest_with_its_rotors_at_hover_speed(case):
    states = case[3]
    assert not np.any([states.velocity, states.body_rate])
    np.testing.assert_allclose(states.rotor_speed_rpm, 16_003.6, rtol=1e-4)


def test_five_percent_of_the_papers_starts_lie_below_the_altitude_bound():
    # C3: 0.1 m of 2 m; 20,000 draws know that share to 0.15 %
    assert np.mean(draw(EVALUATION_INITIAL_STATES["paper"])[0][:, 2] < 0.1) == pytest.approx(0.05, abs=0.008)
    assert np.mean(draw(EVALUATION_INITIAL_STATES["clear"])[0][:, 2] < 0.1) == 0


def test_every_preset_trains_from_the_same_starts(tasks):
    for role in ("baseline", "acrobatic", "inspection"):
        assert tasks[role].initial_state == tasks["baseline"].initial_state
        refined = tasks[f"{role}-refined"].initial_state
        assert refined == tasks["baseline-refined"].initial_state


def test_a_box_upside_down_is_refused(tasks):
    data = document.plain(tasks["baseline"].initial_state) | {"lowest_position": [0.0, 3.0, 0.0]}
    with pytest.raises(BadInput, match=r"^lowest_position: 3\.0 in y lies above highest_position, 1\.0\. Allowed"):
        document.read(InitialState, data)


def test_a_box_without_size_is_one_place():
    where = InitialState(
        lowest_position=(0.5, 0.5, 1.0), highest_position=(0.5, 0.5, 1.0), largest_tilt=0.0, largest_yaw=0.0
    )
    position, angles, _ = draw(where)
    np.testing.assert_allclose(position, np.tile([0.5, 0.5, 1.0], (NUMBER, 1)))
    np.testing.assert_allclose(angles, 0, atol=1e-7)


def test_a_vehicle_with_latency_starts_with_nothing_on_its_way():
    late = dataclasses.replace(load_vehicle("crazyflie"), action_latency_steps=3)
    start = EVALUATION_INITIAL_STATES["clear"].draw(late, PAPERS_TARGET, jax.random.key(1))
    assert start.pending_actions.shape == (3, 4) and not start.pending_actions.any()


# --- around another target ---


def test_starts_move_with_the_target_and_turn_with_its_heading(tasks):
    where = dataclasses.replace(tasks["baseline"].initial_state, largest_yaw=0.5)
    position, angles, _ = draw(where, Point(position=(20.0, -3.0, 4.0), yaw=1.0))
    # the box of R15 is (-1, -1, 0.1) to (1, 1, 2) around (0, 0, 1)
    np.testing.assert_allclose(position.min(axis=0), (19, -4, 3.1), atol=2e-3)
    np.testing.assert_allclose(position.max(axis=0), (21, -2, 5), atol=2e-3)
    np.testing.assert_allclose((angles[:, 0].min(), angles[:, 0].max()), (0.5, 1.5), atol=1e-3)


def test_a_box_may_be_written_as_offsets_from_the_target():
    offsets = InitialState(
        lowest_position=(-1.0, -2.0, 0.5), highest_position=(1.0, 2.0, 1.0), for_target=(0.0, 0.0, 0.0),
        largest_tilt=0.0, largest_yaw=0.0,
    )  # fmt: skip
    position, _, _ = draw(offsets, Point(position=(5.0, 5.0, 5.0), yaw=0.0))
    np.testing.assert_allclose(position.min(axis=0), (4, 3, 5.5), atol=3e-3)
    np.testing.assert_allclose(position.max(axis=0), (6, 7, 6), atol=3e-3)


@pytest.mark.parametrize(("name", "floor"), [("paper", 0.0), ("clear", 0.1)])
@pytest.mark.parametrize("height", [0.3, 1.0, 1.05, 3.0])
def test_trials_start_evenly_around_a_target_at_any_height_and_never_below_the_ground(name, floor, height):
    # R19: 1 m below to 1 m above the target; `clear` keeps 0.1 m from the ground wherever the target is
    low, high = max(height - 1, floor), height + 1
    z = draw(EVALUATION_INITIAL_STATES[name], Point(position=(0.0, 0.0, height), yaw=0.0))[0][:, 2]
    np.testing.assert_allclose((z.min(), z.max()), (low, high), atol=3e-3)
    np.testing.assert_allclose((z.mean(), z.std()), ((low + high) / 2, (high - low) / math.sqrt(12)), rtol=0.02)
