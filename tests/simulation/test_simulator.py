"""Worlds by name, their frames, and the rotors they share: the same equations as flytune's own physics."""

import dataclasses
import math
from typing import get_args, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytune.cli.options import FlightOptions
from flytune.errors import BadInput
from flytune.physics import dynamics
from flytune.physics.vehicle import load_vehicle
from flytune.simulation.actuator import Actuator
from flytune.simulation.aerodynamics import LARGEST_GROUND_EFFECT, drag, ground_effect
from flytune.simulation.simulator import VehicleStates, rotation_matrix, to_body, to_inertial
from flytune.simulation.simulators import SIMULATORS, make_simulator


@pytest.fixture(scope="module")
def paper():
    """The paper's Crazyflie."""
    return load_vehicle("crazyflie")


@pytest.fixture(scope="module")
def late():
    """The measured Crazyflie, its motors lagging and its actions two periods late."""
    return dataclasses.replace(load_vehicle("crazyflie-measured"), action_latency_steps=2)


@pytest.fixture(scope="module")
def attitudes():
    """Twenty random attitudes, unit quaternions (x, y, z, w)."""
    return Rotation.random(20, rng=np.random.default_rng(0)).as_quat()


# --- names and options ---


@pytest.mark.parametrize(
    ("name", "number", "options", "line"),
    [
        ("gazebo", 1, None, "world: 'gazebo' is not allowed. Allowed: flytune, pybullet, mujoco."),
        ("flytune", 0, None, "number: 0 is not allowed. Allowed: a whole number, 1 or more."),
        (
            "flytune",
            1,
            {"physics_steps": 0},
            "world flytune: physics_steps: 0 is not allowed. Allowed: a whole number, 1 to 100 per control period.",
        ),
        (
            "pybullet",
            1,
            {"dampng": 0.1},
            "world pybullet: dampng: no such field. Did you mean damping (allowed: 0 to 1)?",
        ),
        (
            "pybullet",
            1,
            {"damping": -0.1},
            "world pybullet: damping: -0.1 is not allowed. Allowed: 0 to 1 1/s.",
        ),
        (
            "pybullet",
            1,
            {"ground_effect": "yes please"},
            "world pybullet: ground_effect: 'yes please' is not allowed. Allowed: true or false.",
        ),
        (
            "mujoco",
            1,
            {"integrator": "euler"},
            "world mujoco: integrator: 'euler' is not allowed. Allowed: one of RK4, Euler, implicit, implicitfast.",
        ),
    ],
)
def test_what_makes_no_world_is_refused_in_one_line(paper, name, number, options, line):
    with pytest.raises(BadInput) as caught:
        make_simulator(name, paper, number, options)
    assert str(caught.value) == line


# --- frames ---


def test_rotation_matrices_are_those_of_scipy(attitudes):
    np.testing.assert_allclose(rotation_matrix(attitudes), Rotation.from_quat(attitudes).as_matrix(), atol=1e-14)


def test_vectors_go_from_body_to_inertial_frame_and_back(attitudes):
    vectors = np.random.default_rng(1).normal(size=(20, 3))
    seen = to_inertial(attitudes, vectors)
    np.testing.assert_allclose(seen, Rotation.from_quat(attitudes).apply(vectors), atol=1e-14)
    np.testing.assert_allclose(to_body(attitudes, seen), vectors, atol=1e-14)


# --- rotors ---


@pytest.mark.parametrize("name", ["paper", "late"])
def test_rotors_turn_as_in_flytunes_physics(name, request):
    vehicle = request.getfixturevalue(name)
    # a limit the actions reach, and actions beyond 1: both are clipped
    vehicle = dataclasses.replace(vehicle, maximum_rotor_speed_rpm=1.1 * vehicle.hover_rotor_speed_rpm)
    actions = np.random.default_rng(2).uniform(-1.5, 1.5, (40, 4)).astype(np.float32)

    @jax.jit
    def expected(actions):
        def advance(state, action):
            state = dynamics.step(vehicle, state, action)
            return state, jnp.stack(state.rotor_speed_rpm)

        return jax.lax.scan(advance, dynamics.hovering(vehicle, (0.0, 0.0, 0.0)), actions)[1]

    actuator, flown = Actuator(vehicle, 2), []
    for action in actions:
        actuator.command(np.stack([action, 0 * action]))
        for _ in range(3):
            actuator.turn(dynamics.CONTROL_PERIOD / 3)
        flown.append(actuator.rotor_speed_rpm.copy())
    flown = np.array(flown)
    # float32 against float64: 40 roundings of 6e-8 at most
    np.testing.assert_allclose(flown[:, 0], expected(actions), rtol=3e-6)
    np.testing.assert_allclose(flown[:, 1], vehicle.hover_rotor_speed_rpm, rtol=1e-12)
    limit = vehicle.maximum_rotor_speed_rpm
    assert (flown.max() == limit) if name == "paper" else (flown.max() < limit)  # one that lags does not get there


def test_a_lagging_rotor_answers_exponentially_and_forces_are_those_of_the_middle(late):
    actuator = Actuator(dataclasses.replace(late, action_latency_steps=0), 1)
    hover = late.hover_rotor_speed_rpm
    actuator.command(np.array([[0.9, 0.9, -0.9, -0.9]]))
    middle = actuator.turn(0.02)
    for speeds, elapsed in ((middle, 0.01), (actuator.rotor_speed_rpm, 0.02)):
        rising = 1 - math.exp(-elapsed / late.motor_rise_time_constant)
        falling = 1 - math.exp(-elapsed / late.motor_fall_time_constant)
        change = 0.9 * hover * late.action_scale * np.array([rising, rising, -falling, -falling])
        np.testing.assert_allclose(speeds[0], hover + change, rtol=1e-12)


