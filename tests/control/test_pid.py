"""The PID's loops against hand arithmetic."""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from flytune.config.pytree import pytree
from flytune.control.classical import classical_controller, controller_with, read_gains
from flytune.control.controller import slowed, specific_force
from flytune.control.sensing import sense


@pytest.fixture(scope="module")
def gains():
    """Round numbers."""
    return dataclasses.replace(
        read_gains("pid")["textbook"],
        horizontal_position=2.0,
        vertical_position=1.0,
        horizontal_velocity=5.0,
        vertical_velocity=4.0,
        position_integral=0.5,
        integral_zone=0.3,
        integral_limit=0.1,
        tilt=6.0,
        tilt_rate=20.0,
        yaw=2.0,
        yaw_rate=10.0,
        largest_yaw_rate=3.0,
        bound_share=1.0,
    )


@pytest.fixture(scope="module")
def pid(baseline, gains):
    """The PID with these gains, limited to the baseline's 0.8 m/s."""
    return controller_with(gains, baseline)


def seen(observation, task, **state):
    return sense(observation(task, **state))


ZERO = tuple(jnp.zeros(3))


def test_near_the_target_acceleration_is_the_sum_of_both_loops(pid, baseline, observation):
    # e = (0.1, 0, -0.2), v = (0, 0.3, 0): x: -5 * 2 * 0.1 = -1; y: -5 * 0.3 = -1.5; z: 4 * 0.2 = 0.8
    # and the integral: 0.01 s * e * -0.5 = (-0.0005, 0, 0.001)
    sensed = seen(observation, baseline, position=(0.1, 0, 0.8), velocity=(0, 0.3, 0))
    acceleration, integral = pid.acceleration(sensed, ZERO)
    np.testing.assert_allclose(np.stack(acceleration), [-1.0005, -1.5, 0.801], atol=1e-5)
    np.testing.assert_allclose(np.stack(integral), [0.001, 0, -0.002], atol=1e-7)


def test_far_away_the_wanted_velocity_has_the_length_of_the_limit(pid, baseline, observation):
    # e = (3, 0, 4) wants (-6, 0, -4) m/s, cut to 0.8 m/s in that direction
    acceleration, integral = pid.acceleration(seen(observation, baseline, position=(3, 0, 5)), ZERO)
    length = math.hypot(6, 4)
    np.testing.assert_allclose(np.stack(acceleration), [-5 * 0.8 * 6 / length, 0, -4 * 0.8 * 4 / length], rtol=1e-5)
    np.testing.assert_array_equal(np.stack(integral), 0)  # too far away to sum up


def test_the_integral_stops_at_its_limit(pid, baseline, observation):
    sensed, integral = seen(observation, baseline, position=(0.2, 0, 1)), ZERO
    for _ in range(150):  # 1.5 s * 0.2 m * 0.5 = 0.15 m/s^2, above the limit of 0.1
        acceleration, integral = pid.acceleration(sensed, integral)
    np.testing.assert_allclose(0.5 * np.stack(integral), [0.1, 0, 0], atol=0.0011)  # within one step of the limit
    np.testing.assert_allclose(acceleration[0], -5 * 2 * 0.2 - 0.1, atol=1e-5)


@pytree
class Tired:
    """A controller whose motors do a little less than they are told."""

    controller: Any
    lost: float  # of each action

    def initial_memory(self):
        return self.controller.initial_memory()

    def act(self, memory, observation):
        memory, action = self.controller.act(memory, observation)
        return memory, action - self.lost


def test_the_integral_removes_a_constant_pull(baseline, calm_flight):
    # an action lower by 0.01 takes 1 - (1 - 0.5 * 0.01)^2 = 0.9975 % off the thrust, 0.0979 m/s^2.
    # Without an integral the vehicle hangs 0.0979 / (k_p k_v) = 0.0979 / 4 = 24.5 mm low; with one, that fades at
    # k_i / (k_p k_v) = 0.1 1/s
    controller = classical_controller("pid", baseline, "textbook")
    without = dataclasses.replace(controller, gains=dataclasses.replace(controller.gains, position_integral=0.0))
    low, kept = (
        1 - calm_flight(Tired(controller=one, lost=0.01), baseline, [0, 0, 1], steps=4000)["position"][0, -1, 2]
        for one in (without, controller)
    )
    np.testing.assert_allclose(low, 0.0245, rtol=0.01)
    assert abs(kept) < 0.0245 * math.exp(-0.1 * 40) * 1.5  # half as much again for the slightly slower true pole


def test_tilt_is_steered_by_the_angle_to_the_wanted_force(pid, baseline, observation):
    # level, force tilted 0.1 rad towards +x: turn about +y, at 20 * 6 * 0.1 = 12 rad/s^2
    force = (9.81 * math.sin(0.1), 0.0, 9.81 * math.cos(0.1))
    turn = pid.angular_acceleration(seen(observation, baseline), force)
    np.testing.assert_allclose(np.stack(turn), [0, 12, 0], atol=1e-3)


def test_tilt_does_not_depend_on_a_large_yaw_error(pid, baseline, observation):
    # half a turn of yaw: the body's y axis points to -y, so the same tilt is now a turn about -y; yaw is cut to 3 rad/s
    force = (9.81 * math.sin(0.1), 0.0, 9.81 * math.cos(0.1))
    turn = pid.angular_acceleration(seen(observation, baseline, angles=(0, 0, 3.1)), force)
    np.testing.assert_allclose(np.stack(turn), [12 * math.sin(3.1), 12 * math.cos(3.1), -30], atol=1e-2)


def test_the_error_fed_in_is_cut_in_length_and_keeps_its_direction():
    error = tuple(map(jnp.float32, (3.0, 0.0, 4.0)))
    cut = np.stack(slowed(error, (2.0, 2.0, 2.0), 1.0))
    np.testing.assert_allclose(cut, [0.3, 0, 0.4], rtol=1e-6)
    np.testing.assert_array_equal(np.stack(slowed(error, (2.0, 2.0, 2.0), None)), np.stack(error))


def test_a_force_tilts_no_further_than_allowed_and_never_points_down(baseline):
    vehicle = baseline.vehicle
    force = np.stack(specific_force(vehicle, tuple(map(jnp.float32, (30.0, -40.0, 0.0))), 0.3))
    np.testing.assert_allclose(math.atan2(math.hypot(force[0], force[1]), force[2]), 0.3, rtol=1e-5)
    np.testing.assert_allclose(force[:2] / np.linalg.norm(force[:2]), [0.6, -0.8], rtol=1e-5)
    falling = np.stack(specific_force(vehicle, tuple(map(jnp.float32, (0.0, 0.0, -30.0))), 0.3))
    np.testing.assert_allclose(falling, [0, 0, 0.5 * 9.81], rtol=1e-6)
