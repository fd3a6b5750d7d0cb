"""Proximal policy optimisation: its arithmetic, and that it learns."""

import dataclasses
import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy import stats

from flytune.task.files import load_task
from flytune.training import ppo


def estimate(reward, value, next_value, terminated, ended, discount=0.5, gae_lambda=0.5):
    arrays = [jnp.asarray(column, float) for column in (reward, value, next_value)]
    flags = [jnp.asarray(column) for column in (terminated, ended)]
    return np.asarray(ppo.advantages(*arrays, *flags, discount, gae_lambda))


def test_advantages_follow_the_arithmetic_of_generalised_advantage_estimation():
    # discount 1/2, lambda 1/2:
    #   delta_2 = 3 + 0.5 * 4 - 2 = 3        A_2 = 3
    #   delta_1 = 2 + 0.5 * 2 - 1 = 2        A_1 = 2 + 0.25 * 3 = 2.75
    #   delta_0 = 1 + 0.5 * 1 - 4 = -2.5     A_0 = -2.5 + 0.25 * 2.75 = -1.8125
    never = [False] * 3
    result = estimate([1, 2, 3], [4, 1, 2], [1, 2, 4], never, never)
    np.testing.assert_allclose(result, [-1.8125, 2.75, 3.0])


def test_a_terminated_step_counts_nothing_after_it():
    # delta_0 = 1 + 0 - 4 = -3, and nothing of A_1 flows back over the end
    result = estimate([1, 2], [4, 1], [100, 2], [True, False], [True, False])
    np.testing.assert_allclose(result[0], -3.0)


def test_a_truncated_step_counts_the_value_of_where_it_stopped():
    # delta_0 = 1 + 0.5 * 6 - 4 = 0: the value 6 of the last state counts, the next episode's advantage does not
    result = estimate([1, 2], [4, 1], [6, 2], [False, False], [True, False])
    np.testing.assert_allclose(result[0], 0.0)


def test_log_probability_is_that_of_a_diagonal_gaussian():
    mean, log_std = np.array([0.1, -0.2, 0.3, 0.0]), np.array([0.0, -1.0, 0.5, -2.0])
    action = np.array([0.5, 0.1, -0.4, 0.05])
    wanted = stats.norm.logpdf(action, mean, np.exp(log_std)).sum()
    given = ppo.log_probability(*(jnp.asarray(x, jnp.float32) for x in (mean, log_std, action)))
    assert float(given) == pytest.approx(wanted, rel=1e-5)


@pytest.mark.parametrize("number", [1, 2, 100, 16384])
def test_a_shuffle_holds_every_index_once_and_differs_from_key_to_key(number):
    orders = [np.asarray(ppo.shuffle(jax.random.key(seed), number)) for seed in (0, 1)]
    for order in orders:
        np.testing.assert_array_equal(np.sort(order), np.arange(number))
    assert number < 100 or (orders[0] != orders[1]).mean() > 0.9


def test_every_index_is_as_likely_in_every_place_of_a_shuffle():
    # 8 indices, 4,000 shuffles: each of the 64 counts is binomial with mean 500 and standard deviation 20.9
    orders = np.asarray(jax.vmap(lambda key: ppo.shuffle(key, 8))(jax.random.split(jax.random.key(0), 4000)))
    counts = np.array([[np.sum(orders[:, place] == index) for index in range(8)] for place in range(8)])
    assert np.abs(counts - 500).max() < 5 * 20.9


def small_batch(parameters, size=8):
    key = jax.random.key(3)
    observation = jax.random.normal(key, (size, 17))
    action = parameters.actor(observation) + 0.3
    return ppo.Batch(
        observation=observation,
        action=action,
        log_probability=ppo.log_probability(parameters.actor(observation), parameters.log_std, action),
        advantage=jnp.arange(size, dtype=float),
        target=jnp.ones(size),
    )


def test_the_loss_of_unchanged_weights_is_minus_the_mean_normalised_advantage_plus_half_the_value_error(small_task):
    parameters = ppo.start(small_task, small_task.ppo, jax.random.key(0)).parameters
    batch = small_batch(parameters)
    total, parts = ppo.loss(small_task.ppo, parameters, batch)
    # the ratio is one everywhere, and normalised advantages have mean zero
    assert float(parts["policy_loss"]) == pytest.approx(0.0, abs=1e-6)
    value_error = jnp.mean((parameters.critic(batch.observation)[:, 0] - 1) ** 2)
    assert float(total) == pytest.approx(0.5 * float(value_error), rel=1e-5)


