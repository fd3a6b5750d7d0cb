"""Analytic policy gradient: the gradient is the true one, and following it flies."""

import dataclasses
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytune.evaluation.fly import fly
from flytune.evaluation.judge import judge
from flytune.simulation import environment
from flytune.simulation.rollout import Draw
from flytune.task.files import load_task
from flytune.task.observation import input_scale
from flytune.training import apg


@pytest.fixture(scope="module")
def train_state(small_task):
    return apg.start(small_task, small_task.apg, jax.random.key(0))


@pytest.mark.slow
def test_the_gradient_agrees_with_finite_differences_of_the_flown_reward(small_task, train_state):
    shape = (small_task.apg.window, small_task.apg.environments)
    noise, keys = (jax.random.split(jax.random.key(seed), shape) for seed in (1, 2))
    draws = Draw(noise=noise, keys=keys)

    def cost(actor):
        return apg._loss(small_task, small_task.apg, actor, train_state.episodes, draws)[0]

    value, gradient = jax.jit(jax.value_and_grad(cost))(train_state.actor)
    jitted = jax.jit(cost)
    assert np.isfinite(value)
    # along the gradient itself the directional derivative is its squared norm
    squared = sum(float(jnp.sum(leaf**2)) for leaf in jax.tree.leaves(gradient))
    size = 1e-2 / squared**0.5
    ahead = jax.tree.map(lambda w, g: w + size * g, train_state.actor, gradient)
    behind = jax.tree.map(lambda w, g: w - size * g, train_state.actor, gradient)
    measured = (float(jitted(ahead)) - float(jitted(behind))) / (2 * size)
    assert measured == pytest.approx(squared, rel=0.03)


def test_the_barrier_costs_nothing_inside_its_margin_and_grows_as_a_square_beyond(small_task):
    settings = dataclasses.replace(small_task.apg, barrier_weight=30.0, barrier_margin=0.1)
    costs = [float(apg.barrier(jnp.asarray(margin), settings)) for margin in (0.5, 0.1, 0.0, -0.1)]
    # 30 * 0.1^2 = 0.3 at the bound, 30 * 0.2^2 = 1.2 as far beyond
    np.testing.assert_allclose(costs, [0.0, 0.0, 0.3, 1.2], atol=1e-6)


def test_beyond_its_knee_the_barrier_goes_on_as_the_tangent_of_the_square(small_task):
    settings = dataclasses.replace(small_task.apg, barrier_weight=30.0, barrier_margin=0.1, barrier_knee=0.2)
    value = jax.value_and_grad(apg.barrier)
    # depth 0.1 and 0.2: 30 * 0.1^2 and 30 * 0.2^2; then 30 * 2 * 0.2 = 12 for each unit of depth
    costs, slopes = zip(*(value(margin, settings) for margin in (0.0, -0.1, -0.6, -7.1)), strict=True)
    np.testing.assert_allclose(costs, [0.3, 1.2, 1.2 + 0.5 * 12, 1.2 + 7 * 12], rtol=1e-5)
    np.testing.assert_allclose([slopes[0], *slopes[2:]], [-6.0, -12.0, -12.0], rtol=1e-5)


def flying(speed):
    return jnp.asarray(speed, jnp.float32), jnp.zeros(()), jnp.zeros(())


@pytest.mark.parametrize(("slack", "over"), [(0.0, True), (0.3, True), (0.6, False)])
def test_an_episode_ends_where_a_bound_is_passed_by_more_than_the_termination_slack(small_task, slack, over):
    # 1.5 times as fast as allowed: a margin of -0.5
    episode = environment.reset(small_task, jax.random.key(0))
    fast = dataclasses.replace(episode.state, velocity=flying(1.5 * small_task.speed_bound))
    moved, outcome = environment.step(small_task, dataclasses.replace(episode, state=fast), jnp.zeros(4))
    assert bool(outcome.terminated)
    assert bool(environment.with_slack(small_task, moved, outcome, slack).terminated) is over


