"""The rollout on the host: what an outside trainer is told is what the environment does, in any simulator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytune.errors import BadInput
from flytune.simulation import environment
from flytune.simulation.host import HostEnvironment, unravel
from flytune.simulation.jax_simulator import JaxSimulator
from flytune.task.files import load_task
from flytune.task.termination import causes

QUIET = {f"noise.{block}": 0.0 for block in ("position", "attitude", "velocity", "body_rate")}
NUMBER = 6


class OnTheHost(JaxSimulator):
    """flytune's simulator as one that JAX cannot look into."""

    def __init__(self, vehicle, number):
        super().__init__(vehicle, number)
        self.physics = None


def make(task, seed=0, simulator=JaxSimulator):
    """Six episodes of a task that have just begun."""
    made = HostEnvironment(task, simulator(task.vehicle, NUMBER), NUMBER)
    made.reset(seed)
    return made


@pytest.fixture
def noisy():
    """Six episodes of the baseline task."""
    return make(load_task("baseline"), seed=1)


def actions(steps, seed=0):
    """Random actions, some of them beyond the limits."""
    return np.random.default_rng(seed).uniform(-1.2, 1.2, (steps, NUMBER, 4)).astype(np.float32)


def one(episodes, index):
    """One of the episodes."""
    return jax.tree.map(lambda part: part[..., index], episodes)


def test_every_step_is_the_core_s_step_and_the_final_observation_is_of_the_state_before_the_reset():
    task = load_task("baseline", QUIET)
    batch, ends = make(task, seed=1), 0

    @jax.jit
    def alone(task, episodes, index, action):
        after, outcome = environment.step(task, one(unravel(task, episodes), index), action)
        return outcome, environment.observe(task, after, jnp.zeros(13))

    @jax.jit
    def seen(task, episodes, index):
        return environment.observe(task, one(unravel(task, episodes), index), jnp.zeros(13))

    for action in actions(40):
        before = batch.episodes
        moved = batch.step(action)
        for index in range(NUMBER):
            outcome, final = jax.device_get(alone(task, before, index, action[index]))
            # the same arithmetic in two programs: some ulp, which rates of 30 rad/s show as 1e-5
            np.testing.assert_allclose(moved.final_observation[index], final, rtol=1e-5, atol=2e-5)
            assert moved.reward[index] == pytest.approx(outcome.reward, abs=1e-5)
            assert (moved.terminated[index], moved.cause[index]) == (outcome.terminated, outcome.cause)
            now = seen(task, batch.episodes, index)
            np.testing.assert_allclose(moved.observation[index], now, rtol=1e-5, atol=2e-5)
            if moved.ended[index]:
                ends += 1
                assert batch.steps()[index] == 0
                assert not np.allclose(moved.observation[index], moved.final_observation[index], atol=1e-2)
                np.testing.assert_array_equal(moved.observation[index][13:], 0)  # last action of a new episode
            else:
                np.testing.assert_array_equal(moved.observation[index], moved.final_observation[index])
    assert ends > 3


def test_terms_add_up_to_the_reward_and_rewards_to_the_return(noisy):
    total, length = np.zeros(NUMBER), np.zeros(NUMBER, int)
    for action in actions(40):
        moved = noisy.step(action)
        total, length = total + moved.reward, length + 1
        assert set(moved.terms) == set(noisy.task.reward)
        np.testing.assert_allclose(sum(moved.terms.values()), moved.reward, atol=1e-6)  # six float32 below 1
        np.testing.assert_allclose(moved.episode_return, total, atol=1e-5)
        np.testing.assert_array_equal(moved.episode_length, length)
        total, length = np.where(moved.ended, 0, total), np.where(moved.ended, 0, length)


def test_an_episode_that_reaches_its_horizon_is_truncated_and_did_not_fail():
    batch = make(load_task("baseline", {"horizon": 3}))
    truncated = [batch.step(np.zeros((NUMBER, 4), np.float32)) for _ in range(6)]
    assert [moved.truncated.tolist() for moved in truncated] == 2 * [
        [False] * NUMBER,
        [False] * NUMBER,
        [True] * NUMBER,
    ]
    assert not any(moved.terminated.any() for moved in truncated)
    assert [moved.episode_length[0] for moved in truncated] == [1, 2, 3, 1, 2, 3]