def test_clipping_takes_the_gradient_from_samples_that_have_moved_far_enough(small_task):
    parameters = ppo.start(small_task, small_task.ppo, jax.random.key(0)).parameters
    batch = small_batch(parameters)
    # every sample seems twice as likely as it was: with a positive advantage its ratio 2 lies beyond 1 + clip
    moved = dataclasses.replace(batch, log_probability=batch.log_probability - jnp.log(2.0))
    gradient = jax.grad(lambda p: ppo.loss(small_task.ppo, p, moved)[1]["policy_loss"])(parameters)
    negative = moved.advantage < jnp.mean(moved.advantage)
    fraction = ppo.loss(small_task.ppo, parameters, moved)[1]["clip_fraction"]
    assert float(fraction) == 1.0
    only_negative = dataclasses.replace(moved, action=jnp.where(negative[:, None], moved.action, 0.0))
    # a positive advantage beyond the clip gives no gradient, whatever the action was
    same = dataclasses.replace(
        only_negative,
        log_probability=jnp.where(
            negative,
            moved.log_probability,
            ppo.log_probability(parameters.actor(batch.observation), parameters.log_std, only_negative.action)
            - jnp.log(2.0),
        ),
    )
    again = jax.grad(lambda p: ppo.loss(small_task.ppo, p, same)[1]["policy_loss"])(parameters)
    for first, second in zip(jax.tree.leaves(gradient.actor), jax.tree.leaves(again.actor), strict=True):
        np.testing.assert_allclose(first, second, atol=1e-6)
    assert any(np.abs(leaf).max() > 1e-3 for leaf in jax.tree.leaves(gradient.actor))


@pytest.mark.parametrize("apart", [False, True])
def test_gradients_are_clipped_as_a_whole_or_apart(small_task, apart):
    settings = dataclasses.replace(small_task.ppo, separate_grad_clipping=apart, max_grad_norm=0.5)
    parameters = ppo.start(small_task, settings, jax.random.key(0)).parameters
    actor = jax.tree.map(lambda leaf: 0.1 * jnp.ones_like(leaf), parameters)
    gradient = dataclasses.replace(actor, critic=jax.tree.map(lambda leaf: 10 * jnp.ones_like(leaf), parameters.critic))
    flat, restore = ravel_pytree(gradient)
    method = ppo._clipping(settings, parameters)
    clipped = restore(method.update(flat, method.init(flat))[0])
    norm = {name: float(jnp.linalg.norm(ravel_pytree(getattr(clipped, name))[0])) for name in ("actor", "critic")}
    assert norm["critic"] == pytest.approx(0.5, rel=1e-3)
    if apart:
        assert float(clipped.log_std[0] / clipped.actor.weights[0][0, 0]) == pytest.approx(1)
        assert norm["actor"] == pytest.approx(0.5, rel=0.01)  # the standard deviations have the rest
    else:
        before = ravel_pytree(gradient.actor)[0], ravel_pytree(gradient.critic)[0]
        ratio = jnp.linalg.norm(before[0]) / jnp.linalg.norm(before[1])
        assert norm["actor"] == pytest.approx(float(ratio) * norm["critic"], rel=1e-3)


def test_the_learning_rate_falls_along_a_line_to_its_last_share(small_task):
    # one update of two minibatches and one epoch: steps of Adam on a constant gradient are as long as the rate
    settings = dataclasses.replace(
        small_task.ppo, steps=64, environments=8, rollout=8, minibatch=32, epochs=1, final_learning_rate=0.2
    )
    parameters = ppo.start(small_task, settings, jax.random.key(0)).parameters
    method = ppo._optimiser(settings, parameters)
    gradient = jnp.ones_like(ravel_pytree(parameters)[0])
    state, lengths = method.init(gradient), []
    for _ in range(4):
        step, state = method.update(gradient, state)
        lengths.append(float(-step[0]) / settings.learning_rate)
    np.testing.assert_allclose(lengths, [1.0, 0.6, 0.2, 0.2], rtol=0.01)


@pytest.mark.slow
def test_the_policy_multiplies_what_it_sees_with_what_it_was_trained_on(small_task):
    settings = dataclasses.replace(small_task.ppo, input_scale=(2.0, 3.0, 4.0, 5.0, 6.0))
    train_state = ppo.start(small_task, settings, jax.random.key(0))
    plain, scaled = (
        ppo.rollout(small_task, each, train_state.parameters, train_state.episodes, jax.random.key(1))[1]
        for each in (small_task.ppo, settings)
    )
    factors = np.repeat([2.0, 3.0, 4.0, 5.0, 6.0], [3, 4, 3, 3, 4])
    np.testing.assert_allclose(scaled.observation[0], factors * plain.observation[0], rtol=1e-6)
    np.testing.assert_array_equal(ppo.policy(settings, train_state).input_scale, factors)


def test_the_rollout_stores_what_was_seen_and_done_with_the_probability_it_had(small_task):
    train_state = ppo.start(small_task, small_task.ppo, jax.random.key(0))
    _, batch, seen = jax.jit(ppo.rollout, static_argnums=1)(
        small_task, small_task.ppo, train_state.parameters, train_state.episodes, jax.random.key(5)
    )
    assert batch.observation.shape == (16, 4, 17)
    mean = train_state.parameters.actor(batch.observation)
    again = ppo.log_probability(mean, train_state.parameters.log_std, batch.action)
    np.testing.assert_allclose(batch.log_probability, again, rtol=1e-4, atol=1e-4)
    # the action that is observed next is the clipped one, unless the episode was new
    carried = np.asarray(batch.observation[1:, :, 13:])
    expected = np.clip(batch.action[:-1], -1, 1)
    started = np.all(carried == 0, axis=-1)
    np.testing.assert_allclose(carried[~started], expected[~started], atol=1e-6)
    assert not started.all()
    assert sum(float(value) for value in seen["terms"].values()) == pytest.approx(float(seen["reward"]), rel=1e-5)


