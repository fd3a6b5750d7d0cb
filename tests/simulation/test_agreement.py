"""PyBullet and MuJoCo as worlds: the laws of motion both must keep, each to the order of its integrator."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.layouts import LAYOUTS, with_layout
from tests.odd_vehicles import ODD, odd_vehicle

import flytune
from flytune.control.classical import CLASSICAL, classical_controller
from flytune.physics.dynamics import CONTROL_PERIOD
from flytune.physics.rotors import hover_action
from flytune.physics.vehicle import load_vehicle
from flytune.simulation.simulator import VehicleStates, to_body, to_inertial
from flytune.simulation.simulators import make_simulator
from flytune.task.files import load_task

SIMULATORS = ("pybullet", "mujoco")
STATE = ("position", "attitude", "velocity", "body_rate")


@pytest.fixture(params=SIMULATORS)
def name(request):
    """A simulator's name; a test is skipped where it is not installed."""
    pytest.importorskip(request.param, reason=f"needs flytune[{request.param}]")
    return request.param


@pytest.fixture(scope="module")
def paper():
    """The paper's Crazyflie."""
    return load_vehicle("crazyflie")


@pytest.fixture(scope="module")
def measured():
    """The measured Crazyflie: drag, and motors that lag; actions two periods late."""
    return dataclasses.replace(load_vehicle("crazyflie-measured"), action_latency_steps=2)


@pytest.fixture(scope="module")
def ballistic(paper):
    """A body with three different moments whose rotors stop at a = -1: nothing but gravity acts on it."""
    return dataclasses.replace(paper, action_scale=1.0, inertia=(1.7e-5, 1.2e-5, 2.6e-5))


def body(vehicle, number=1, **changes):
    """N vehicles that hover level at 1 m, but for what is said."""
    fields = {
        "position": np.tile([0.0, 0.0, 1.0], (number, 1)),
        "attitude": np.tile([0.0, 0.0, 0.0, 1.0], (number, 1)),
        "velocity": np.zeros((number, 3)),
        "body_rate": np.zeros((number, 3)),
        "rotor_speed_rpm": np.full((number, 4), vehicle.hover_rotor_speed_rpm),
    }
    return VehicleStates(**(fields | {key: np.asarray(value, float) for key, value in changes.items()}))


def moving(vehicle, number=6):
    """Vehicles anywhere, in any attitude, moving and turning at up to 400 deg/s."""
    draw = np.random.default_rng(5)
    return body(
        vehicle,
        number,
        position=draw.uniform(-1, 1, (number, 3)),
        attitude=Rotation.random(number, rng=draw).as_quat(),
        velocity=draw.uniform(-1, 1, (number, 3)),
        body_rate=draw.uniform(-4, 4, (number, 3)),
    )


def fly(name, vehicle, start, actions, **options):
    """Where the vehicles are after actions [T, N, 4]."""
    simulator = make_simulator(name, vehicle, len(start.position), options)
    simulator.place(start)
    for action in actions:
        simulator.advance(action)
    end = simulator.states()
    simulator.close()
    return end


def difference(one, other):
    """Largest difference of position, attitude (q and -q are the same), velocity and body rate."""
    sign = np.sign(np.sum(one.attitude * other.attitude, axis=-1, keepdims=True))
    apart = {part: getattr(one, part) - getattr(other, part) for part in STATE}
    apart["attitude"] = one.attitude - sign * other.attitude
    return np.array([np.abs(part).max() for part in apart.values()])


def test_a_vehicle_is_where_it_was_placed(name, paper):
    start = moving(paper)
    assert difference(fly(name, paper, start, []), start).max() < 1e-14


def test_placing_some_vehicles_leaves_the_others(name, paper):
    simulator, start = make_simulator(name, paper, 6), moving(paper)
    simulator.place(start)
    simulator.advance(np.zeros((6, 4)))
    before = simulator.states()
    simulator.place(body(paper, 2, position=[[5, 5, 5], [6, 6, 6]]), np.array([1, 4]))
    after = simulator.states()
    simulator.close()
    others = [0, 2, 3, 5]
    for part in STATE:
        np.testing.assert_array_equal(getattr(after, part)[others], getattr(before, part)[others])
    np.testing.assert_allclose(after.position[[1, 4], 0], [5, 6])
    assert not after.velocity[[1, 4]].any() and not after.body_rate[[1, 4]].any()


def test_vehicles_do_not_touch_each_other(name, paper):
    # two in one place, and one alone: all three stay together
    end = fly(name, paper, body(paper, 3), [np.zeros((3, 4))] * 50)
    assert np.abs(end.position - [0, 0, 1]).max() < 1e-9


def test_a_level_vehicle_at_hover_speed_stays_where_it_is(name, paper):
    end = fly(name, paper, body(paper), [np.zeros((1, 4))] * 100)
    # the forces balance to rounding, 1e-16 g or a little more, over one second
    assert difference(end, body(paper)).max() < 1e-12


