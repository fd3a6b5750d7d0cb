"""Flying: equal terms for every controller, crashes that stay visible, and trajectories in a file (paper R8, R19)."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytune.config.pytree import pytree, static
from flytune.control.controller import Controller
from flytune.errors import BadInput, Diverged
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import judge
from flytune.physics.dynamics import hovering
from flytune.runs.find import find_controller
from flytune.task.files import load_task
from flytune.task.initial_state import InitialState
from flytune.task.situation import situation
from flytune.task.termination import margins


@pytree
class Echo:
    """Answers with four of the numbers it sees, scaled: its recorded actions tell what it was shown."""

    gain: Any
    first: int = static(default=0)

    def initial_memory(self):
        """Nothing."""
        return ()

    def act(self, memory, observation):
        """Four numbers of the observation, from `first` on."""
        return memory, self.gain * observation[self.first : self.first + 4]


@pytree
class Diver:
    """Asks for the least thrust in the trials that begin on the side x > 0, and hovers in the others."""

    def initial_memory(self):
        """Nothing known yet."""
        return jnp.int32(0)

    def act(self, memory, observation):
        """Decides once, at the first observation."""
        side = jnp.where(memory == 0, jnp.where(observation[0] > 0, 1, -1), memory)
        return side, jnp.where(side > 0, -1.0, 0.0) * jnp.ones(4)


@pytree
class Breaker:
    """Hovers; after `step` observations it answers NaN where the position error in x is above `beyond`."""

    step: Any
    beyond: Any

    def initial_memory(self):
        """No observation yet."""
        return jnp.int32(0)

    def act(self, memory, observation):
        """Counts, and breaks."""
        broken = (memory == self.step) & (observation[0] > self.beyond)
        return memory + 1, jnp.where(broken, jnp.nan, 0.0) * jnp.ones(4)


@pytest.fixture(scope="module")
def task():
    """The baseline task."""
    return load_task("baseline")


@pytest.fixture(scope="module")
def quick(task):
    """Five trials of 0.6 s, one compiled program for each kind of controller."""

    def run(controller, trials=5, **options):
        return fly(controller, task, trials=trials, **({"duration": 0.6} | options))

    return run


@pytest.fixture(scope="module")
def calm(quick):
    """Flights of a controller that does almost nothing, and shows the position errors it sees."""
    return quick(Echo(gain=jnp.float32(0.05)))


def noise_shown(flights, gain):
    """Noise on the position error [N, T, 3]: action k + 1 is gain times what was seen at sample k."""
    return flights.action[:, 1:, :3] / gain - (flights.position - flights.target_position)[:, :-1]


def test_the_pilots_of_these_tests_are_controllers():
    assert all(
        isinstance(controller, Controller) for controller in (Echo(gain=1.0), Diver(), Breaker(step=1, beyond=0.0))
    )


# --- equal terms ---


def test_a_trial_is_the_same_however_many_are_flown(quick, calm):
    more = quick(Echo(gain=jnp.float32(0.05)), trials=50)
    for name in ("position", "attitude", "velocity", "body_rate", "action"):
        np.testing.assert_allclose(getattr(more, name)[:5], getattr(calm, name), atol=1e-5, err_msg=name)


def test_a_trial_is_the_same_however_long_it_is_flown(quick, calm):
    longer = quick(Echo(gain=jnp.float32(0.05)), duration=0.8)
    assert longer.position.shape[1] == 81
    np.testing.assert_allclose(longer.position[:, :61], calm.position, atol=1e-5)
    np.testing.assert_allclose(longer.action[:, :61], calm.action, atol=1e-5)


def test_two_controllers_begin_at_the_same_starts_and_see_the_same_noise(quick, calm):
    other = quick(Echo(gain=jnp.float32(-0.1)))
    assert np.abs(other.position[:, -1] - calm.position[:, -1]).max() > 0.01  # they did not fly alike
    for name in ("position", "attitude", "velocity", "body_rate"):
        np.testing.assert_array_equal(getattr(other, name)[:, 0], getattr(calm, name)[:, 0])
    np.testing.assert_allclose(noise_shown(other, -0.1), noise_shown(calm, 0.05), atol=2e-5)


def test_the_noise_is_that_of_the_task_and_different_in_every_trial_and_step(calm):
    # 900 numbers of deviation 1e-3: their deviation is known to 1 / sqrt(1800) = 2.4 %; 4 sigma
    noise = noise_shown(calm, 0.05)
    assert noise.std() == pytest.approx(1e-3, rel=0.1)
    assert np.abs(noise.mean()) < 4e-3 / math.sqrt(900)
    assert np.unique(np.round(noise, 6)).size > 0.5 * noise.size
    flat = noise.reshape(5, -1)
    assert np.abs(np.corrcoef(flat) - np.eye(5)).max() < 4 / math.sqrt(180)


def test_the_pilot_sees_the_action_before(quick):
    # an echo of the last action with gain 1 repeats the first one, hover, for ever
    flights = quick(Echo(gain=jnp.float32(1.0), first=13))
    assert not flights.action.any()


def test_another_seed_gives_other_starts_and_noise(quick, calm):
    other = quick(Echo(gain=jnp.float32(0.05)), seed=2)
    assert not np.any(np.isclose(other.position[:, 0], calm.position[:, 0], atol=1e-6))
    assert np.abs(noise_shown(other, 0.05) - noise_shown(calm, 0.05)).max() > 1e-3


def test_the_same_call_gives_the_same_flights(quick, calm):
    again = quick(Echo(gain=jnp.float32(0.05)))
    np.testing.assert_array_equal(again.position, calm.position)
    np.testing.assert_array_equal(again.action, calm.action)


# --- starts ---


@pytest.mark.parametrize(("initial_conditions", "lowest"), [("clear", 0.1), ("paper", 0.0)])
def test_trials_begin_at_rest_within_the_papers_ranges(quick, initial_conditions, lowest):
    flights = quick(Echo(gain=jnp.float32(0.05)), trials=500, initial_conditions=initial_conditions)
    position, tilt = flights.position[:, 0], Rotation.from_quat(flights.attitude[:, 0]).as_euler("ZYX")[:, 1:]
    assert np.all(np.abs(position[:, :2]) <= 2) and np.abs(position[:, :2]).max() > 1.98
    assert position[:, 2].min() >= lowest and position[:, 2].min() < lowest + 0.03 and position[:, 2].max() <= 2
    assert np.degrees(np.abs(tilt)).max() <= 15.001 and np.degrees(np.abs(tilt)).max() > 14.5
    assert not flights.velocity[:, 0].any() and not flights.body_rate[:, 0].any()
    assert flights.initial_conditions == initial_conditions


# --- the record ---


def test_sample_zero_is_the_start_and_the_samples_are_ten_milliseconds_apart(calm, task):
    assert (calm.trials, calm.duration) == (5, pytest.approx(0.6))
    np.testing.assert_allclose(calm.time, np.arange(61) / 100)
    assert calm.position.shape == (5, 61, 3) and calm.attitude.shape == (5, 61, 4) and calm.action.shape == (5, 61, 4)
    assert not calm.action[:, 0].any()
    np.testing.assert_allclose(calm.rotor_speed_rpm[:, 0], task.vehicle.hover_rotor_speed_rpm, rtol=1e-6)
    # action k led to sample k: instant motors show it at once (R9)
    expected = task.vehicle.hover_rotor_speed_rpm * (1 + 0.5 * calm.action)
    np.testing.assert_allclose(calm.rotor_speed_rpm, expected, rtol=1e-5)


def test_the_record_says_who_flew_what(task):
    flights = fly(Echo(gain=jnp.float32(0.05)), task, trials=5, duration=0.6, name="echo", seed=4)
    labels = (flights.name, flights.task, flights.vehicle, flights.simulator, flights.seed, flights.initial_conditions)
    assert labels == ("echo", "baseline", "crazyflie", "flytune", 4, "clear")
    assert flights.speed_bound == 0.8
    np.testing.assert_array_equal(flights.target_position, [0, 0, 1])


def test_the_margins_are_those_of_the_true_state(calm, task):
    assert set(calm.margins) == set(task.termination)
    state = dataclasses.replace(
        hovering(task.vehicle, tuple(calm.position[2, 40])),
        **{name: tuple(getattr(calm, name)[2, 40]) for name in ("attitude", "velocity", "body_rate")},
    )
    here = situation(task.reference(0), state, jnp.zeros(4))
    for name, margin in margins(task.termination, here).items():
        assert calm.margins[name][2, 40] == pytest.approx(float(margin), abs=1e-5)


def test_a_trial_lasts_as_long_as_its_task_says(task):
    short = dataclasses.replace(task, duration=0.6)
    assert fly(Echo(gain=jnp.float32(0.05)), short, trials=5).duration == pytest.approx(0.6)


# --- crashes ---


def test_a_trial_that_leaves_the_ball_is_marked_and_held_and_the_others_fly_on(task):
    # a = -1 leaves a quarter of the thrust: -0.75 g; 10 m and more below the target after sqrt(2 * 11 / 7.36) = 1.7 s
    flights = fly(Diver(), task, trials=20, duration=2.0)
    np.testing.assert_array_equal(flights.crashed, flights.position[:, 0, 0] > 0)
    assert 0 < flights.crashed.sum() < 20
    distance = np.linalg.norm(flights.position - flights.target_position, axis=-1)
    assert distance.max() <= 10 + 1e-4 and np.isfinite(flights.position).all()
    held = np.all(np.diff(flights.position, axis=1) == 0, axis=-1)  # [N, T], from one sample to the next
    assert np.all(held[flights.crashed, -1]) and not np.any(held[~flights.crashed, 5:])
    for trial in np.flatnonzero(flights.crashed):
        first = int(np.argmax(held[trial, 5:])) + 5
        assert 1.3 < flights.time[first] < 2.0
        assert distance[trial, first] > 9.8
        for name in ("position", "attitude", "velocity", "body_rate", "action", "rotor_speed_rpm"):
            part = getattr(flights, name)[trial, first:]
            np.testing.assert_array_equal(part, np.broadcast_to(part[0], part.shape))


def test_crossing_a_termination_does_not_end_a_trial(task):
    flights = fly(Diver(), task, trials=20, duration=2.0)
    divers = np.flatnonzero(flights.crashed)
    fast = np.argmax(flights.margins["speed"][divers] < 0, axis=1)
    assert np.all(fast > 0)
    later = flights.position[divers, fast + 20, 2]
    assert np.all(later < flights.position[divers, fast, 2])


# --- what is refused ---


def test_an_action_that_is_not_finite_is_reported_with_its_trial_and_time(quick, calm):
    side = calm.position[:, 0, 0]
    trial = int(np.argmax(side))
    threshold = np.sort(side)[-2:].mean()  # between the two that begin farthest out
    with pytest.raises(Diverged, match=rf"^wreck: action .*nan.* not finite in trial {trial} at 0\.05 s, on a finite"):
        quick(Breaker(step=jnp.int32(5), beyond=jnp.float32(threshold)), name="wreck")


def test_a_pilot_that_never_breaks_is_not_accused(quick):
    flights = quick(Breaker(step=jnp.int32(5), beyond=jnp.float32(100.0)))
    assert not flights.crashed.any()


@pytest.mark.parametrize(
    ("options", "start"),
    [
        ({"trials": 0}, "trials: 0 is not allowed. Allowed: a whole number, 1 to 100000."),
        ({"trials": -3}, "trials: -3 is not allowed."),
        ({"duration": math.nan}, "duration: nan is not allowed. Allowed: above 0.5"),
        ({"duration": math.inf}, "duration: inf is not allowed."),
        ({"duration": 0.3}, "duration: 0.3 is not allowed."),
        ({"duration": 0.5}, "duration: 0.5 is not allowed."),
        ({"initial_conditions": "easy"}, "starts: 'easy' is not allowed. Allowed: paper, clear."),
        ({"seed": -1}, "seed: -1 is not allowed. Allowed: a whole number, 0 to 4294967295."),
    ],
)
def test_an_argument_out_of_range_is_refused_in_one_line(quick, options, start):
    with pytest.raises(BadInput) as caught:
        quick(Echo(gain=jnp.float32(0.05)), **options)
    assert str(caught.value).startswith(start) and "\n" not in str(caught.value)


# --- the file ---


def test_the_file_holds_every_trajectory_under_the_name_of_its_column(calm, tmp_path):
    calm.save(tmp_path / "flights.npz")
    with np.load(tmp_path / "flights.npz") as file:
        data, columns, units = file["data"], file["columns"].tolist(), file["units"].tolist()
        assert str(file["task"]) == "baseline" and int(file["seed"]) == 1
        np.testing.assert_array_equal(file["crashed"], calm.crashed)
    assert data.shape == (5, 61, len(columns)) and len(set(columns)) == len(columns) == len(units)
    assert columns[0] == "time" and dict(zip(columns, units, strict=True))["rpm2"] == "rpm"
    column = {name: data[..., index] for index, name in enumerate(columns)}
    np.testing.assert_allclose(column["time"], np.broadcast_to(calm.time, (5, 61)), rtol=1e-6)
    for names, field in (
        (("x", "y", "z"), "position"),
        (("qx", "qy", "qz", "qw"), "attitude"),
        (("vx", "vy", "vz"), "velocity"),
        (("wx", "wy", "wz"), "body_rate"),
        (("rpm0", "rpm1", "rpm2", "rpm3"), "rotor_speed_rpm"),
        (("a0", "a1", "a2", "a3"), "action"),
    ):
        np.testing.assert_array_equal(np.stack([column[name] for name in names], axis=-1), getattr(calm, field))
    for name, margin in calm.margins.items():
        np.testing.assert_array_equal(column[f"margin_{name}"], margin)


def test_vehicles_with_lag_and_latency_are_flown_too():
    late = load_task("baseline", {"vehicle": "crazyflie-measured", "vehicle.action_latency_steps": 2})
    flights = fly(Echo(gain=jnp.float32(0.05)), late, trials=5, duration=0.6)
    hover = late.vehicle.hover_rotor_speed_rpm
    np.testing.assert_allclose(flights.rotor_speed_rpm[:, :3], hover, rtol=1e-5)  # two steps late, still hover
    assert np.abs(flights.rotor_speed_rpm[:, 4] - hover).max() > 1
    assert jax.tree.all(jax.tree.map(lambda part: np.isfinite(part).all(), flights.margins))


class Plain:
    """A controller that is no JAX pytree."""

    def initial_memory(self):
        """Nothing."""
        return ()

    def act(self, memory, observation):
        """Hover."""
        return memory, jnp.zeros(4)


@pytree
class Three:
    """A controller with three actions."""

    def initial_memory(self):
        """Nothing."""
        return ()

    def act(self, memory, observation):
        """Three zeros."""
        return memory, jnp.zeros(3)


@pytree
class Forgetful:
    """A controller that gives no memory back."""

    def initial_memory(self):
        """A count."""
        return jnp.zeros(())

    def act(self, memory, observation):
        """Hover."""
        return (), jnp.zeros(4)


@pytest.mark.parametrize(
    ("controller", "line"),
    [
        (Plain(), "controller: Plain is no JAX pytree. Decorate its class"),
        (Three(), r"controller: Three.act gives an action of shape \(3,\). Allowed: \(4,\)."),
        (Forgetful(), "controller: Forgetful.act gives the memory"),
        (lambda observation: observation, "controller: function is not allowed. Allowed: an object with"),
    ],
)
def test_a_controller_that_cannot_be_flown_is_refused_in_one_line(task, controller, line):
    with pytest.raises(BadInput, match=line):
        fly(controller, task)


def test_options_beside_a_simulator_of_ones_own_are_refused(task):
    with pytest.raises(BadInput, match="simulator_options: are not allowed with a simulator of your own"):
        fly(Echo(gain=0.0), task, simulator=lambda vehicle, number: None, simulator_options={"physics_steps": 2})


@pytest.mark.parametrize("name", ["baseline-refined", "acrobatic-refined", "dial"])
def test_a_policy_that_ships_does_the_same_at_every_heading(name):
    found = find_controller(name)
    turned = find_controller(name, load_task(name, {"target.yaw": 2.0}).at())
    there = judge(fly(found, found.task.at(), trials=20)).settling_time["position"]
    here = judge(fly(turned, turned.task, trials=20)).settling_time["position"]
    assert np.isfinite(there).all() and np.isfinite(here).all()
    # the starts are others, since their box does not turn with the target
    assert np.median(here) == pytest.approx(np.median(there), rel=0.1)


@pytest.mark.slow
def test_a_far_target_is_approached_by_a_policy_and_not_crashed_into():
    task = load_task("dial").at()
    starts = InitialState(
        lowest_position=(-20.0, -0.5, 1.0), highest_position=(-20.0, 0.5, 1.0), largest_tilt=0.1, largest_yaw=3.0
    )
    flights = fly(find_controller("dial"), task, trials=10, duration=40.0, initial_conditions=starts)
    judged = judge(flights)
    assert judged.settled("position") == 10 and not judged.crashed.any()
    assert judged.peak_speed.max() < 0.8
    assert flights.initial_conditions == "own"
    free = dataclasses.replace(find_controller("dial").controller, error_limit=np.inf)
    lost = judge(fly(free, task, trials=10, duration=40.0, initial_conditions=starts))
    assert lost.settled("position") < 10  # what the limit is for
