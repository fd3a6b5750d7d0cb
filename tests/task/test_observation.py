"""The 17 numbers a controller sees, and their noise (paper R7, R8)."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytune.physics.dynamics import State, hovering
from flytune.physics.vehicle import load_vehicle
from flytune.task.observation import BLOCKS, NOISY, SIZE, ObservationNoise, draw_noise, observe
from flytune.task.reference import Reference

QUIET = np.zeros(NOISY)
PAPER = ObservationNoise(position=1e-3, attitude=2e-3, velocity=1e-3, body_rate=2e-3)
TARGET = Reference(position=(0.0, 0.0, 1.0), yaw=0.0)
ACTION = (0.1, -0.2, 0.3, -0.4)
SEE = jax.jit(observe)


def state(position=(0.5, -1.5, 2.25), attitude=(0, 0, 0, 1), velocity=(0.1, 0.2, 0.3), body_rate=(1.0, 2.0, 3.0)):
    """A true state."""
    parts = {"position": position, "attitude": attitude, "velocity": velocity, "body_rate": body_rate}
    rest = hovering(load_vehicle("crazyflie"), (0.0, 0.0, 0.0))
    return dataclasses.replace(rest, **{name: tuple(map(jnp.float32, part)) for name, part in parts.items()})


def see(true: State, target=TARGET, noise=PAPER, normal=QUIET):
    """The observation as a NumPy array."""
    return np.array(SEE(target, noise, true, jnp.asarray(ACTION, jnp.float32), jnp.asarray(normal, jnp.float32)))


def test_the_blocks_add_up_to_seventeen_numbers():
    assert sum(BLOCKS) == SIZE == 17
    assert sum(BLOCKS[:4]) == NOISY == 13


def test_without_noise_the_layout_is_position_error_attitude_velocity_rate_and_last_action():
    # e_p = p - p* = (0.5, -1.5, 2.25 - 1); 40 deg of yaw: (0, 0, sin 20, cos 20)
    half = math.radians(20)
    seen = see(state(attitude=(0, 0, math.sin(half), math.cos(half))))
    expected = [0.5, -1.5, 1.25, 0, 0, math.sin(half), math.cos(half), 0.1, 0.2, 0.3, 1, 2, 3, 0.1, -0.2, 0.3, -0.4]
    np.testing.assert_allclose(seen, expected, atol=1e-6)


@pytest.mark.parametrize("yaw", [-math.pi, -2.0, 0.5, math.pi / 2, 3.0])
def test_position_error_and_velocity_are_seen_in_axes_that_turn_with_the_heading_of_the_target(yaw):
    error, velocity = (0.5, -1.5, 1.25), (0.1, 0.2, 0.3)
    seen = see(state(velocity=velocity), target=dataclasses.replace(TARGET, yaw=yaw))
    back = Rotation.from_euler("z", -yaw)
    np.testing.assert_allclose(seen[:3], back.apply(error), atol=1e-6)
    np.testing.assert_allclose(seen[7:10], back.apply(velocity), atol=1e-6)
    np.testing.assert_allclose(seen[10:13], [1, 2, 3], atol=1e-6)  # the body rate is the body's own


def test_at_yaw_zero_position_error_and_velocity_are_those_of_the_inertial_frame_bit_by_bit():
    rng = np.random.default_rng(0)
    for _ in range(20):
        position, velocity = (tuple(rng.normal(0, 3, 3).astype(np.float32)) for _ in range(2))
        seen = see(state(position=position, velocity=velocity))
        np.testing.assert_array_equal(seen[7:10], np.float32(velocity))
        np.testing.assert_array_equal(seen[:3], np.float32(position) - np.float32(TARGET.position))


def test_the_velocity_is_seen_in_the_heading_frame_whatever_the_attitude():
    seen = see(state(attitude=(0, 0, 1, 0)))
    np.testing.assert_allclose(seen[7:10], [0.1, 0.2, 0.3], rtol=1e-6)


def test_the_attitude_is_flipped_to_a_real_part_of_at_least_zero():
    attitude = Rotation.from_euler("ZYX", [0.4, 0.2, -0.1]).as_quat()
    one, other = see(state(attitude=attitude)), see(state(attitude=-attitude))
    np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(one[3:7], attitude, atol=1e-6)
    assert one[6] > 0


def test_the_attitude_is_seen_from_the_targets_heading():
    # heading 90 deg, vehicle at 120 deg with a little roll: what is left is 30 deg about z, then the roll
    seen = see(
        state(attitude=Rotation.from_euler("ZYX", [math.radians(120), 0.0, 0.1]).as_quat()),
        target=Reference(position=(0.0, 0.0, 1.0), yaw=math.radians(90)),
    )
    np.testing.assert_allclose(seen[3:7], Rotation.from_euler("ZYX", [math.radians(30), 0, 0.1]).as_quat(), atol=1e-6)


@pytest.fixture(scope="module")
def many():
    """20,000 noisy observations of one state, and the one without noise."""
    true = state(attitude=Rotation.from_euler("ZYX", [0.4, 0.2, -0.1]).as_quat())
    keys = jax.random.split(jax.random.key(0), 20_000)
    noisy = jax.jit(jax.vmap(lambda key: observe(TARGET, PAPER, true, jnp.asarray(ACTION), draw_noise(key))))(keys)
    return np.array(noisy, dtype=float), see(true).astype(float)


def test_the_noise_has_the_papers_standard_deviations_and_no_mean(many):
    # of 20,000 draws the standard deviation is known to 1 / sqrt(40,000) = 0.5 %, the mean to 0.7 % of it; 5 sigma
    noisy, clean = many
    for columns, deviation in ((slice(0, 3), 1e-3), (slice(7, 10), 1e-3), (slice(10, 13), 2e-3)):
        np.testing.assert_allclose((noisy - clean)[:, columns].std(axis=0), deviation, rtol=0.025)
        np.testing.assert_allclose((noisy - clean)[:, columns].mean(axis=0), 0, atol=0.035 * deviation)


def test_the_noise_on_the_attitude_is_that_of_four_components_less_the_one_along_the_quaternion(many):
    # normalising takes away the component along q: three of four directions of 2e-3 each are left
    noisy, clean = many
    off = (noisy - clean)[:, 3:7]
    assert math.sqrt((off**2).sum(axis=1).mean() / 3) == pytest.approx(2e-3, rel=0.02)
    assert np.abs(off @ clean[3:7]).max() < 5e-5


def test_a_noisy_attitude_is_a_unit_quaternion_again(many):
    np.testing.assert_allclose(np.linalg.norm(many[0][:, 3:7], axis=1), 1, atol=1e-6)


def test_the_last_action_is_seen_without_noise(many):
    np.testing.assert_array_equal(many[0][:, 13:], np.tile(np.float32(ACTION), (20_000, 1)))


def test_noise_of_different_numbers_is_independent(many):
    noisy, clean = many
    columns = [0, 1, 2, 7, 8, 9, 10, 11, 12]
    correlation = np.corrcoef((noisy - clean)[:, columns].T) - np.eye(len(columns))
    assert np.abs(correlation).max() < 5 / math.sqrt(20_000)


def test_the_flip_comes_before_the_noise():
    # reading of R8: at half a turn (w = 0) noise may push the real part below zero, and it is left there
    normal = np.zeros(NOISY)
    normal[6] = -1.0
    seen = see(state(attitude=(0, 0, 1, 0)), normal=normal)
    assert seen[6] == pytest.approx(-2e-3, rel=1e-4)
    assert seen[5] > 0


def test_every_preset_has_the_papers_noise(tasks):
    assert all(task.noise == PAPER for task in tasks.values())