def test_free_fall_is_exact_but_for_what_the_integrator_says(name, ballistic):
    start = body(ballistic, velocity=[[0.3, -0.2, 1.0]])
    end = fly(name, ballistic, start, [np.full((1, 4), -1.0)] * 50)
    # RK4 is exact; velocity first, then position, sums g h (1 + 2 + ... + n) h = g t^2 / 2 + g t h / 2
    time, ahead = 0.5, {"pybullet": CONTROL_PERIOD / 2 / 2, "mujoco": 0.0}[name]
    fallen = ballistic.gravity * time * (time / 2 + ahead)
    np.testing.assert_allclose(end.position[0], [0.15, -0.1, 1 + 0.5 - fallen], atol=1e-12)
    np.testing.assert_allclose(end.velocity[0], [0.3, -0.2, 1.0 - ballistic.gravity * time], atol=1e-12)


def test_a_body_free_of_torque_keeps_its_angular_momentum(name, ballistic):
    inertia = np.array(ballistic.inertia)
    start = moving(ballistic)
    before = to_inertial(start.attitude, inertia * start.body_rate)
    size = np.linalg.norm(before, axis=1)

    def drift(physics_steps):
        end = fly(name, ballistic, start, [np.full((6, 4), -1.0)] * 50, physics_steps=physics_steps)
        assert np.abs(end.body_rate - start.body_rate).max() > 1  # the gyroscopic torque is at work
        return np.max(np.linalg.norm(to_inertial(end.attitude, inertia * end.body_rate) - before, axis=1) / size)

    if name == "mujoco":  # fourth order: 16 times less with half the step
        assert drift(2) < 1e-6
    else:  # first order
        assert drift(2) < 0.1
        assert drift(10) / drift(20) == pytest.approx(2, rel=0.1)


def test_the_body_rate_is_that_of_the_body_frame(name, ballistic):
    # lying on its side, spinning about its own z axis, which points along -y of the room
    side = Rotation.from_euler("x", 90, degrees=True)
    start = body(ballistic, attitude=[side.as_quat()], body_rate=[[0, 0, 3.0]])
    end = fly(name, ballistic, start, [np.full((1, 4), -1.0)] * 20)
    np.testing.assert_allclose(end.body_rate, [[0, 0, 3.0]], atol=1e-12)
    expected = side * Rotation.from_rotvec([0, 0, 3.0 * 0.2])
    turned = Rotation.from_quat(end.attitude[0]) * expected.inv()
    assert turned.magnitude() < 1e-9


@pytest.mark.parametrize("motor", range(4))
def test_each_motor_lifts_and_turns_as_the_paper_says(name, paper, motor):
    action = np.zeros((1, 4))
    action[0, motor] = 0.2
    level = fly(name, paper, body(paper), [action])
    lean = Rotation.from_euler("ZYX", [2.0, 0.5, -0.7]).as_quat()
    leaning = fly(name, paper, body(paper, attitude=[lean]), [action])
    # R4 by hand: f = kf rpm^2, more than hover by (1.1^2 - 1), at (+-l, +-l)
    more = 0.21 * paper.mass * paper.gravity / 4
    x, y = [(1, -1), (-1, -1), (-1, 1), (1, 1)][motor]
    spin = [-1, 1, -1, 1][motor] * paper.torque_coefficient / paper.thrust_coefficient
    torque = np.array([y * paper.lever, -x * paper.lever, spin]) * more
    # it has hardly begun to turn: 0.4 rad/s times the same, over 10 ms, is left out
    np.testing.assert_allclose(level.body_rate[0], torque / paper.inertia * CONTROL_PERIOD, rtol=1e-2)
    np.testing.assert_allclose(leaning.body_rate, level.body_rate, rtol=1e-9)
    assert level.velocity[0, 2] == pytest.approx(more / paper.mass * CONTROL_PERIOD, rel=1e-3)


@pytest.fixture(params=("flytune", *SIMULATORS))
def anywhere(request):
    """The name of each simulator, flytune's own among them."""
    if request.param != "flytune":
        pytest.importorskip(request.param, reason=f"needs flytune[{request.param}]")
    return request.param


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_vehicle_with_its_rotors_elsewhere_hovers_and_turns_the_right_way(anywhere, layout):
    vehicle = with_layout(layout)
    assert difference(fly(anywhere, vehicle, body(vehicle), [np.zeros((1, 4))] * 50), body(vehicle)).max() < 1e-5
    more = 0.21 * vehicle.mass * vehicle.gravity / 4
    for motor, ((x, y), spin) in enumerate(zip(LAYOUTS[layout].place, LAYOUTS[layout].spin, strict=True)):
        action = np.zeros((1, 4))
        action[0, motor] = 0.2
        torque = np.array([y, -x, spin * vehicle.torque_coefficient / vehicle.thrust_coefficient]) * more
        rate = fly(anywhere, vehicle, body(vehicle), [action]).body_rate[0]
        expected = torque / vehicle.inertia * CONTROL_PERIOD
        # it has hardly begun to turn: what the turning rotors and axes do to each other is left out
        np.testing.assert_allclose(rate, expected, rtol=2e-2, atol=1e-2 * np.abs(expected).max())


