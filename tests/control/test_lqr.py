"""The regulator: its linear model, its Riccati equation, its closed loop."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from flytune.control.actuation import hovering_rotors
from flytune.control.classical import classical_controller, read_gains
from flytune.control.lqr import feedback, linearised, weights
from flytune.control.sensing import sense
from flytune.physics.vehicle import load_vehicle, vehicle_names
from flytune.task.files import load_task

ROLL, PITCH = (-1, -1, 1, 1), (-1, 1, 1, -1)  # signs of R4
H = 0.01
SETS = ("textbook", "tuned")


FEW = ("crazyflie", "crazyflie-measured", "hummingbird")


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=[pytest.mark.slow] * (name not in FEW)) for name in vehicle_names()],
)
def vehicle(request):
    """Every vehicle that ships."""
    return load_vehicle(request.param)


@pytest.mark.parametrize("name", ["crazyflie", "crazyflie-km794"])
def test_the_linear_model_of_instant_motors_is_the_chain_of_integrators(name):
    # torque of one action: 2 action_scale f_hover l; angle = h^2/2 of the angular acceleration;
    # pitch tilts the thrust: x = g h^4/24 of it
    vehicle = load_vehicle(name)
    a, b = linearised(vehicle)
    force = 2 * vehicle.action_scale * vehicle.mass * vehicle.gravity / 4
    turn = np.outer(ROLL, [1, 0, 0]) + np.outer(PITCH, [0, 1, 0])
    turn = turn * force * vehicle.lever / np.asarray(vehicle.inertia)
    np.testing.assert_allclose(b[9:11].T, turn[:, :2] * H, rtol=1e-4)
    np.testing.assert_allclose(b[6:8].T, turn[:, :2] * H**2 / 2, rtol=1e-4)
    np.testing.assert_allclose(b[5], force / vehicle.mass * H, rtol=1e-4)
    np.testing.assert_allclose(b[0], np.array(PITCH) * turn[1, 1] * vehicle.gravity * H**4 / 24, rtol=1e-3)
    np.testing.assert_allclose(a[0, 7], vehicle.gravity * H**2 / 2, rtol=1e-4)  # pitch pulls forward
    np.testing.assert_allclose(a[1, 6], -vehicle.gravity * H**2 / 2, rtol=1e-4)  # roll pulls to the right
    np.testing.assert_allclose(a[:, 12:], 0, atol=1e-7)  # what the rotors did before does not matter
    np.testing.assert_allclose(b[12:], np.eye(4), atol=1e-6)


def test_the_linear_model_of_lagging_motors_remembers_them():
    vehicle = load_vehicle("crazyflie-measured")
    a, b = linearised(vehicle)
    left = math.exp(-H / vehicle.motor_fall_time_constant)
    np.testing.assert_allclose(a[12:, 12:], left * np.eye(4), atol=1e-5)
    np.testing.assert_allclose(b[12:], (1 - left) * np.eye(4), atol=1e-5)
    assert np.abs(a[9:12, 12:]).min() > 0


@pytest.mark.parametrize("gains", SETS)
def test_the_gain_solves_the_riccati_equation(vehicle, gains):
    # P is rebuilt from K alone, as the cost of flying it: P = (A - B K)' P (A - B K) + Q + K' R K
    chosen = read_gains("lqr")[gains]
    (a, b), (q, r), k = linearised(vehicle), weights(chosen), feedback(vehicle, chosen)
    closed = a - b @ k
    p, term, step = np.zeros_like(a), q + k.T @ r @ k, closed
    for _ in range(40):  # doubling: the sum of closed'^n (Q + K'RK) closed^n up to n = 2^40
        term, step = term + step.T @ term @ step, step @ step
    p = term
    s = r + b.T @ p @ b
    residual = a.T @ p @ a - a.T @ p @ b @ np.linalg.solve(s, b.T @ p @ a) + q - p
    # float64, entries of P up to 1e6 and a condition number near 1e8
    assert np.abs(residual).max() < 1e-6 * np.abs(p).max()
    np.testing.assert_allclose(np.linalg.solve(s, b.T @ p @ a), k, atol=1e-5 * np.abs(k).max())


@pytest.mark.parametrize("gains", SETS)
def test_the_closed_loop_is_stable(vehicle, gains):
    chosen = read_gains("lqr")[gains]
    a, b = linearised(vehicle)
    assert np.abs(np.linalg.eigvals(a)).max() > 0.999  # on its own it is not
    assert np.abs(np.linalg.eigvals(a - b @ feedback(vehicle, chosen))).max() < 0.999


def test_weights_are_bryson_s(vehicle):
    gains = read_gains("lqr")["textbook"]
    q, r = weights(gains)
    np.testing.assert_allclose(q[2, 2], 1 / gains.vertical_error**2)
    np.testing.assert_allclose(q[11, 11], 1 / gains.yaw_rate**2)
    np.testing.assert_allclose(np.diag(r), 1 / gains.action**2)
    np.testing.assert_array_equal(q[12:], 0)


def test_the_deviation_is_seen_along_the_heading(observation):
    # heading a quarter turn to the left: an error along +y is an error ahead
    task = load_task("baseline", {"target.yaw": 1.5})
    controller = classical_controller("lqr", task, "textbook")
    yaw = math.pi / 2
    seen = observation(task, position=(0, 0.01, 1), velocity=(0.02, 0, 0), angles=(0.01, 0.02, yaw))
    x = np.stack(controller.deviation(sense(seen), hovering_rotors(task.vehicle)))
    wanted = [0.01, 0, 0, 0, -0.02, 0, 0.01, 0.02, yaw - 1.5, 0, 0, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(x, wanted, atol=1.5e-4)  # small angles: a quaternion's part is half of it, to 2e-4 / 24


def test_the_position_error_is_cut_to_what_the_limits_allow(baseline):
    controller = classical_controller("lqr", baseline, "textbook")
    far = np.stack(controller.reachable(tuple(map(jnp.float32, (30.0, 0.0, 0.0)))))
    pitch = np.array(PITCH) @ np.asarray(controller.gain)
    cruise = pitch[0] / pitch[3] * far[0]  # the speed at which position and velocity cancel
    np.testing.assert_allclose(cruise, controller.speed_limit, rtol=1e-4)
    assert abs(pitch[0] / pitch[7] * far[0]) <= controller.tilt_limit
    near = tuple(map(jnp.float32, (0.01, -0.02, 0.03)))
    np.testing.assert_array_equal(np.stack(controller.reachable(near)), np.stack(near))
