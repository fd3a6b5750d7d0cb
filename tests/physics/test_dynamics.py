"""The equations of motion: worked-out steps, conserved quantities, symmetries (paper R1 to R6, R9)."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytune.physics.dynamics import State, hovering
from flytune.physics.vehicle import load_vehicle, vehicle_names

WEIGHT = 0.033 * 9.81  # N, paper R5
MOTOR_FORCE = WEIGHT / 4  # N, of one motor at hover
LEVER = 39.73e-3 / math.sqrt(2)  # m


def state(vehicle, **changes):
    """A hover at the origin with some parts changed, vectors given as plain sequences."""
    parts = {name: tuple(jnp.float32(part) for part in vector) for name, vector in changes.items()}
    return dataclasses.replace(hovering(vehicle, (0.0, 0.0, 0.0)), **parts)


def without_thrust(vehicle):
    """The vehicle with a motor limit of 0 rpm: actions ask for at least half the hover speed and get nothing."""
    return dataclasses.replace(vehicle, maximum_rotor_speed_rpm=0.0)


@pytest.fixture
def once(fly):
    """The state one control period later, vectors as arrays."""

    def run(vehicle, start, action):
        flown = fly(vehicle, start, [action])
        return {name: getattr(flown, name)[0] for name in ("position", "attitude", "velocity", "body_rate")}

    return run


# --- single steps by hand ---


def test_rolling_to_the_left_motors_up_gives_the_worked_out_rate(paper, once):
    # a = 0.1 (-, -, +, +): rotor speeds 0.95 and 1.05 of hover, forces 0.9025 and 1.1025 of 0.08093 N
    # tau_x = l 2 f (1.1025 - 0.9025) = 0.028093 m * 2 * 0.08093 N * 0.2 = 9.0947e-4 N m
    # w_x = tau_x / Ixx * 0.01 s = 9.0947e-4 / 1.7108e-5 * 0.01 = 0.53160 rad/s
    after = once(paper, state(paper), [-0.1, -0.1, 0.1, 0.1])
    torque = LEVER * 2 * MOTOR_FORCE * 0.2
    assert torque == pytest.approx(9.0947e-4, rel=1e-4)
    np.testing.assert_allclose(after["body_rate"], [torque / 1.7108e-5 * 0.01, 0, 0], rtol=1e-5, atol=1e-7)
    assert after["body_rate"][0] == pytest.approx(0.53160, rel=1e-4)
    # the angle is w_x t / 2 at constant torque; thrust leans to -y, the side of the slower motors
    assert after["attitude"][0] == pytest.approx(math.sin(0.53160 * 0.01 / 4), rel=1e-4)
    assert after["velocity"][1] < 0


def test_pitching_lowers_the_nose_forwards(paper, once):
    # motors 1 and 2 are behind (-x): faster, they push the tail up, tau_y > 0, and thrust leans to +x
    after = once(paper, state(paper), [-0.1, 0.1, 0.1, -0.1])
    np.testing.assert_allclose(after["body_rate"], [0, 0.53160, 0], rtol=1e-4, atol=1e-7)
    assert after["velocity"][0] > 0


def test_yawing_turns_against_the_faster_propellers(paper, once):
    # km rpm^2 = 7.49e-12 * 0.033 * 9.81 / (4 * 3.16e-10) = 1.91830e-3 N m at hover
    # tau_z = 1.91830e-3 * 2 (1.1025 - 0.9025) = 7.6732e-4 N m; / 2.6517e-5 kg m^2 * 0.01 s = 0.28937 rad/s
    after = once(paper, state(paper), [-0.1, 0.1, -0.1, 0.1])
    np.testing.assert_allclose(after["body_rate"], [0, 0, 0.28937], rtol=1e-4, atol=1e-7)


def test_full_action_climbs_with_the_worked_out_acceleration(paper, once):
    # thrust (1.5)^2 = 2.25 weights: a = 1.25 g = 12.2625 m/s^2; v = a t = 0.122625 m/s, z = a t^2 / 2 = 6.13125e-4 m
    after = once(paper, state(paper), [1.0, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(after["velocity"], [0, 0, 0.122625], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(after["position"], [0, 0, 6.13125e-4], rtol=1e-5, atol=1e-10)


def test_no_action_is_hover_and_full_reverse_a_quarter_of_the_thrust(paper, once):
    # (1 - 1/2)^2 = 0.25 weights: a = -0.75 g = -7.3575 m/s^2
    after = once(paper, state(paper), [-1.0, -1.0, -1.0, -1.0])
    assert after["velocity"][2] == pytest.approx(-7.3575e-2, rel=1e-5)


def test_actions_beyond_the_box_are_clipped(paper, fly):
    beyond, within = (fly(paper, state(paper), [a]) for a in ([3.0, -7.0, 1.2, -1.01], [1.0, -1.0, 1.0, -1.0]))
    np.testing.assert_array_equal(beyond.rotor_speed_rpm, within.rotor_speed_rpm)
    np.testing.assert_array_equal(beyond.body_rate, within.body_rate)


def test_a_motor_is_not_driven_beyond_its_limit(paper, fly):
    # 20,000 rpm is less than the 24,005 rpm that full action asks for, and more than 0.5 asks for: 16,004 * 1.25
    limited = dataclasses.replace(paper, maximum_rotor_speed_rpm=20_002.0)
    flown = fly(limited, state(limited), [[1.0, 0.249, -1.0, 0.0]])
    expected = 16_003.6 * np.array([0, 1.1245, 0.5, 1]) + [20_002, 0, 0, 0]
    np.testing.assert_allclose(flown.rotor_speed_rpm[0], expected, rtol=1e-5)


# --- motors ---


def test_a_motor_speeds_up_and_slows_down_with_its_own_time_constants(paper, fly):
    # rpm(t) = goal + (hover - goal) exp(-t / tau): after t = tau, 63.2 % of the way
    lagging = dataclasses.replace(paper, motor_rise_time_constant=0.1, motor_fall_time_constant=0.05)
    flown = fly(lagging, state(lagging), np.tile([0.5, -0.5, 0.0, 1.0], (30, 1)))
    hover, time = paper.hover_rotor_speed_rpm, np.arange(1, 31) / 100
    np.testing.assert_allclose(flown.rotor_speed_rpm[:, 0], hover * (1.25 - 0.25 * np.exp(-time / 0.1)), rtol=1e-5)
    np.testing.assert_allclose(flown.rotor_speed_rpm[:, 1], hover * (0.75 + 0.25 * np.exp(-time / 0.05)), rtol=1e-5)
    np.testing.assert_allclose(flown.rotor_speed_rpm[:, 2], hover, rtol=1e-6)
    np.testing.assert_allclose(flown.rotor_speed_rpm[:, 3], hover * (1.5 - 0.5 * np.exp(-time / 0.1)), rtol=1e-5)


def test_a_motor_without_a_time_constant_follows_at_once(paper, fly):
    flown = fly(paper, state(paper), [[0.5, -0.5, 0.0, 1.0]])
    expected = paper.hover_rotor_speed_rpm * np.array([1.25, 0.75, 1.0, 1.5])
    np.testing.assert_allclose(flown.rotor_speed_rpm[0], expected, rtol=1e-6)


def test_one_time_constant_may_be_zero_and_the_other_not(paper, fly):
    mixed = dataclasses.replace(paper, motor_rise_time_constant=0.1, motor_fall_time_constant=0.0)
    flown = fly(mixed, state(mixed), [[0.5, -0.5, 0.5, -0.5]])
    rising = 1.25 - 0.25 * math.exp(-0.1)
    np.testing.assert_allclose(flown.rotor_speed_rpm[0] / 16_003.6, [rising, 0.75, rising, 0.75], rtol=1e-5)


@pytest.mark.parametrize("latency", [1, 3])
def test_latency_delays_the_motors_by_exactly_that_many_control_steps(paper, fly, latency):
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 4))
    late = dataclasses.replace(paper, action_latency_steps=latency)
    delayed, prompt = fly(late, state(late), actions), fly(paper, state(paper), actions)
    hover = np.full((latency, 4), paper.hover_rotor_speed_rpm, np.float32)  # nothing has been asked for yet
    np.testing.assert_allclose(delayed.rotor_speed_rpm[:latency], hover, rtol=1e-6)
    np.testing.assert_array_equal(delayed.rotor_speed_rpm[latency:], prompt.rotor_speed_rpm[:-latency])
    np.testing.assert_array_equal(delayed.pending_actions[-1], actions[-latency:].astype(np.float32))


# --- what must be conserved ---


def test_free_fall_is_a_parabola(paper, fly):
    falling = without_thrust(paper)
    start = state(falling, position=(1.0, -2.0, 3.0), velocity=(0.5, -0.25, 2.0), body_rate=(0.3, 0.2, -0.1))
    flown, t = fly(falling, start, np.zeros((100, 4))), (np.arange(1, 101) / 100)[:, None]
    position = [1.0, -2.0, 3.0] + [0.5, -0.25, 2.0] * t - [0, 0, 9.81 / 2] * t**2
    np.testing.assert_allclose(flown.position, position, atol=1e-5)
    np.testing.assert_allclose(flown.velocity, [0.5, -0.25, 2.0] - [0, 0, 9.81] * t, atol=1e-5)


def test_a_spin_without_torque_keeps_its_energy_and_its_angular_momentum(paper, fly):
    # three different moments, spun near the middle axis: it tumbles, and only 2 E = w.Iw and R(q) I w stay
    tumbling = dataclasses.replace(without_thrust(paper), inertia=(1.4e-5, 1.9e-5, 2.6e-5))
    inertia, rate = np.array(tumbling.inertia), np.array([0.2, 6.0, 0.1])
    flown = fly(tumbling, state(tumbling, body_rate=rate), np.zeros((1000, 4)))
    momentum = Rotation.from_quat(flown.attitude).apply(inertia * flown.body_rate)
    assert flown.body_rate[:, 1].min() < -5  # it did turn over
    np.testing.assert_allclose(np.sum(inertia * flown.body_rate**2, axis=-1), rate @ (inertia * rate), rtol=1e-4)
    size = np.linalg.norm(inertia * rate)
    np.testing.assert_allclose(momentum / size, np.tile(inertia * rate / size, (1000, 1)), atol=5e-4)


@pytest.mark.parametrize("name", vehicle_names())
def test_no_action_hovers_for_ten_seconds(name, fly):
    # Hover is unstable. float32 knows the force of two motors to 2 * 0.081 N * 2^-24 = 1e-8 N, a residual torque of
    # 2.8e-10 N m at the lever, 1.6e-5 rad/s^2; after t = 10 s: 1.6e-4 rad/s, and g 1.6e-5 t^4 / 24 = 0.07 m aside.
    vehicle = load_vehicle(name)
    flown = fly(vehicle, state(vehicle), np.zeros((1000, 4)))
    assert np.abs(flown.position[-1, :2]).max() < 0.07
    assert np.abs(flown.position[-1, 2]) < 1e-3
    assert np.abs(flown.body_rate[-1]).max() < 1.6e-4


@pytest.mark.parametrize("name", vehicle_names())
def test_the_attitude_stays_a_unit_quaternion_under_random_actions(name, fly):
    vehicle = load_vehicle(name)
    flown = fly(vehicle, state(vehicle), np.random.default_rng(1).uniform(-1, 1, (1000, 4)))
    np.testing.assert_allclose(np.linalg.norm(flown.attitude, axis=-1), 1, atol=1e-6)
    assert np.abs(flown.body_rate).max() > 1  # it did turn


def test_drag_slows_a_level_flight_exponentially(paper, fly):
    # v' = -(d / m) v: v = v0 exp(-d t / m), x = v0 m / d (1 - exp(-d t / m)); d / m = 0.0147 / 0.033 = 0.445 per s
    slowed = dataclasses.replace(paper, drag=(0.0147, 0.0147, 0.0128))
    flown = fly(slowed, state(slowed, velocity=(2.0, -1.0, 0.0)), np.zeros((200, 4)))
    k, t = 0.0147 / 0.033, (np.arange(1, 201) / 100)[:, None]
    # the residual torque of float32 (see the hover) costs up to g 1.6e-5 t^3 / 6 = 2e-4 m/s in 2 s
    np.testing.assert_allclose(flown.velocity[:, :2], [2.0, -1.0] * np.exp(-k * t), atol=2e-4)
    np.testing.assert_allclose(flown.position[:, :2], [2.0, -1.0] * (1 - np.exp(-k * t)) / k, atol=2e-4)


def test_a_fall_through_drag_ends_at_the_terminal_speed(paper, fly):
    # m g = d v: v = 0.033 * 9.81 / 0.3 = 1.0791 m/s, reached with a time constant of m / d = 0.11 s
    falling = dataclasses.replace(without_thrust(paper), drag=(0.3, 0.3, 0.3))
    flown = fly(falling, state(falling), np.zeros((200, 4)))
    assert flown.velocity[-1, 2] == pytest.approx(-1.0791, rel=1e-4)
    assert flown.velocity[10, 2] == pytest.approx(-1.0791 * (1 - math.exp(-0.11 / 0.11)), rel=1e-4)


# --- symmetries ---

TUMBLE = {
    "position": (0.3, -0.4, 1.2),
    "attitude": tuple(Rotation.from_euler("ZYX", [0.7, 0.2, -0.3]).as_quat()),
    "velocity": (0.4, 0.2, -0.3),
    "body_rate": (1.0, -0.5, 0.7),
}


@pytest.mark.parametrize("vehicle", ["paper", "measured"])
def test_a_turned_world_gives_the_turned_flight(vehicle, request, fly):
    vehicle = request.getfixturevalue(vehicle)
    actions, turn = np.random.default_rng(2).uniform(-0.5, 0.5, (100, 4)), Rotation.from_euler("Z", 1.1)
    turned = TUMBLE | {
        "position": turn.apply(TUMBLE["position"]),
        "attitude": (turn * Rotation.from_quat(TUMBLE["attitude"])).as_quat(),
        "velocity": turn.apply(TUMBLE["velocity"]),
    }
    here, there = (fly(vehicle, state(vehicle, **start), actions) for start in (TUMBLE, turned))
    np.testing.assert_allclose(there.position, turn.apply(here.position), atol=1e-4)
    np.testing.assert_allclose(there.velocity, turn.apply(here.velocity), atol=1e-4)
    np.testing.assert_allclose(there.body_rate, here.body_rate, atol=1e-4)
    apart = (turn * Rotation.from_quat(here.attitude)).inv() * Rotation.from_quat(there.attitude)
    assert apart.magnitude().max() < 1e-4


@pytest.mark.parametrize("vehicle", ["paper", "measured"])
def test_a_mirrored_world_gives_the_mirrored_flight(vehicle, request, fly):
    # y -> -y: vectors turn their y round; rates, being axial, their x and z; (x, y, z, w) becomes (-x, y, -z, w).
    # Motors 0 and 3, 1 and 2 change places; they turn opposite ways, so the vehicle is its own mirror image.
    vehicle = request.getfixturevalue(vehicle)
    signs = {
        "position": np.array([1, -1, 1]),
        "attitude": np.array([-1, 1, -1, 1]),
        "velocity": np.array([1, -1, 1]),
        "body_rate": np.array([-1, 1, -1]),
    }
    actions = np.random.default_rng(3).uniform(-0.5, 0.5, (100, 4))
    here = fly(vehicle, state(vehicle, **TUMBLE), actions)
    start = state(vehicle, **{name: signs[name] * np.array(part) for name, part in TUMBLE.items()})
    there = fly(vehicle, start, actions[:, [3, 2, 1, 0]])
    for name, sign in signs.items():
        np.testing.assert_allclose(getattr(there, name), sign * getattr(here, name), atol=1e-4, err_msg=name)


# --- the vehicle at rest ---


def test_a_hovering_vehicle_is_at_rest_with_its_rotors_at_hover_speed(paper):
    late = dataclasses.replace(paper, action_latency_steps=2)
    hover = hovering(late, (1.0, 2.0, 3.0))
    assert isinstance(hover, State)
    assert [float(part) for part in hover.attitude] == [0, 0, 0, 1]
    assert [float(part) for part in (*hover.velocity, *hover.body_rate)] == [0] * 6
    assert np.array(hover.rotor_speed_rpm) == pytest.approx(16_003.6, rel=1e-4)
    assert hover.pending_actions.shape == (2, 4) and not hover.pending_actions.any()


def test_more_physics_steps_describe_the_same_flight(paper, fly):
    actions = np.random.default_rng(4).uniform(-0.5, 0.5, (50, 4))
    coarse, fine = (fly(paper, state(paper, **TUMBLE), actions, n) for n in (1, 4))
    np.testing.assert_allclose(coarse.position, fine.position, atol=1e-4)
    np.testing.assert_allclose(coarse.attitude, fine.attitude, atol=1e-4)
