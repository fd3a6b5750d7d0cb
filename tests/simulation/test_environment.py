"""Episodes: reset, observe, step and restart, for every preset and vehicle (paper R7 to R15)."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytune.physics import dynamics
from flytune.physics.vehicle import vehicle_names
from flytune.simulation import environment
from flytune.task.files import load_task, preset_names
from flytune.task.observation import observe
from flytune.task.reward import rewards
from flytune.task.situation import situation
from flytune.task.termination import SAFE, causes, margins

# each preset, and each vehicle: a program of its own takes seconds to compile, so not each with each
EVERY = [(preset, "crazyflie") for preset in preset_names()] + [
    ("baseline", vehicle) for vehicle in vehicle_names() if vehicle != "crazyflie"
]
ACTION = (0.3, -0.2, 0.1, -0.4)


@pytest.fixture(scope="module")
def compiled():
    """reset, step and observe, compiled once and shared; labels do not matter to the cache."""
    names = ("reset", "step", "observe")
    return dict(zip(names, (jax.jit(getattr(environment, name)) for name in names), strict=True))


@pytest.fixture(scope="module")
def baseline():
    """The baseline task."""
    return load_task("baseline")


def episode(task, position=(0.0, 0.0, 1.0), steps=0, last_action=(0, 0, 0, 0), **parts):
    """An episode at a given place."""
    state = dynamics.hovering(task.vehicle, tuple(map(jnp.float32, position)))
    state = dataclasses.replace(state, **{name: tuple(map(jnp.float32, part)) for name, part in parts.items()})
    return environment.Episode(
        state=state,
        last_action=jnp.array(last_action, jnp.float32),
        steps=jnp.int32(steps),
        reward=jnp.float32(0),
    )


def same(first, second, rtol=0.0, atol=0.0):
    """Two trees hold the same numbers."""
    pairs = zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True)
    for one, other in pairs:
        np.testing.assert_allclose(np.asarray(one), np.asarray(other), rtol=rtol, atol=atol)


def test_a_reset_starts_at_a_drawn_state_with_the_hover_action(compiled, baseline):
    key = jax.random.key(3)
    start = compiled["reset"](baseline, key)
    same(start.state, baseline.initial_state.draw(baseline.vehicle, baseline.target, key), atol=1e-6, rtol=1e-6)
    assert start.last_action.tolist() == [0, 0, 0, 0]
    assert (int(start.steps), float(start.reward)) == (0, 0.0)


def test_a_step_is_physics_then_situation_then_rewards_and_margins(compiled, baseline):
    before = episode(baseline, position=(0.4, -0.2, 1.1), velocity=(0.1, 0.0, 0.2), last_action=(0.1, 0.1, 0.0, 0.0))
    after, outcome = compiled["step"](baseline, before, jnp.array(ACTION))
    state = jax.jit(dynamics.step)(baseline.vehicle, before.state, jnp.array(ACTION))
    here = situation(baseline.reference(0), state, jnp.array(ACTION) - before.last_action)
    terms = rewards(baseline.reward, here)
    same(after.state, state, rtol=1e-6, atol=1e-7)
    same(outcome.terms, terms, rtol=1e-5, atol=1e-7)
    same(outcome.margins, margins(baseline.termination, here), rtol=1e-5, atol=1e-6)
    assert float(outcome.reward) == pytest.approx(sum(map(float, terms.values())), abs=1e-6)
    np.testing.assert_array_equal(after.last_action, np.float32(ACTION))
    assert (int(after.steps), float(after.reward)) == (1, float(outcome.reward))
    assert not outcome.terminated and not outcome.truncated and int(outcome.cause) == SAFE
    # smoothness by hand: da = (0.2, -0.3, 0.1, -0.4), |da|^2 = 0.04 + 0.09 + 0.01 + 0.16 = 0.3
    assert float(outcome.terms["smoothness"]) == pytest.approx(-0.1 * 0.3, rel=1e-5)


def test_an_episode_adds_up_its_rewards(compiled, baseline):
    here, total = episode(baseline), 0.0
    for _ in range(5):
        here, outcome = compiled["step"](baseline, here, jnp.array(ACTION))
        total += float(outcome.reward)
    assert float(here.reward) == pytest.approx(total, rel=1e-6)
    assert int(here.steps) == 5


def test_the_clipped_action_is_flown_penalised_and_observed(compiled, baseline):
    wild, tame = jnp.array([5.0, -3.0, 0.5, 1.0]), jnp.array([1.0, -1.0, 0.5, 1.0])
    one, other = (compiled["step"](baseline, episode(baseline), action) for action in (wild, tame))
    same(one, other)
    # |da|^2 = 1 + 1 + 0.25 + 1
    assert float(one[1].terms["smoothness"]) == pytest.approx(-0.1 * 3.25, rel=1e-6)
    seen = compiled["observe"](baseline, one[0], jnp.zeros(13))
    np.testing.assert_array_equal(seen[13:], tame)


def test_what_the_pilot_sees_is_the_observation_of_the_episode(compiled, baseline):
    here = episode(baseline, position=(0.4, -0.2, 1.1), last_action=ACTION)
    normal = jax.random.normal(jax.random.key(0), (13,))
    expected = observe(baseline.reference(0), baseline.noise, here.state, here.last_action, normal)
    np.testing.assert_allclose(compiled["observe"](baseline, here, normal), expected, rtol=1e-6, atol=1e-7)


# --- ends ---


@pytest.mark.parametrize(("steps", "truncated"), [(497, False), (498, False), (499, True), (600, True)])
def test_an_episode_is_truncated_at_its_horizon(compiled, baseline, steps, truncated):
    # horizon 500: the 500th step truncates
    _, outcome = compiled["step"](baseline, episode(baseline, steps=steps), jnp.zeros(4))
    assert (bool(outcome.terminated), bool(outcome.truncated)) == (False, truncated)


@pytest.mark.parametrize(
    ("where", "cause"),
    [
        ({"position": (0.0, 0.0, 0.05)}, "altitude"),
        ({"position": (3.0, 1.0, 1.0)}, "distance"),
        ({"velocity": (0.9, 0.0, 0.0)}, "speed"),
        ({"body_rate": (0.0, 0.0, 10.0)}, "body_rate"),  # 573 deg/s
        ({"position": (math.nan, 0.0, math.nan)}, "diverged"),
    ],
)
def test_an_episode_beyond_a_bound_is_terminated_and_says_why(compiled, baseline, where, cause):
    _, outcome = compiled["step"](baseline, episode(baseline, **where), jnp.zeros(4))
    assert outcome.terminated
    assert causes(baseline.termination)[int(outcome.cause)] == cause


def test_a_failure_at_the_horizon_is_a_failure_and_no_truncation(compiled, baseline):
    # what comes after a truncation still counts for the critic, so the two must not both be true
    _, outcome = compiled["step"](baseline, episode(baseline, velocity=(0.9, 0, 0), steps=499), jnp.zeros(4))
    assert (bool(outcome.terminated), bool(outcome.truncated)) == (True, False)


def test_restart_replaces_the_episodes_that_have_ended_and_no_others(baseline):
    cases = [{}, {"velocity": (0.9, 0, 0)}, {"steps": 499}, {"steps": 10, "position": (0.5, 0.5, 1.0)}]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(episode(baseline, **case) for case in cases))
    keys = jax.random.split(jax.random.key(7), 4)

    @jax.jit
    def advance(batch, keys):
        after, outcome = jax.vmap(lambda e: environment.step(baseline, e, jnp.array(ACTION)))(batch)
        renew = jax.vmap(lambda b, e, o, k: environment.restart(baseline, b, e, o, k))
        renewed, over = renew(batch, after, outcome, keys)
        return after, outcome, renewed, over, jax.vmap(lambda k: environment.reset(baseline, k))(keys)

    after, outcome, renewed, over, fresh = advance(batch, keys)
    assert (outcome.terminated | outcome.truncated).tolist() == over.tolist() == [False, True, True, False]
    for index, ended in enumerate([False, True, True, False]):
        expected = fresh if ended else after
        same([leaf[index] for leaf in jax.tree.leaves(renewed)], [leaf[index] for leaf in jax.tree.leaves(expected)])
    assert renewed.last_action[1].tolist() == [0, 0, 0, 0]
    np.testing.assert_array_equal(renewed.last_action[0], np.float32(ACTION))
    assert renewed.steps.tolist() == [1, 0, 0, 11]
    assert renewed.reward[1:3].tolist() == [0, 0]


# --- contracts over everything that ships ---


@pytest.fixture(scope="module")
def fly_batch():
    """Three steps of eight episodes of one task, compiled: final episodes and all outcomes."""

    @jax.jit
    def run(task, keys, actions):
        start = jax.vmap(lambda key: environment.reset(task, key))(keys)
        return jax.lax.scan(lambda e, a: jax.vmap(environment.step, (None, 0, 0))(task, e, a), start, actions)

    return run


@pytest.fixture(scope="module")
def fly_single():
    """The same for one episode."""

    @jax.jit
    def run(task, key, actions):
        return jax.lax.scan(lambda e, a: environment.step(task, e, a), environment.reset(task, key), actions)

    return run


BATCH = jax.random.split(jax.random.key(11), 8)
ACTIONS = np.random.default_rng(5).uniform(-1, 1, (3, 8, 4)).astype(np.float32)


@pytest.mark.parametrize(("preset", "vehicle"), EVERY)
def test_a_batch_of_episodes_is_each_of_them_alone(preset, vehicle, fly_batch, fly_single):
    task = load_task(preset, {"vehicle": vehicle})
    together = fly_batch(task, BATCH, ACTIONS)
    for index in range(8):
        alone = fly_single(task, BATCH[index], ACTIONS[:, index])
        of_batch = [leaf[index] for leaf in jax.tree.leaves(together[0])]
        of_batch += [leaf[:, index] for leaf in jax.tree.leaves(together[1])]
        same(of_batch, alone, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("preset", "vehicle"), EVERY)
def test_the_compiled_step_is_the_step_as_it_is_written(preset, vehicle, compiled):
    task = load_task(preset, {"vehicle": vehicle})
    before = episode(task, position=(0.4, -0.2, 1.1), velocity=(0.1, 0.0, 0.1), body_rate=(0.3, -0.2, 0.1))
    same(
        compiled["step"](task, before, jnp.array(ACTION)), environment.step(task, before, jnp.array(ACTION)), 1e-5, 1e-5
    )


@pytest.mark.parametrize(("preset", "vehicle"), EVERY)
def test_the_reward_of_a_step_is_the_sum_of_its_terms_and_the_cause_fits_its_margins(preset, vehicle, fly_batch):
    task = load_task(preset, {"vehicle": vehicle})
    _, outcome = fly_batch(task, BATCH, ACTIONS)
    assert set(outcome.terms) == set(task.reward) and set(outcome.margins) == set(task.termination)
    np.testing.assert_allclose(sum(outcome.terms.values()), outcome.reward, atol=1e-6)
    broken = np.any([np.asarray(margin) < 0 for margin in outcome.margins.values()], axis=0)
    np.testing.assert_array_equal(outcome.terminated, broken)
    np.testing.assert_array_equal(np.asarray(outcome.cause) != SAFE, broken)
    assert not np.any(outcome.terminated & outcome.truncated)


def test_another_number_does_not_compile_another_program(baseline):
    traced = []

    @jax.jit
    def step(task, here):
        traced.append(task)
        return environment.step(task, here, jnp.zeros(4))[1].reward

    edits = [
        {"reward.velocity.weight": 0.3},
        {"reward.horizontal.narrow": 30.0},
        {"termination.speed.bound": 0.5},
        {"vehicle.mass": 0.04, "vehicle.maximum_rotor_speed_rpm": 3e4},
        {"noise.position": 0.0, "target.yaw": 1.0, "horizon": 100},
        {"name": "other", "duration": 12.0},
        {"vehicle": "crazyflie-measured"},
        {"ppo.steps": 10, "apg.updates": 3},
    ]
    results = {float(step(load_task("baseline", edit), episode(baseline, velocity=(0.5, 0, 0)))) for edit in edits}
    assert len(traced) == 1
    assert len(results) > 1
    step(load_task("baseline", {"reward.velocity.of": "body_rate"}), episode(baseline))
    assert len(traced) == 2  # another structure does
