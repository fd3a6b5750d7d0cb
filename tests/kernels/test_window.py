"""A window as one kernel: it gives what the same steps give one by one, and the same gradients."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from flytune.control.policy import make_network
from flytune.kernels.batched import available
from flytune.kernels.dense import Actor
from flytune.simulation.rollout import Draw, reset_all, rollout
from flytune.task.files import load_task

pytestmark = pytest.mark.skipif(not available(), reason="no kernels on this machine")

STEPS, NUMBER = 40, 20


def flown(task, decide, episodes):
    """The episodes at the end, and rewards and what ended them at every step."""
    noise, keys = (jax.random.split(jax.random.key(seed), (STEPS, NUMBER)) for seed in (1, 2))

    def record(task, after, moved, outcome):
        return outcome.reward, jax.lax.stop_gradient((outcome.cause, outcome.truncated, after.steps))

    (after, _), step = rollout(task, decide, (episodes, ()), Draw(noise=noise, keys=keys), record=record)
    return after, step.record


@pytest.fixture(scope="module")
def task():
    """A task whose episodes end within the window, by a termination or by their horizon."""
    return dataclasses.replace(load_task("baseline"), horizon=30)


@pytest.fixture(scope="module")
def start(task):
    """Parameters of an actor, its sizes, and episodes."""
    network = make_network(jax.random.key(0), (17, 12, 10, 4), last_gain=2.0)
    episodes = reset_all(task, jax.random.split(jax.random.key(3), NUMBER))
    return ravel_pytree(network)[0], network.sizes, episodes


def cost(task, sizes, one_kernel):
    """Parameters and episodes -> the sum of all rewards and of the last heights, and what was flown."""

    def of(parameters, episodes):
        actor = Actor(parameters=parameters, sizes=sizes, squash=True)
        # a partial function is not an actor: its steps are taken one by one
        after, record = flown(task, actor if one_kernel else partial(actor), episodes)
        return jnp.sum(record[0]) + jnp.sum(after.state.position[2]), (after, record)

    return jax.jit(jax.value_and_grad(of, argnums=(0, 1), has_aux=True, allow_int=True))


def test_a_window_is_the_steps_one_by_one(task, start):
    parameters, sizes, episodes = start
    found, expected = (cost(task, sizes, one_kernel)(parameters, episodes) for one_kernel in (True, False))
    (_, (_, (_, (cause, _, steps)))), _ = found
    assert (np.asarray(cause) >= 0).any() and (np.diff(np.asarray(steps), axis=0) < 0).any()
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        if one.dtype != jax.dtypes.float0:
            scale = 1 + np.abs(np.asarray(other)).max(initial=0)
            np.testing.assert_allclose(np.asarray(one) / scale, np.asarray(other) / scale, atol=2e-4)


def test_a_gradient_of_the_task_is_refused(task, start):
    parameters, sizes, episodes = start

    def of(bound):
        noisy = dataclasses.replace(task, noise=jax.tree.map(lambda _: bound, task.noise))
        actor = Actor(parameters=parameters, sizes=sizes, squash=True)
        return jnp.sum(flown(noisy, actor, episodes)[1][0])

    with pytest.raises(NotImplementedError, match="no gradient with respect to its task"):
        jax.grad(of)(jnp.float32(0.001))