@pytest.mark.slow
def test_ppo_learns_to_survive_and_to_earn_more_within_half_a_million_steps():
    task = load_task("baseline")
    train_state, first = ppo.update(task, task.ppo, ppo.start(task, task.ppo, jax.random.key(0)))
    for _ in range(30):
        train_state, last = ppo.update(task, task.ppo, train_state)
    assert float(last["episode_length"]) > 5 * float(first["episode_length"])
    assert float(last["reward"]) > float(first["reward"]) + 0.05


@pytest.mark.slow
@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("final_learning_rate", [1.0, 0.1])
def test_the_kernel_and_jax_learn_the_same(small_task, monkeypatch, apart, final_learning_rate):
    settings = dataclasses.replace(
        small_task.ppo,
        separate_grad_clipping=apart,
        final_learning_rate=final_learning_rate,
        max_grad_norm=0.05,
        entropy_weight=0.01,
        learning_rate=3e-3,
    )
    train_state = ppo.start(small_task, settings, jax.random.key(0))
    batch = small_batch(train_state.parameters, size=64)
    found = []
    for kernels in (True, False):
        monkeypatch.setattr(ppo, "available", lambda kernels=kernels: kernels)
        before = train_state.parameters, train_state.optimiser
        for key in jax.random.split(jax.random.key(2), 3):
            *before, losses = ppo.learn(settings, *before, batch, key)
        found.append((*before, losses))
    for kernel, wanted in zip(jax.tree.leaves(found[0]), jax.tree.leaves(found[1]), strict=True):
        np.testing.assert_allclose(kernel, wanted, rtol=1e-3, atol=2e-6)
    assert jax.tree.structure(found[0]) == jax.tree.structure(found[1])
    change = ravel_pytree(found[0][0])[0] - ravel_pytree(train_state.parameters)[0]
    assert np.median(np.abs(change)) > 1e-2  # else the above says little


@pytest.mark.slow
def test_an_update_works_without_kernels_with_an_odd_batch_and_in_a_trace(small_task, monkeypatch):
    monkeypatch.setenv("FLYTUNE_KERNELS", "0")
    settings = dataclasses.replace(small_task.ppo, environments=3, rollout=8, minibatch=12, epochs=3)
    train_state = ppo.start(small_task, settings, jax.random.key(0))
    traced, measured = jax.jit(ppo.update, static_argnums=1)(small_task, settings, train_state)
    after, same = ppo.update(small_task, settings, train_state)
    np.testing.assert_allclose(ravel_pytree(after.parameters)[0], ravel_pytree(traced.parameters)[0], atol=1e-5)
    assert float(same["value_loss"]) == pytest.approx(float(measured["value_loss"]), rel=1e-4)
    assert after.episodes.steps.shape == (3,)


@pytest.mark.slow
def test_several_seeds_as_one_batch_learn_as_each_alone(small_task):
    keys = jax.random.split(jax.random.key(0), 2)
    start, update = (functools.partial(each, small_task, small_task.ppo) for each in (ppo.start, ppo.update))
    together, _ = jax.jit(jax.vmap(update))(jax.vmap(start)(keys))
    for index, key in enumerate(keys):
        alone, _ = update(start(key))
        found = ravel_pytree(jax.tree.map(lambda leaf, index=index: leaf[index], together.parameters))[0]
        np.testing.assert_allclose(found, ravel_pytree(alone.parameters)[0], atol=1e-5)


SCRIPT = """
import hashlib, os, sys
if sys.argv[1] == "one":
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
import jax, numpy as np
from flytune.task.files import load_task
from flytune.training import ppo
settings = {"ppo.environments": 6, "ppo.rollout": 32, "ppo.minibatch": 24, "ppo.epochs": 3, "ppo.hidden": [16, 16]}
task = load_task("baseline", settings)
state = ppo.start(task, task.ppo, jax.random.key(0))
for _ in range(3):
    state, metrics = ppo.update(task, task.ppo, state)
leaves = jax.tree.leaves((state.parameters, state.ema, state.optimiser, state.episodes, metrics))
print(hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in leaves)).hexdigest())
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system cannot take cores from a process")
def test_one_core_and_two_give_the_same_bits():
    def run(cores, **variables):
        environment = {**os.environ, **variables}
        command = [sys.executable, "-c", SCRIPT, cores]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout

    runs = run("one"), run("all"), run("all", FLYTUNE_CORES="1")
    assert len(runs[0]) > 60 and len(set(runs)) == 1