def test_a_failure_is_told_with_its_cause():
    batch = make(load_task("baseline", {"termination.speed.bound": 0.01}))
    moved = batch.step(np.full((NUMBER, 4), -1.0, np.float32))
    assert moved.terminated.all() and not moved.truncated.any()
    assert {causes(batch.task.termination)[cause] for cause in moved.cause} == {"speed"}


def test_a_seed_fixes_everything_that_follows(noisy):
    def fly(batch):
        return [batch.observation, *(batch.step(action).observation for action in actions(20))]

    first = fly(noisy)
    noisy.reset(1)
    np.testing.assert_array_equal(first, fly(noisy))
    np.testing.assert_array_equal(first, fly(make(noisy.task, seed=1)))
    assert not np.allclose(first[0], make(noisy.task, seed=2).observation, atol=1e-2)
    assert not np.allclose(noisy.reset(1), noisy.reset(), atol=1e-2)  # without a seed the random numbers go on


def test_what_was_kept_goes_on_exactly_when_put_back(noisy):
    plan = actions(30)
    for action in plan[:10]:
        noisy.step(action)
    kept = (noisy.episodes, noisy.key)
    first = [noisy.step(action) for action in plan[10:]]
    noisy.episodes, noisy.key = kept
    again = [noisy.step(action) for action in plan[10:]]
    for one_way, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one_way.observation, other.observation)
        np.testing.assert_array_equal(one_way.reward, other.reward)


def test_a_partial_reset_leaves_the_others_alone(noisy):
    moved = noisy.step(actions(1)[0])
    which = np.array([True, False, False, True, False, False])
    observation = noisy.reset(which=which)
    np.testing.assert_array_equal(observation[~which], moved.observation[~which])
    assert (np.abs(observation - moved.observation).max(axis=1) > 1e-2).tolist() == which.tolist()
    assert noisy.steps().tolist() == [0, 1, 1, 0, 1, 1]
    np.testing.assert_array_equal(
        noisy.states[:, 3:7], np.stack(unravel(noisy.task, noisy.episodes).state.attitude, axis=-1)
    )


def test_what_it_gives_may_be_written_to_and_stays_as_it_was(noisy):
    first = noisy.step(actions(1)[0])
    kept = first.observation.copy()
    noisy.step(actions(1)[0])
    np.testing.assert_array_equal(first.observation, kept)
    first.observation[:] = 0  # refused where the memory were JAX's own
    first.final_observation[:] = 0


def test_a_simulator_on_the_host_brings_the_same_as_one_on_the_device():
    task = load_task("baseline", {"horizon": 12})
    here, there = make(task, seed=3), make(task, seed=3, simulator=OnTheHost)
    np.testing.assert_array_equal(here.observation, there.observation)
    ends = 0
    for action in actions(30):
        one_way, other = here.step(action), there.step(action)
        for name in ("observation", "final_observation", "states", "reward", "episode_return"):
            found, expected = getattr(other, name), getattr(one_way, name)
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2e-5, err_msg=name)
        np.testing.assert_array_equal(other.ended, one_way.ended)
        ends += int(one_way.ended.sum())
    assert ends > NUMBER  # new episodes are placed in the simulator, too


def test_a_task_with_a_dial_is_refused_and_at_one_setting_it_is_not():
    family = load_task("dial")
    with pytest.raises(BadInput, match="task: dial has a dial"):
        make(family)
    assert make(family.at({"speed": 0.3})).observation.shape == (NUMBER, 17)


@pytest.mark.parametrize("simulator", [JaxSimulator, OnTheHost])
def test_a_target_that_moves_is_seen_where_it_is_at_each_step(simulator):
    circle = {"target.kind": "circle", "target.radius": 0.5, "target.facing": "along_path"}
    moving = make(load_task("baseline", {**QUIET, **circle}), seed=2, simulator=simulator)
    for step in range(1, 4):
        moving.step(np.zeros((NUMBER, 4), np.float32))
        angle = 0.5 / 0.5 * 0.01 * step
        place, heading = [0.5 * np.cos(angle), 0.5 * np.sin(angle), 1.0], angle + np.pi / 2
        c, s = np.cos(heading), np.sin(heading)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        np.testing.assert_allclose(moving.observation[:, :3], (moving.states[:, :3] - place) @ turn.T, atol=2e-6)
        relative = moving.states[:, 7:10] - 0.5 * np.array([-np.sin(angle), np.cos(angle), 0])
        np.testing.assert_allclose(moving.observation[:, 7:10], relative @ turn.T, atol=2e-6)
