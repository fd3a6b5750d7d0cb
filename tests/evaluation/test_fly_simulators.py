"""Flying elsewhere: equal starts, noise and judgement in every world, and crashes that stay visible."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from flytune.config.pytree import pytree
from flytune.errors import BadInput, Diverged
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import judge
from flytune.evaluation.trials import begin_trials, rollout_trials, trial_keys
from flytune.physics.dynamics import hovering
from flytune.simulation.jax_simulator import JaxSimulator
from flytune.simulation.simulators import make_simulator
from flytune.task.files import load_task
from flytune.task.initial_state import InitialState
from flytune.task.situation import situation
from flytune.task.termination import margins

FIELDS = ("position", "attitude", "velocity", "body_rate", "rotor_speed_rpm", "action")


class StepByStep(JaxSimulator):
    """flytune's simulator, flown like one that JAX cannot look into."""

    def __init__(self, vehicle, number):
        super().__init__(vehicle, number)
        self.physics = None


@pytree
class Echo:
    """Answers with the first four numbers it sees, scaled: its recorded actions tell what it was shown."""

    gain: Any

    def initial_memory(self):
        """Nothing."""
        return ()

    def act(self, memory, observation):
        """Four numbers of the observation."""
        return memory, self.gain * observation[:4]


@pytree
class Diver:
    """Asks for little thrust in the trials that begin on the side x > 0, hovers in the others; decides once."""

    def initial_memory(self):
        """Nothing known yet."""
        return jnp.int32(0)

    def act(self, memory, observation):
        """Decides at the first observation, and keeps to it; a little noise stays in the action."""
        side = jnp.where(memory == 0, jnp.where(observation[0] > 0, 1, -1), memory)
        return side, jnp.where(side > 0, -0.95 + 0.02 * observation[6], 0.0) * jnp.ones(4)


@pytree
class Breaker:
    """Hovers, but answers NaN to its sixth observation where the position error in x is above `beyond`."""

    beyond: Any

    def initial_memory(self):
        """No observation yet."""
        return jnp.int32(0)

    def act(self, memory, observation):
        """Counts, and breaks."""
        broken = (memory == 5) & (observation[0] > self.beyond)
        return memory + 1, jnp.where(broken, jnp.nan, 0.0) * jnp.ones(4)


@pytest.fixture(scope="module")
def task():
    """The baseline task."""
    return load_task("baseline")


@pytest.fixture(params=["flytune", "pybullet", "mujoco"])
def simulator(request):
    """A simulator whose trials are flown step by step."""
    if request.param == "flytune":
        return StepByStep
    pytest.importorskip(request.param, reason=f"needs flytune[{request.param}]")
    return request.param


@pytest.fixture(scope="module")
def own(task):
    """An echo and a diver, flown in flytune's own world at once."""
    echo = fly(Echo(gain=jnp.float32(0.05)), task, trials=8, duration=0.6)
    return echo, fly(Diver(), task, trials=8, duration=2.0)


def noise_shown(flights):
    """Noise on the position error [N, T, 3]: action k + 1 is 0.05 times what was seen at sample k."""
    return flights.action[:, 1:, :3] / 0.05 - (flights.position - flights.target_position)[:, :-1]


def test_every_world_begins_at_the_same_starts_and_shows_the_same_noise(task, own, simulator):
    echo, _ = own
    flights = fly(Echo(gain=jnp.float32(0.05)), task, trials=8, duration=0.6, name="echo", simulator=simulator)
    named = simulator if isinstance(simulator, str) else "StepByStep"
    assert (flights.simulator, flights.name, flights.trials, flights.duration) == (named, "echo", 8, 0.6)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(flights, name)[:, 0], getattr(echo, name)[:, 0], err_msg=name)
    # the first observation is the same number for number, also the attitude in the fourth
    np.testing.assert_array_equal(flights.action[:, 1], echo.action[:, 1])
    # float32: 6e-8 of 0.1 over 0.05, twice, and the position's own 2e-7
    np.testing.assert_allclose(noise_shown(flights), noise_shown(echo), atol=2e-6)
    assert flights.position.dtype == echo.position.dtype and flights.action.shape == echo.action.shape


def test_flown_step_by_step_or_at_once_is_the_same(task, own):
    both = (own[0], Echo(gain=jnp.float32(0.05)), 0.6), (own[1], Diver(), 2.0)
    for at_once, controller, duration in both:
        stepped = fly(controller, task, trials=at_once.trials, duration=duration, simulator=StepByStep)
        for name in FIELDS:  # two programs round differently, and a vehicle that tumbles makes that grow
            np.testing.assert_allclose(
                getattr(stepped, name), getattr(at_once, name), atol=1e-4, rtol=1e-5, err_msg=name
            )
        for name, margin in at_once.margins.items():
            # a margin of altitude is a height in tenths of a metre
            np.testing.assert_allclose(stepped.margins[name], margin, atol=2e-4, err_msg=name)
        np.testing.assert_array_equal(stepped.crashed, at_once.crashed)


