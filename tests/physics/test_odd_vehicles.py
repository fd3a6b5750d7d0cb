"""Vehicles as they are: every term of the equations of motion against DOP853 in float64, written out once more."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from tests.odd_vehicles import ODD, odd_vehicle

from flytune.config import document
from flytune.control.actuation import allocate
from flytune.errors import BadInput
from flytune.physics.dynamics import hovering
from flytune.physics.rotors import (
    action_of_rotor_speed,
    commanded_rotor_speed,
    hover_action,
    places,
    rotor_speed_per_action,
    spins,
    thrust_and_torque,
)
from flytune.physics.vehicle import Vehicle, load_vehicle, vehicle_table

LEVEL = Rotation.identity()


def forces_of(vehicle, speed):
    """Thrust and drag torque of each rotor, as the file says."""
    thrust = vehicle.thrust_coefficient * speed**2 + (vehicle.thrust_linear or 0) * speed
    return thrust, vehicle.torque_coefficient * speed**2 + (vehicle.torque_linear or 0) * speed


def speed_of(vehicle, thrust):
    return brentq(lambda speed: forces_of(vehicle, speed)[0] - thrust, 0, 1e5, xtol=1e-9)


def commands_of(vehicle, action):
    """Rotor speeds that actions ask for, by the definition of each convention."""
    hover = speed_of(vehicle, vehicle.mass * vehicle.gravity / 4)
    least = vehicle.minimum_rotor_speed_rpm
    largest = vehicle.maximum_rotor_speed_rpm
    if vehicle.thrust_to_weight is not None:
        largest = speed_of(vehicle, vehicle.thrust_to_weight * vehicle.mass * vehicle.gravity / 4)
    if vehicle.action_convention == "hover_relative":
        return np.clip(hover * (1 + vehicle.action_scale * action), least, largest)
    if vehicle.action_convention == "rotor_speed":
        return least + (largest - least) * (1 + action) / 2
    low, high = (forces_of(vehicle, speed)[0] for speed in (least, largest))
    return np.array([speed_of(vehicle, low + (high - low) * (1 + part) / 2) for part in action])


def reference(vehicle, actions):
    """States [T, 13] after each action, from a hover at 1 m."""
    ixx, iyy, izz = vehicle.inertia
    ixy, ixz, iyz = vehicle.products_of_inertia or (0, 0, 0)
    inertia = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    place, spin = places(vehicle), np.array(spins(vehicle))
    linear, quadratic, turning = (
        np.array(each or (0, 0, 0)) for each in (vehicle.body_drag, vehicle.quadratic_drag, vehicle.rotor_drag)
    )
    period = 1 / vehicle.control_rate

    def speeds(t, now, goal):
        lag = np.where(goal > now, vehicle.motor_rise_time_constant, vehicle.motor_fall_time_constant)
        return goal + (now - goal) * np.exp(-t / lag)

    def rates(t, y, now, goal):
        speed = speeds(t, now, goal)
        thrust, drag_torque = forces_of(vehicle, speed)
        to_inertial, w = Rotation.from_quat(y[3:7]).as_matrix(), y[10:]
        along = to_inertial.T @ y[7:10]
        resistance = linear + turning * speed.sum() * 2 * math.pi / 60 + quadratic * np.abs(along)
        force = np.array([0, 0, thrust.sum()]) - resistance * along
        pull = to_inertial @ force - np.array(vehicle.drag) * y[7:10]
        torque = np.array([place[:, 1] @ thrust, -place[:, 0] @ thrust, spin @ drag_torque])
        x, yy, z, s = y[3:7]
        turn = 0.5 * np.array([[s, -z, yy], [z, s, -x], [-yy, x, s], [-x, -yy, -z]]) @ w
        fall = np.linalg.solve(inertia, torque - np.cross(w, inertia @ w))
        return np.concatenate([y[7:10], turn, pull / vehicle.mass - [0, 0, vehicle.gravity], fall])

    hover = np.full(4, speed_of(vehicle, vehicle.mass * vehicle.gravity / 4))
    state, now, states = np.array([0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0.0]), hover, []
    late = vehicle.action_latency_steps
    for step in range(len(actions)):
        goal = commands_of(vehicle, actions[step - late]) if step >= late else hover
        state = solve_ivp(rates, (0, period), state, "DOP853", args=(now, goal), rtol=1e-9, atol=1e-10).y[:, -1]
        now = speeds(period, now, goal)
        states.append(state)
    return np.array(states)


def swinging(vehicle, seconds=0.6):
    """Actions about hover that swing roll, pitch and yaw."""
    phase = 2 * math.pi * 1.7 * np.arange(round(seconds * vehicle.control_rate))[:, None] / vehicle.control_rate
    roll, pitch, yaw = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]])
    swing = 0.1 * np.sin(3 * phase) * roll + 0.08 * np.sin(2 * phase) * pitch + 0.2 * np.sin(phase) * yaw + 0.05
    return np.clip(float(hover_action(vehicle)) + swing, -1, 1)


@pytest.mark.parametrize("name", ODD)
def test_the_step_follows_the_equations_of_motion_with_every_term(name, fly):
    vehicle = odd_vehicle(name)
    actions = swinging(vehicle)
    exact = reference(vehicle, actions)
    with jax.enable_x64(True):
        flown = fly(vehicle, hovering(vehicle, (0.0, 0.0, 1.0)), actions)
    parts = {"position": slice(0, 3), "attitude": slice(3, 7), "velocity": slice(7, 10), "body_rate": slice(10, 13)}
    moved = np.abs(exact[-1] - [0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0])
    assert moved[:3].max() > 0.02 and np.abs(exact[:, 10:]).max() > 0.5  # the flight is one
    for part, columns in parts.items():
        apart = np.abs(getattr(flown, part) - exact[:, columns]).max()
        assert apart < 2e-5, part  # fourth order: a tenth of the noise of R8 and less


@pytest.mark.parametrize("name", ODD)
def test_the_action_that_hovers_holds_the_vehicle(name, fly):
    vehicle = odd_vehicle(name)
    action = np.full((vehicle.control_rate, 4), float(hover_action(vehicle)))
    end = fly(vehicle, hovering(vehicle, (0.0, 0.0, 1.0)), action)
    assert np.abs(end.position[-1] - [0, 0, 1]).max() < 1e-4


@pytest.mark.parametrize("name", ODD)
def test_an_action_and_its_rotor_speed_are_each_others_inverse(name):
    vehicle = odd_vehicle(name)
    actions = np.linspace(-0.9, 0.9, 7) if vehicle.action_scale is None else np.linspace(-0.4, 0.2, 7)
    speeds = commanded_rotor_speed(vehicle, actions, np)
    np.testing.assert_allclose(speeds, commands_of(vehicle, actions), rtol=1e-6)
    np.testing.assert_allclose(action_of_rotor_speed(vehicle, speeds), actions, atol=1e-6)
    here = float(hover_action(vehicle))
    ends = commanded_rotor_speed(vehicle, np.array([here - 1e-4, here + 1e-4]), np)
    assert (ends[1] - ends[0]) / 2e-4 == pytest.approx(float(rotor_speed_per_action(vehicle)), rel=1e-3)


@pytest.mark.parametrize("name", ODD)
def test_the_allocation_gives_the_thrust_and_the_torque_that_are_asked_for(name):
    vehicle = odd_vehicle(name)
    weight = vehicle.mass * vehicle.gravity
    thrust, torque = 1.05 * weight, (0.01 * weight * 0.04, -0.02 * weight * 0.04, 2e-6)
    speeds = allocate(vehicle, jnp.float32(thrust), tuple(map(jnp.float32, torque)))
    given, turning = thrust_and_torque(vehicle, speeds)
    assert float(given) == pytest.approx(thrust, rel=1e-4)
    np.testing.assert_allclose(np.stack(turning)[:2], torque[:2], rtol=1e-3)
    # drag torque that is not proportional to thrust is taken as if it were, as it is about hover
    exact = vehicle.torque_linear is None and vehicle.thrust_linear is None
    assert float(turning[2]) == pytest.approx(torque[2], rel=1e-3 if exact else 0.1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"maximum_rotor_speed_rpm": "none"}, "maximum_rotor_speed_rpm: missing. Allowed: above 0 rpm, or thrust_to_"),
        ({"thrust_to_weight": 2.0}, "thrust_to_weight: stands beside maximum_rotor_speed_rpm"),
        ({"action_scale": "none"}, "action_scale: missing. Allowed: above 0 to 3; or action_convention ="),
        ({"action_convention": "thrust"}, "action_scale: has no meaning with action_convention = thrust"),
        ({"action_convention": "throttle"}, "action_convention: 'throttle' is not allowed"),
        (
            {"thrust_linear": -1e-6},
            "thrust_linear: -1e-06 makes the thrust of a rotor negative below 3165 rpm.",
        ),
        ({"torque_linear": -1e-8}, "torque_linear: -1e-08 makes the torque of a rotor negative below 1335 rpm"),
        ({"minimum_rotor_speed_rpm": 16_100.0}, "minimum_rotor_speed_rpm: 16100 is not below the hover speed, 16004"),
        ({"products_of_inertia": [2e-5, 0.0, 0.0]}, "products_of_inertia: [2e-05, 0.0, 0.0] with inertia"),
        ({"products_of_inertia": [1.0, 0.0]}, "products_of_inertia"),
        ({"control_rate": 20}, "control_rate: 20 is not allowed. Allowed: a whole number, 50 to 1000 Hz"),
        ({"control_rate": 99.5}, "control_rate: 99.5 is not allowed"),
        ({"body_drag": [10.0, 10.0, 10.0]}, "body_drag, mass: not plausible"),
        ({"quadratic_drag": [-1.0, 0.0, 0.0]}, "quadratic_drag.0: -1.0 is not allowed"),
    ],
)
def test_what_no_vehicle_can_be_is_refused_with_what_is_allowed(changes, message):
    table = {key: value for key, value in (vehicle_table("crazyflie") | changes).items() if value != "none"}
    with pytest.raises(BadInput) as caught:
        document.read(Vehicle, table)
    assert str(caught.value).startswith(message) and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ODD)
def test_an_odd_vehicle_is_written_and_read_back_exactly(name, tmp_path):
    vehicle = odd_vehicle(name)
    (tmp_path / "odd.toml").write_text(document.write(vehicle, vehicle.sources))
    assert load_vehicle(str(tmp_path / "odd.toml")) == vehicle
