"""Actuation: mixing, allocating and hurrying the motors give back what was asked for (paper R4, R9)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from tests.layouts import LAYOUTS, with_layout

from flytune.control.actuation import action_for, allocate, estimated_rotor_speed, hovering_rotors
from flytune.physics.dynamics import CONTROL_PERIOD, rotor_speed_after
from flytune.physics.plausibility import torque_over_thrust
from flytune.physics.rotors import commanded_rotor_speed, mixed, places, spins, thrust_and_torque
from flytune.physics.vehicle import Rotors, load_vehicle, vehicle_names

VEHICLES = {name: load_vehicle(name) for name in vehicle_names()}
CURVED = [name for name, vehicle in VEHICLES.items() if vehicle.torque_linear is not None]
EXACT = [name for name in VEHICLES if name not in CURVED]
actions = st.lists(st.floats(-1, 1, width=32), min_size=4, max_size=4)


def levers(vehicle):
    """How far the rotors stand from the x axis and from the y axis, in m."""
    return np.abs(places(vehicle)).max(axis=0)[::-1]


@jax.jit
def there_and_back(vehicle, action):
    """Rotor speeds of four actions, and those that thrust and torque of these are allocated to."""
    speeds = tuple(commanded_rotor_speed(vehicle, part) for part in action)
    return speeds, allocate(vehicle, *thrust_and_torque(vehicle, speeds))


@jax.jit
def delivered(vehicle, thrust, torque):
    """Rotor speeds, and the thrust and torque that they give."""
    speeds = allocate(vehicle, thrust, torque)
    return speeds, *thrust_and_torque(vehicle, speeds)


@pytest.mark.parametrize("name", EXACT)
@settings(max_examples=50)
@given(action=actions)
def test_allocating_what_rotors_give_gives_back_the_rotors(name, action):
    speeds, back = there_and_back(VEHICLES[name], tuple(map(jnp.float32, action)))
    # squares of 2.6e8 rpm^2 are sums of four terms of that size in float32 (6e-8 each): 1e-6 of a speed; where the
    # slowest rotor has a small share of the fastest one's square, more of it
    sizes = np.stack(speeds)
    np.testing.assert_allclose(np.stack(back), sizes, rtol=0, atol=2e-6 * sizes.max() ** 2 / sizes.min())


@pytest.mark.parametrize("name", CURVED)
@settings(max_examples=50)
@given(action=actions)
def test_where_torque_has_a_linear_part_yaw_torque_alone_is_near(name, action):
    vehicle = VEHICLES[name]
    speeds, back = there_and_back(vehicle, tuple(map(jnp.float32, action)))
    # yaw torque is taken as proportional to thrust, so that rotors differ a little, and thrust, roll and pitch do not
    np.testing.assert_allclose(np.stack(back), np.stack(speeds), rtol=1e-2)
    wanted, given_back = thrust_and_torque(vehicle, speeds), thrust_and_torque(vehicle, back)
    np.testing.assert_allclose(given_back[0], wanted[0], rtol=1e-5)
    np.testing.assert_allclose(given_back[1][:2], wanted[1][:2], atol=1e-5 * wanted[0] * levers(vehicle)[0])


@pytest.mark.parametrize("name", VEHICLES)
def test_a_torque_within_reach_is_given_exactly_beside_the_weight(name):
    vehicle = VEHICLES[name]
    weight = vehicle.mass * vehicle.gravity
    bending = weight * levers(vehicle)
    torque = (2e-2 * bending[0], -3e-2 * bending[1], 1e-5)
    _, thrust, given_torque = delivered(vehicle, weight, torque)
    # float32: differences of squares that are each a quarter of the weight, 2e-7 of it
    np.testing.assert_allclose(thrust, weight, rtol=1e-6)
    np.testing.assert_allclose(given_torque[:2], torque[:2], atol=1e-6 * bending[0])
    turning = torque_over_thrust(vehicle) * weight
    np.testing.assert_allclose(given_torque[2], torque[2], atol=(1e-3 if name in CURVED else 1e-6) * turning)


@pytest.mark.parametrize("name", VEHICLES)
def test_a_saturated_yaw_torque_gives_way_and_leaves_thrust_roll_and_pitch_alone(name):
    vehicle = VEHICLES[name]
    weight = vehicle.mass * vehicle.gravity
    torque = (0.1 * weight * levers(vehicle)[0], 0.05 * weight * levers(vehicle)[1], 1.0)
    _, thrust, given_torque = delivered(vehicle, weight, torque)
    np.testing.assert_allclose(thrust, weight, rtol=1e-6)
    np.testing.assert_allclose(given_torque[:2], torque[:2], rtol=1e-4)
    assert 0 < given_torque[2] < 1.0


@pytest.mark.parametrize("name", VEHICLES)
def test_thrust_gives_way_to_roll_and_pitch(name):
    vehicle = VEHICLES[name]
    weight = vehicle.mass * vehicle.gravity
    largest = weight * vehicle.full_thrust_to_weight
    torque = (0.1 * weight * levers(vehicle)[0], 0.1 * weight * levers(vehicle)[1], 0.0)
    _, thrust, given_torque = delivered(vehicle, 10 * weight, torque)
    np.testing.assert_allclose(given_torque[:2], torque[:2], rtol=1e-4)
    # of rotors 0 and 2, one is at its limit and the other (tau_x + tau_y) / (2 l) = 0.1 weights below it;
    # 1 and 3 are both at the limit, where roll and pitch cancel; in plus configuration, each pair has one at the limit
    # and the other 0.1 weights below it
    pairs = 2 if name == "hummingbird" else 1
    np.testing.assert_allclose(thrust, largest - pairs * 0.1 * weight, rtol=1e-4)


@pytest.mark.parametrize("name", VEHICLES)
@settings(max_examples=50)
@given(numbers=st.lists(st.floats(-50, 50, width=32), min_size=4, max_size=4))
def test_whatever_is_asked_for_the_rotors_stay_in_the_range_of_the_actions(name, numbers):
    vehicle = VEHICLES[name]
    speeds, _, _ = delivered(vehicle, jnp.float32(numbers[0]), tuple(map(jnp.float32, numbers[1:])))
    lowest, highest = (float(commanded_rotor_speed(vehicle, jnp.float32(a))) for a in (-1, 1))
    # float32 beside squares of 6e8
    assert np.all(np.stack(speeds) >= lowest * (1 - 1e-5)) and np.all(np.stack(speeds) <= highest * (1 + 1e-5))


def test_too_much_roll_and_pitch_keeps_its_direction():
    vehicle = VEHICLES["crazyflie"]
    _, _, torque = delivered(vehicle, vehicle.mass * vehicle.gravity, (1.0, -0.5, 0.0))
    np.testing.assert_allclose(torque[1] / torque[0], -0.5, rtol=1e-5)


def test_mixing_squares_is_the_mixer_of_the_physics():
    vehicle = VEHICLES["crazyflie"]
    speeds = tuple(map(jnp.float32, (15000.0, 16000.0, 16500.0, 14000.0)))
    thrust, torque = mixed(vehicle, tuple(s * s for s in speeds))
    wanted_thrust, wanted_torque = thrust_and_torque(vehicle, speeds)
    np.testing.assert_allclose(thrust, wanted_thrust, rtol=1e-6)
    np.testing.assert_allclose(torque, wanted_torque, rtol=1e-5)


# --- other layouts of rotors ---


@pytest.mark.parametrize("name", LAYOUTS)
@settings(max_examples=50)
@given(action=actions)
def test_allocating_what_the_rotors_of_any_layout_give_gives_back_the_rotors(name, action):
    speeds, back = there_and_back(with_layout(name), tuple(map(jnp.float32, action)))
    np.testing.assert_allclose(np.stack(back), np.stack(speeds), rtol=4e-6)


def asked(vehicle, number):
    """Thrusts and torques, within reach and far beyond."""
    draw = np.random.default_rng(0)
    weight = vehicle.mass * vehicle.gravity
    arms = np.array([0.03, 0.03, vehicle.torque_coefficient / vehicle.thrust_coefficient])
    size = draw.choice([0.1, 0.5, 2.0], (number, 1))
    return weight * draw.uniform(-0.5, 3, number), weight * arms * size * draw.normal(size=(number, 3))


def test_the_general_allocation_is_that_of_the_x_configuration_for_its_places():
    vehicle = VEHICLES["crazyflie"]
    layout = Rotors(place=tuple(map(tuple, places(vehicle).tolist())), spin=spins(vehicle))
    other = dataclasses.replace(vehicle, arm=None, rotors=layout)
    thrust, torque = (jnp.float32(part) for part in asked(vehicle, 200))
    one, two = (
        jax.vmap(lambda f, t, v=v: jnp.stack(allocate(v, f, (t[0], t[1], t[2]))))(thrust, torque)
        for v in (vehicle, other)
    )
    np.testing.assert_allclose(one, two, rtol=1e-5)


@pytest.mark.parametrize("name", LAYOUTS)
def test_yaw_gives_way_first_then_thrust_then_roll_and_pitch(name):
    # the same order of priorities by three linear programmes, on the squares of rotor speeds
    vehicle = with_layout(name)
    place, spin = np.array(LAYOUTS[name].place), np.array(LAYOUTS[name].spin)
    kf, km = vehicle.thrust_coefficient, vehicle.torque_coefficient
    columns = np.linalg.inv(np.stack([np.full(4, kf), kf * place[:, 1], -kf * place[:, 0], km * spin]))
    hover = vehicle.hover_rotor_speed_rpm
    limits = (hover / 2) ** 2, min(1.5 * hover, vehicle.maximum_rotor_speed_rpm) ** 2
    for thrust, torque in zip(*asked(vehicle, 30), strict=True):
        wanted = 1.0, thrust, torque[2]
        terms = np.c_[columns[:, 1:3] @ torque[:2], columns[:, 0], columns[:, 3]]  # of share, thrust, yaw torque
        scale = np.array([1.0, vehicle.mass * 9.81, vehicle.mass * 9.81 * km / kf])
        rows = np.r_[terms, -terms] * scale / hover**2
        ends = np.r_[np.full(4, limits[1]), np.full(4, -limits[0])] / hover**2
        found = []
        for index in range(3):
            reached = [
                linprog(
                    sign * np.eye(3)[index], rows, ends, bounds=[(x, x) for x in found] + [(None, None)] * (3 - index)
                )
                for sign in (1, -1)
            ]
            low, high = (
                each.x[index] if each.status == 0 else bound for each, bound in zip(reached, (-1e9, 1e9), strict=True)
            )
            found.append(float(np.clip(wanted[index] / scale[index], max(low, 0.0 if index == 0 else low), high)))
        squares = terms * scale @ found
        speeds = allocate(vehicle, jnp.float32(thrust), tuple(map(jnp.float32, torque)))
        np.testing.assert_allclose(np.stack(speeds), np.sqrt(squares), rtol=2e-4)


# --- motors ---


@pytest.mark.parametrize("name", VEHICLES)
def test_rotors_at_hover_speed_need_no_action(name):
    vehicle = VEHICLES[name]
    now = hovering_rotors(vehicle)
    np.testing.assert_allclose(action_for(vehicle, now, now, 0.02), 0, atol=1e-6)


@pytest.mark.parametrize("direction", [1, -1])
def test_a_lagging_motor_is_hurried_to_the_time_constant_asked_for(direction):
    # after one period a first-order motor of 0.02 s has closed 1 - exp(-0.01/0.02) = 39.35 % of a gap of 40 rpm
    vehicle = VEHICLES["crazyflie-measured"]
    now = hovering_rotors(vehicle)
    wanted = tuple(speed + direction * 40.0 for speed in now)
    action = action_for(vehicle, now, wanted, 0.02)
    commanded = tuple(commanded_rotor_speed(vehicle, part) for part in action)
    after = rotor_speed_after(vehicle, now, commanded, CONTROL_PERIOD)
    # float32 at 19,000 rpm is exact to 0.002 rpm; the action adds as much
    np.testing.assert_allclose(np.stack(after) - np.stack(now), direction * 15.739, atol=0.02)


def test_a_motor_that_answers_at_once_is_not_hurried():
    vehicle = VEHICLES["crazyflie"]
    now = hovering_rotors(vehicle)
    wanted = tuple(speed + 800.0 for speed in now)
    np.testing.assert_array_equal(action_for(vehicle, now, wanted, 0.02), action_for(vehicle, now, wanted))


def test_the_rotors_a_pilot_believes_in_are_those_that_turn():
    vehicle = VEHICLES["crazyflie-measured"]
    believed = turning = hovering_rotors(vehicle)
    for action in np.random.default_rng(0).uniform(-1, 1, (20, 4)).astype(np.float32):
        commanded = tuple(commanded_rotor_speed(vehicle, part) for part in action)
        turning = rotor_speed_after(vehicle, turning, commanded, CONTROL_PERIOD)
        believed = estimated_rotor_speed(vehicle, believed, tuple(map(jnp.float32, action)))
    np.testing.assert_array_equal(np.stack(believed), np.stack(turning))