def test_a_crash_is_counted_and_held_and_the_others_fly_on(task, own, simulator):
    _, diver = own
    flights = fly(Diver(), task, trials=8, duration=2.0, simulator=simulator)
    assert 0 < diver.crashed.sum() < 8
    np.testing.assert_array_equal(flights.crashed, diver.crashed)
    assert int(judge(flights).crashed.sum()) == int(diver.crashed.sum())
    distance = np.linalg.norm(flights.position - flights.target_position, axis=-1)
    assert np.all(distance[flights.crashed, -1] > 9.8) and distance.max() <= 10 + 1e-4
    for name in FIELDS:
        last = getattr(flights, name)[flights.crashed]
        np.testing.assert_array_equal(last[:, -1], last[:, -5], err_msg=name)
    assert np.all(np.abs(np.diff(flights.position[~flights.crashed], axis=1)).max(axis=(1, 2)) > 0)
    # hovering with a tilt of 15 deg twice accelerates by 0.37 g; Euler's step of 5 ms is ahead by a t h / 2, 18 mm
    np.testing.assert_allclose(flights.position[~flights.crashed], diver.position[~diver.crashed], atol=0.018)


@pytest.mark.parametrize("lost", [0, 3])  # some crash on the way; some begin lost
def test_a_crashed_vehicle_waits_at_the_target(task, simulator, lost):
    made = make_simulator(simulator, task.vehicle, 8) if isinstance(simulator, str) else simulator(task.vehicle, 8)
    starts, noise_keys = begin_trials(task, trial_keys(1, 8))
    starts = starts.at[0, :lost].add(15.0)
    crashed = rollout_trials(made, Diver(), task, starts, noise_keys, 200, "diver").crashed
    assert crashed[:lost].all()
    away = np.linalg.norm(made.states().position - task.target.position, axis=-1)
    made.close()
    assert 0 < crashed.sum() < 8
    assert away[crashed].max() < 1e-3 and away[~crashed].min() > 0.1


def test_a_trial_that_begins_far_away_is_not_lost(task, simulator):
    starts = InitialState(
        lowest_position=(-20.0, 0.0, 1.0), highest_position=(-9.0, 0.0, 1.0), largest_tilt=0.1, largest_yaw=1.0
    )
    hover = Echo(gain=jnp.float32(0.0))
    flights = fly(hover, task, trials=8, duration=0.6, simulator=simulator, initial_conditions=starts)
    assert np.linalg.norm(flights.position[:, 0] - task.target.position, axis=-1).max() > 10
    assert not flights.crashed.any() and not judge(flights).crashed.any()


def test_margins_are_those_of_the_recorded_state(task, simulator):
    flights = fly(Echo(gain=jnp.float32(0.05)), task, trials=8, duration=0.6, simulator=simulator)
    assert set(flights.margins) == set(task.termination)
    parts = {name: tuple(getattr(flights, name)[1, 40]) for name in FIELDS[1:4]}
    state = dataclasses.replace(hovering(task.vehicle, tuple(flights.position[1, 40])), **parts)
    for name, margin in margins(task.termination, situation(task.reference(0), state, jnp.zeros(4))).items():
        assert flights.margins[name].shape == (8, 61)
        assert flights.margins[name][1, 40] == pytest.approx(float(margin), abs=1e-5)


def test_an_action_that_is_not_finite_is_reported_with_its_trial_and_time(task, own, simulator):
    side = own[0].position[:, 0, 0]
    breaker = Breaker(beyond=jnp.float32(np.sort(side)[-2:].mean()))
    complaint = rf"^wreck: action .*nan.* not finite in trial {np.argmax(side)} at 0\.05 s, on a finite observation\.$"
    with pytest.raises(Diverged, match=complaint):
        fly(breaker, task, trials=8, duration=0.6, name="wreck", simulator=simulator)


def test_vehicles_with_lag_and_latency_are_flown_too(simulator):
    late = load_task("baseline", {"vehicle": "crazyflie-measured", "vehicle.action_latency_steps": 2})
    flights = fly(Echo(gain=jnp.float32(0.05)), late, trials=8, duration=0.6, simulator=simulator)
    own = fly(Echo(gain=jnp.float32(0.05)), late, trials=8, duration=0.6)
    hover = late.vehicle.hover_rotor_speed_rpm
    np.testing.assert_allclose(flights.rotor_speed_rpm[:, :3], hover, rtol=1e-6)  # two steps late, still hover
    assert np.abs(flights.rotor_speed_rpm[:, 4] - hover).max() > 1
    np.testing.assert_allclose(flights.rotor_speed_rpm, own.rotor_speed_rpm, rtol=1e-3)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"simulator": "gazebo"}, "world: 'gazebo' is not allowed. Allowed: flytune, pybullet, mujoco."),
        (
            {"simulator_options": {"damping": 0.1}},
            "world flytune: damping: no such field. Fields here: physics_steps.",
        ),
    ],
)
def test_a_world_or_option_that_is_unknown_is_refused(task, options, line):
    with pytest.raises(BadInput) as caught:
        fly(Echo(gain=jnp.float32(0.05)), task, trials=2, **options)
    assert str(caught.value) == line


@pytest.mark.slow
def test_a_policy_trained_in_flytune_alone_settles_in_every_world(task):
    for simulator in ("pybullet", "mujoco"):
        pytest.importorskip(simulator, reason=f"needs flytune[{simulator}]")
    from flytune.training.loop import train

    policy = train(task, trainer="apg", seed=0).policy
    air = {"damping": 0.04, "ground_effect": True, "rotor_drag": True}
    for simulator, options in (("pybullet", {}), ("pybullet", air), ("mujoco", {})):
        judgement = judge(fly(policy, task, simulator=simulator, simulator_options=options))
        settled = {axis: judgement.settled(axis) for axis in ("x", "y", "z", "yaw")}
        assert min(settled.values()) >= 95, (simulator, options, settled)