@pytest.mark.parametrize(("share", "over"), [(0.5, True), (1.0, False)])
def test_a_termination_may_have_a_slack_of_its_own(small_task, share, over):
    bounds = {**small_task.termination, "speed": dataclasses.replace(small_task.termination["speed"], slack=share)}
    task = dataclasses.replace(small_task, termination=bounds)
    episode = environment.reset(task, jax.random.key(0))
    fast = dataclasses.replace(episode.state, velocity=flying(1.5 * task.speed_bound))
    moved, outcome = environment.step(task, dataclasses.replace(episode, state=fast), jnp.zeros(4))
    # a margin of -0.5, and a slack of 0.6 times the share
    assert bool(environment.with_slack(task, moved, outcome, 0.6).terminated) is over


def test_an_episode_within_the_termination_slack_still_ends_at_its_horizon(small_task):
    episode = environment.reset(small_task, jax.random.key(0))
    fast = dataclasses.replace(episode.state, velocity=flying(1.2 * small_task.speed_bound))
    last = dataclasses.replace(episode, state=fast, steps=jnp.asarray(small_task.horizon - 1))
    moved, outcome = environment.step(small_task, last, jnp.zeros(4))
    assert not bool(outcome.truncated)
    outcome = environment.with_slack(small_task, moved, outcome, 0.5)
    assert bool(outcome.truncated)
    assert not bool(outcome.terminated)


def test_each_block_of_the_observation_has_its_own_scale(small_task):
    scale = input_scale((1.0, 2.0, 3.0, 4.0, 5.0))
    np.testing.assert_array_equal(scale, [1] * 3 + [2] * 4 + [3] * 3 + [4] * 3 + [5] * 4)


def test_episodes_continue_from_update_to_update(small_task):
    train_state = apg.start(small_task, small_task.apg, jax.random.key(0))
    train_state, _ = apg.update(small_task, small_task.apg, train_state)
    train_state, _ = apg.update(small_task, small_task.apg, train_state)
    assert int(jnp.max(train_state.episodes.steps)) == 2 * small_task.apg.window


def test_the_average_is_the_mean_of_the_first_weights(small_task):
    train_state = apg.start(small_task, small_task.apg, jax.random.key(0))
    seen = []
    for _ in range(3):
        train_state, _ = apg.update(small_task, small_task.apg, train_state)
        seen.append(np.asarray(train_state.actor.weights[0]))
    np.testing.assert_allclose(train_state.ema.weights[0], np.mean(seen, axis=0), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("vehicle", "updates", "wanted"), [("crazyflie", 200, 99), ("crazyflie-measured", 400, 95)])
def test_apg_settles_the_trials_on_every_axis_without_a_crash(vehicle, updates, wanted):
    task = load_task("baseline", {"vehicle": vehicle, "apg.updates": updates})
    train_state = apg.start(task, task.apg, jax.random.key(0))
    for _ in range(task.apg.updates):
        train_state, _ = apg.update(task, task.apg, train_state)
    judgement = judge(fly(apg.policy(task.apg, train_state), task))
    settled = {axis: judgement.settled(axis) for axis in ("x", "y", "z", "yaw")}
    assert min(settled.values()) >= wanted, settled
    assert not judgement.crashed.any()


SCRIPT = """
import dataclasses, hashlib, os, sys
if sys.argv[1] == "one":
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
import jax, numpy as np
from flytune.task.files import load_task
from flytune.training import apg
task = load_task("baseline")
settings = dataclasses.replace(task.apg, environments=6, window=20, hidden=(8, 8))
state = apg.start(task, settings, jax.random.key(0))
for _ in range(3):
    state, metrics = apg.update(task, settings, state)
leaves = jax.tree.leaves((state.actor, state.episodes, metrics))
print(hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in leaves)).hexdigest())
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system cannot take cores from a process")
def test_one_core_and_two_give_the_same_bits():
    runs = [
        subprocess.run([sys.executable, "-c", SCRIPT, cores], capture_output=True, text=True, check=True).stdout
        for cores in ("one", "all")
    ]
    assert len(runs[0]) > 60 and runs[0] == runs[1]
