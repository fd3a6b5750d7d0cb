"""The geometric law against hand arithmetic (Lee, Leok and McClamroch 2010)."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytune.control.classical import classical_controller
from flytune.control.geometric import attitude_error_vector, turn_of, turned_by, wanted_attitude
from flytune.control.sensing import body_axes, sense
from flytune.physics.rotation import from_euler

LEVEL = body_axes(tuple(map(jnp.float32, (0, 0, 0, 1))))


def axes(*angles):
    return body_axes(from_euler(*map(jnp.float32, angles)))


def matrix(columns):
    return np.stack([np.stack(column) for column in columns], axis=-1)


@pytest.mark.parametrize("axis", range(3))
def test_the_attitude_error_of_a_turn_about_one_axis_is_its_sine(axis):
    angles = [0.0, 0.0, 0.0]
    angles[axis] = 0.7
    wanted = np.zeros(3)
    wanted[axis] = math.sin(0.7)
    np.testing.assert_allclose(np.stack(attitude_error_vector(axes(*angles), LEVEL)), wanted, atol=1e-6)


def test_the_attitude_error_is_half_the_skew_part_of_the_difference():
    rotated, wanted = axes(0.3, -0.5, 2.0), axes(-0.2, 0.4, 1.1)
    r, d = matrix(rotated), matrix(wanted)
    skew = (d.T @ r - r.T @ d) / 2
    np.testing.assert_allclose(
        np.stack(attitude_error_vector(rotated, wanted)), [skew[2, 1], skew[0, 2], skew[1, 0]], atol=1e-6
    )


def test_the_wanted_attitude_points_up_along_the_force_and_forward_along_the_heading():
    force = tuple(map(jnp.float32, (1.0, -2.0, 9.0)))
    wanted = matrix(wanted_attitude(force, jnp.float32(0.8)))
    np.testing.assert_allclose(wanted.T @ wanted, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(wanted), 1, atol=1e-6)
    np.testing.assert_allclose(wanted[:, 2], np.array([1, -2, 9]) / math.sqrt(86), atol=1e-6)
    # b1 is the heading's projection: it lies in the plane of the heading and b3
    normal = np.cross([math.cos(0.8), math.sin(0.8), 0], wanted[:, 2])
    np.testing.assert_allclose(wanted[:, 0] @ normal, 0, atol=1e-6)
    assert wanted[:, 0] @ [math.cos(0.8), math.sin(0.8), 0] > 0.9


def test_the_wanted_turn_is_the_rate_of_the_wanted_attitude():
    # a force that swings in the x-z plane, angle 0.2 + 0.5 t from the vertical, turns about +y at 0.5 rad/s
    def attitude(t):
        return wanted_attitude((jnp.sin(0.2 + 0.5 * t), jnp.zeros(()), jnp.cos(0.2 + 0.5 * t)), jnp.float32(0.0))

    wanted, turning = jax.jvp(attitude, (jnp.float32(0.0),), (jnp.float32(1.0),))
    np.testing.assert_allclose(np.stack(turn_of(wanted, turning)), [0, 0.5, 0], atol=1e-6)
    # and seen from a body yawed by a quarter turn to the left, whose x axis is the inertial y axis
    np.testing.assert_allclose(
        np.stack(turned_by(axes(0, 0, math.pi / 2), turn_of(wanted, turning), wanted)), [0.5, 0, 0], atol=1e-6
    )


def test_a_small_position_error_gives_the_force_of_the_paper(baseline, observation):
    # textbook: k_x = 16, k_v = 5.6: e = (0.01, 0, -0.02), v = (0, 0.1, 0)
    controller = classical_controller("geometric", baseline, "textbook")
    sensed = sense(observation(baseline, position=(0.01, 0, 0.98), velocity=(0, 0.1, 0)))
    np.testing.assert_allclose(
        np.stack(controller.force(sensed.position_error, sensed.velocity)), [-0.16, -0.56, 9.81 + 0.32], atol=1e-5
    )


def test_a_far_heading_is_approached_by_way_of_nearer_ones(baseline, observation):
    controller = classical_controller("geometric", baseline, "textbook")
    largest = controller.gains.largest_yaw_error
    for yaw in (0.5, -3.0, 3.1):
        reference = controller.reference_yaw(sense(observation(baseline, angles=(0, 0, yaw))))
        np.testing.assert_allclose(reference, yaw - math.copysign(min(abs(yaw), largest), yaw), atol=1e-5)
