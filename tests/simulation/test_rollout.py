"""The rollout on the device: a family of tasks, a controller with memory, and endings."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytune.config.pytree import pytree
from flytune.simulation.environment import hold
from flytune.simulation.rollout import Draw, reset_all, rollout
from flytune.task.files import load_task
from flytune.task.task import Task, TaskFamily

NUMBER, STEPS = 5, 30


@pytree
class SpeedBounds:
    """The baseline with a speed bound that is drawn for each episode, 0.2 to 1.6 m/s."""

    task: Any

    def draw(self, key):
        """A bound, and a key for the initial state."""
        bound_key, key = jax.random.split(key)
        return jax.random.uniform(bound_key, minval=0.2, maxval=1.6), key

    def member(self, numbers):
        """The baseline with this bound."""
        speed = dataclasses.replace(self.task.termination["speed"], bound=numbers)
        return dataclasses.replace(self.task, termination={**self.task.termination, "speed": speed})

    def see(self, observation, numbers):
        """The observation, and the bound."""
        return jnp.append(observation, numbers)


@pytest.fixture(scope="module")
def flown():
    """Thirty steps of five episodes of the family that end after twelve, under a controller that counts."""
    family = SpeedBounds(task=load_task("baseline", {"horizon": 12}))

    @jax.jit
    def run(family, key):
        start, noise, keys = jax.random.split(key, 3)
        draws = Draw(noise=jax.random.normal(noise, (STEPS, 13, NUMBER)), keys=jax.random.split(keys, (STEPS, NUMBER)))

        def decide(memory, observation, drawn, episodes):
            return memory + 1, 0.0 * observation[:, :4], (memory, episodes.numbers, observation)

        count = jnp.zeros(NUMBER, jnp.int32)
        begun = (reset_all(family, jax.random.split(start, NUMBER)), count)
        return rollout(family, decide, begun, draws, fresh_memory=count, record=lambda task, after, *rest: rest)

    return run(family, jax.random.key(0))


def test_a_task_is_the_family_of_one():
    task, key = load_task("baseline"), jax.random.key(3)
    assert isinstance(task, TaskFamily) and isinstance(SpeedBounds(task=task), TaskFamily)
    numbers, left = task.draw(key)
    assert numbers == () and left is key and task.member(numbers) is task and isinstance(task, Task)


def test_each_episode_keeps_its_numbers_to_its_end_and_the_next_draws_its_own(flown):
    _, step = flown
    bounds, (_, outcome) = np.asarray(step.notes[1]), step.record
    assert len(np.unique(bounds[0])) == NUMBER and np.all((bounds >= 0.2) & (bounds <= 1.6))
    over = np.asarray(outcome.terminated | outcome.truncated)
    assert over.sum() >= 2 * NUMBER  # the horizon alone ends each of them twice
    np.testing.assert_array_equal(np.diff(bounds, axis=0) != 0, over[:-1])


def test_the_controller_is_given_what_the_family_lets_it_see(flown):
    _, bounds, seen = flown[1].notes
    assert seen.shape == (STEPS, NUMBER, 18)
    np.testing.assert_array_equal(seen[..., 17], bounds)


def test_the_margin_is_that_of_the_episode_s_own_bound(flown):
    moved, outcome = flown[1].record
    speed = np.sqrt(sum(np.asarray(part) ** 2 for part in moved.state.velocity))
    expected = 1 - speed / np.asarray(moved.numbers)
    np.testing.assert_allclose(outcome.margins["speed"], expected, atol=1e-5)


def test_memory_begins_anew_with_each_episode(flown):
    (_, memory), step = flown
    counts, (_, outcome) = np.asarray(step.notes[0]), step.record
    over = np.asarray(outcome.terminated | outcome.truncated)
    np.testing.assert_array_equal(counts[0], 0)
    np.testing.assert_array_equal(counts[1:], np.where(over[:-1], 0, counts[:-1] + 1))
    np.testing.assert_array_equal(memory, np.where(over[-1], 0, counts[-1] + 1))


def test_a_crashed_vehicle_is_held_and_the_others_fly_on():
    @jax.jit
    def run(task, key):
        episodes = reset_all(task, jax.random.split(key, 8))
        x, y, z = episodes.state.position
        away = dataclasses.replace(episodes.state, position=(x + jnp.where(jnp.arange(8) < 3, 12.0, 0.0), y, z))
        begun = dataclasses.replace(episodes, state=away), ()
        draws = Draw(noise=jnp.zeros((STEPS, 13, 8)))

        def decide(memory, observation, drawn, episodes):
            return memory, jnp.full((8, 4), -1.0), ()

        return rollout(task, decide, begun, draws, ending=hold, record=lambda task, after, moved, outcome: after)

    (episodes, _), step = run(load_task("baseline"), jax.random.key(1))
    held = np.asarray(episodes.steps) < 0
    height = np.asarray(step.record.state.position[2])
    assert 0 < held.sum() < 8
    np.testing.assert_array_equal(height[-1, held], height[-2, held])
    assert np.all(np.diff(height[:, ~held], axis=0)[5:] < 0)