def test_placing_takes_back_the_actions_under_way_of_those_placed_only(late):
    actuator = Actuator(late, 2)
    hover = late.hover_rotor_speed_rpm
    actuator.command(np.ones((2, 4)))
    actuator.place(np.full((1, 4), hover), np.array([1]))
    for _ in range(3):
        actuator.command(np.zeros((2, 4)))
        actuator.turn(0.01)
    assert np.all(actuator.rotor_speed_rpm[0] > hover + 1)
    np.testing.assert_allclose(actuator.rotor_speed_rpm[1], hover, rtol=1e-12)


# --- air ---


def test_ground_effect_falls_with_height_and_is_bounded(paper):
    height = np.linspace(-0.1, 2.0, 200)
    position = np.stack([0 * height, 0 * height, height], axis=-1)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (200, 1))
    gain = ground_effect(paper, position, level)
    assert np.all(np.diff(gain, axis=0) <= 0) and np.all(gain > 0)
    assert gain.max() == pytest.approx(LARGEST_GROUND_EFFECT, rel=1e-12)
    # by hand at 0.5 m: 11.36859 (23.1348e-3 / 2)^2 = 1.5212e-3
    at_half = ground_effect(paper, np.array([[0, 0, 0.5]]), level[:1])
    np.testing.assert_allclose(at_half, 1.5212e-3, rtol=1e-4)


def test_the_lower_propellers_of_a_tilted_vehicle_gain_more_and_those_on_its_back_nothing(paper):
    # the left side, motors 2 and 3, goes up by sin(20 deg) times the lever, 28.09 mm: 9.61 mm
    roll = Rotation.from_euler("x", [[20], [180]], degrees=True).as_quat()
    gain = ground_effect(paper, np.array([[0, 0, 0.1], [0, 0, 0.1]]), roll)
    np.testing.assert_allclose(gain[0, :2] / gain[0, 2:], (109.61 / 90.39) ** 2, rtol=1e-3)
    assert not gain[1].any()


def test_rotor_drag_opposes_motion_along_the_bodys_axes_and_grows_with_rotor_speed(paper, attitudes):
    windy = dataclasses.replace(paper, rotor_drag=paper.optional_rotor_drag)
    rpm = np.full((20, 4), 15_000.0)
    turning = 4 * 15_000 * 2 * math.pi / 60  # rad/s
    for axis, coefficient in enumerate((9.1785e-7, 9.1785e-7, 10.311e-7)):
        velocity = 0.5 * rotation_matrix(attitudes)[:, :, axis]  # 0.5 m/s along one axis of each body
        force = to_inertial(attitudes, drag(windy, attitudes, velocity, rpm))
        np.testing.assert_allclose(force, -coefficient * turning * velocity, atol=1e-15)
    np.testing.assert_allclose(
        drag(windy, attitudes, velocity, 2 * rpm), 2 * drag(windy, attitudes, velocity, rpm), rtol=1e-12
    )


def test_each_vehicle_has_its_own_air(paper, attitudes):
    # ten times the coefficients, ten times the force; a vehicle that does not say them has none
    velocity, rpm = np.tile([1.0, 2.0, 3.0], (20, 1)), np.full((20, 4), 15_000.0)
    high = np.array([[0.0, 0.0, 1.0]])
    for factor in (0, 10):
        windy = dataclasses.replace(paper, rotor_drag=paper.optional_rotor_drag)
        other = dataclasses.replace(
            paper, rotor_drag=tuple(factor * each for each in windy.rotor_drag), ground_effect=factor * 11.36859
        )
        force = factor * drag(windy, attitudes, velocity, rpm)
        np.testing.assert_allclose(drag(other, attitudes, velocity, rpm), force, rtol=1e-12, atol=1e-15)
        gain = factor * ground_effect(paper, high, attitudes[:1])
        np.testing.assert_allclose(ground_effect(other, high, attitudes[:1]), gain, rtol=1e-12, atol=1e-15)


# --- flytune as a world ---


def test_flytunes_world_is_flytunes_physics(late):
    simulator = make_simulator("flytune", late, 2)
    state = dynamics.hovering(late, (0.5, -0.5, 1.0))
    position = np.tile([0.5, -0.5, 1.0], (2, 1))
    still = np.zeros((2, 3))
    hover = np.full((2, 4), late.hover_rotor_speed_rpm)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    simulator.place(
        VehicleStates(position=position, attitude=level, velocity=still, body_rate=still, rotor_speed_rpm=hover)
    )
    step = jax.jit(dynamics.step, static_argnames="physics_steps")
    for action in np.random.default_rng(3).uniform(-1.2, 1.2, (15, 4)).astype(np.float32):
        simulator.advance(np.stack([0 * action, action]))
        state = step(late, state, jnp.asarray(action))
    for name in ("position", "attitude", "velocity", "body_rate", "rotor_speed_rpm"):
        found = getattr(simulator.states(), name)[1]
        np.testing.assert_allclose(found, np.array(getattr(state, name)), atol=1e-6, rtol=1e-6, err_msg=name)


def test_the_command_line_offers_every_simulator():
    choices = get_args(get_type_hints(FlightOptions)["simulator"])
    assert choices == tuple(SIMULATORS)
