"""The physics step against DOP853 in float64, on the equations of motion written out once more (paper R1 to R6).

docs/concepts/integrator.md holds the full table; what is tested here is that its conclusion still stands.
"""

import math

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from flytune.physics.dynamics import PHYSICS_STEPS, hovering

ROLL, PITCH, YAW = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]])  # signs of R4, motors 0 to 3
PARTS = {"position": slice(0, 3), "attitude": slice(3, 7), "velocity": slice(7, 10), "body_rate": slice(10, 13)}
SHAPES = {"paper": (2.2, 0.55, 0.45, 0.1), "measured": (1.0, 0.6, 0.5, 0.2)}


def manoeuvre(frequency, roll, pitch, lift):
    """Two seconds that swing roll and pitch to both sides at 500 deg/s and more, open loop."""
    phase = 2 * math.pi * frequency * 0.01 * np.arange(200)[:, None]

    def swing(p):
        return 0.75 * np.sin(3 * p) - 0.25 * np.sin(p)  # as sin^3, differentiated twice: no drift in rate and angle

    return lift + roll * ROLL * swing(phase) + pitch * PITCH * swing(0.8 * phase) + 0.1 * YAW * swing(0.5 * phase)


def reference(vehicle, actions):
    """States [T, 13] after each action, from a hover at 1 m."""
    lever, mass, kf, km = vehicle.arm / 2**0.5, vehicle.mass, vehicle.thrust_coefficient, vehicle.torque_coefficient
    inertia, drag, gravity = np.diag(vehicle.inertia), np.diag(vehicle.drag), np.array([0, 0, vehicle.gravity])
    hover = (vehicle.gravity * mass / (4 * kf)) ** 0.5
    rise, fall = vehicle.motor_rise_time_constant, vehicle.motor_fall_time_constant

    def speeds(t, now, goal):
        if rise == fall == 0:
            return goal
        return goal + (now - goal) * np.exp(-t / np.where(goal > now, rise, fall))

    def rates(t, y, now, goal):
        (x, yy, z, s), velocity, w = y[3:7], y[7:10], y[10:]
        force = kf * speeds(t, now, goal) ** 2
        torque = np.array([lever * force @ ROLL, lever * force @ PITCH, km / kf * force @ YAW])
        to_inertial = np.array(
            [
                [s * s + x * x - yy * yy - z * z, 2 * (x * yy - s * z), 2 * (x * z + s * yy)],
                [2 * (x * yy + s * z), s * s - x * x + yy * yy - z * z, 2 * (yy * z - s * x)],
                [2 * (x * z - s * yy), 2 * (yy * z + s * x), s * s - x * x - yy * yy + z * z],
            ]
        )
        turning = 0.5 * np.array([[s, -z, yy], [z, s, -x], [-yy, x, s], [-x, -yy, -z]]) @ w  # R2, column by column
        acceleration = to_inertial @ [0, 0, force.sum()] / mass - gravity - drag @ velocity / mass
        return np.concatenate(
            [velocity, turning, acceleration, np.linalg.solve(inertia, torque - np.cross(w, inertia @ w))]
        )

    state, now, states = np.array([0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0.0]), np.full(4, hover), []
    for action in np.clip(actions, -1, 1):
        goal = np.minimum(hover * (1 + vehicle.action_scale * action), vehicle.maximum_rotor_speed_rpm)
        state = solve_ivp(rates, (0, 0.01), state, "DOP853", args=(now, goal), rtol=1e-10, atol=1e-10).y[:, -1]
        now = speeds(0.01, now, goal)
        states.append(state)
    return np.array(states)


@pytest.fixture(scope="module", params=SHAPES)
def flight(request, fly):
    """Of one vehicle: the exact states, and the largest error of each part in either precision."""
    vehicle, actions = request.getfixturevalue(request.param), manoeuvre(*SHAPES[request.param])
    exact = reference(vehicle, actions)

    def errors(physics_steps, double):
        with jax.enable_x64(double):
            flown = fly(vehicle, hovering(vehicle, (0.0, 0.0, 1.0)), actions, physics_steps)
        assert flown.position.dtype == (np.float64 if double else np.float32)
        return {
            name: np.linalg.norm(getattr(flown, name) - exact[:, columns], axis=-1).max()
            for name, columns in PARTS.items()
        }

    return exact, errors


def test_the_manoeuvre_is_hard_and_stays_bounded(flight):
    exact, _ = flight
    peak = np.degrees(np.linalg.norm(exact[:, PARTS["body_rate"]], axis=1)).max()
    assert 450 < peak < 1000
    assert np.linalg.norm(exact[:, PARTS["velocity"]], axis=1).max() < 15
    np.testing.assert_allclose(np.linalg.norm(exact[:, PARTS["attitude"]], axis=1), 1, atol=1e-8)


def test_the_error_falls_with_the_fourth_power_of_the_step_in_double_precision(flight):
    # order = log2(e(h) / e(h / 2)): 4 to within the next term of the error's expansion
    coarse, middle, fine = (flight[1](steps, double=True) for steps in (1, 2, 4))
    for name in PARTS:
        assert math.log2(coarse[name] / middle[name]) == pytest.approx(4, abs=0.25), name
        assert math.log2(middle[name] / fine[name]) == pytest.approx(4, abs=0.25), name


# R8: what the controller's sensors do not resolve
NOISE = {"position": 1e-3, "attitude": 2e-3, "velocity": 1e-3, "body_rate": 2e-3}


def test_one_step_per_control_period_is_exact_to_a_third_of_the_noise_in_single_precision(flight):
    errors = flight[1](PHYSICS_STEPS, double=False)
    for name, noise in NOISE.items():
        assert errors[name] < noise / 3, name


def test_finer_steps_in_single_precision_gain_less_than_a_tenth_of_the_noise(flight):
    # float32 rounds every step: more steps trade truncation for rounding
    default, finer = (flight[1](steps, double=False) for steps in (1, 4))
    for name, noise in NOISE.items():
        assert default[name] - finer[name] < noise / 10, name