@pytest.mark.parametrize(("controller", "layout"), list(zip(CLASSICAL, LAYOUTS, strict=True)))
def test_a_classical_controller_brings_a_vehicle_with_its_rotors_elsewhere_to_the_target(layout, controller):
    task = load_task("baseline")
    task = dataclasses.replace(task, vehicle=with_layout(layout))
    flights = flytune.fly(classical_controller(controller, task), task, trials=4, seed=1)
    error = np.linalg.norm(flights.position[:, -1] - np.array(task.target.position), axis=-1)
    assert not flights.crashed.any() and error.max() < 0.05


@pytest.mark.parametrize("vehicle", ["paper", "measured", "everything"])
def test_a_simulator_comes_to_flytunes_physics_as_its_step_shrinks(name, vehicle, request):
    vehicle = odd_vehicle(vehicle) if vehicle in ODD else request.getfixturevalue(vehicle)
    steps = round(0.3 * vehicle.control_rate)
    actions = float(hover_action(vehicle)) + np.random.default_rng(6).uniform(-0.4, 0.4, (steps, 6, 4))
    start = moving(vehicle)
    own = fly("flytune", vehicle, start, actions)
    coarse, fine = (difference(fly(name, vehicle, start, actions, physics_steps=steps), own) for steps in (10, 20))
    if name == "mujoco":
        # float32 rounds by 2e-5 (docs/concepts/integrator.md), which hides the errors of RK4 and of a lag held for 1 ms
        assert max(coarse.max(), fine.max()) < 5e-5
    else:
        # semi-implicit Euler is of first order; second-order remainders are h over the time scale of the motion
        np.testing.assert_allclose(coarse / fine, 2, rtol=0.1)


def test_mujocos_euler_and_bullet_are_the_same_integrator(paper):
    for simulator in SIMULATORS:
        pytest.importorskip(simulator, reason=f"needs flytune[{simulator}]")
    actions = np.random.default_rng(7).uniform(-0.4, 0.4, (30, 6, 4))
    bullet = fly("pybullet", paper, moving(paper), actions)
    euler = fly("mujoco", paper, moving(paper), actions, integrator="Euler")
    assert difference(bullet, euler).max() < 1e-9
    runge_kutta = fly("mujoco", paper, moving(paper), actions)
    assert difference(bullet, runge_kutta)[0] > 1e-3


def test_actions_beyond_one_are_clipped(name, paper):
    once, more = (fly(name, paper, body(paper), [np.full((1, 4), action)]) for action in (1.0, 7.0))
    assert difference(once, more).max() == 0


def test_an_action_arrives_when_the_latency_is_over(name, paper):
    late = dataclasses.replace(paper, action_latency_steps=3)
    heights = [fly(name, late, body(late), [np.ones((1, 4))] * steps).position[0, 2] for steps in (3, 4)]
    assert heights[0] == pytest.approx(1.0, abs=1e-12) and heights[1] > 1.0001


def test_drag_slows_along_the_inertial_axes(name, paper):
    dragged = dataclasses.replace(paper, drag=(0.01, 0.02, 0.0))
    start = body(dragged, velocity=[[1.0, 1.0, 0.0]], attitude=[Rotation.from_euler("z", 1.0).as_quat()])
    end = fly(name, dragged, start, [np.zeros((1, 4))] * 100)
    # v = v0 exp(-D t / m); the step is short against m / D = 1.6 s: explicit, 0.15 % of the exponent; RK4, nothing
    decay = np.exp(-np.array([0.01, 0.02]) / paper.mass)
    np.testing.assert_allclose(end.velocity[0, :2], decay, rtol={"pybullet": 2e-3, "mujoco": 1e-8}[name])


def test_frames_of_a_moving_body_agree_with_its_way(name, ballistic):
    # the attitude must turn by the body rate that is reported: R^T dR = w dt, at the middle of a period
    simulator = make_simulator(name, ballistic, 6, {"physics_steps": 20})
    simulator.place(moving(ballistic))
    before = simulator.states()
    simulator.advance(np.full((6, 4), -1.0))
    after = simulator.states()
    simulator.close()
    turned = (Rotation.from_quat(before.attitude).inv() * Rotation.from_quat(after.attitude)).as_rotvec()
    middle = (before.body_rate + after.body_rate) / 2
    np.testing.assert_allclose(turned / CONTROL_PERIOD, middle, atol=0.02)
    assert np.abs(to_inertial(before.attitude, before.body_rate) - before.body_rate).max() > 1
    assert np.abs(to_body(before.attitude, before.body_rate) - before.body_rate).max() > 1
