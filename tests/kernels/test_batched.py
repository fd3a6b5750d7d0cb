"""Kernels: the loop over a batch computes what JAX computes, with the same random numbers, and so do its gradients."""

import dataclasses
import os
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import erfinv
from tests.layouts import LAYOUTS

from flytune.kernels.batched import available, batched
from flytune.physics.vehicle import load_vehicle, vehicle_names
from flytune.simulation import environment
from flytune.task.files import load_task, preset_names

pytestmark = pytest.mark.skipif(not available(), reason="no kernels on this machine")

ANGLES = np.concatenate([np.linspace(-40, 40, 4001), [0.0, 1e-6, -1e-6, np.pi, -np.pi]])
SHARES = np.concatenate([np.linspace(-0.99999, 0.99999, 4001), [0.0, 1e-7, -1e-7]])
POSITIVE = np.concatenate([np.logspace(-30, 30, 4001), [1.0, 1 + 1e-6, 1 - 1e-6]])
FUNCTIONS = {
    "exp": (jnp.exp, np.linspace(-80, 80, 4001)),
    "log": (jnp.log, POSITIVE),
    "log1p": (jnp.log1p, np.concatenate([SHARES, POSITIVE])),
    "tanh": (jnp.tanh, np.concatenate([ANGLES, SHARES])),
    "sin": (jnp.sin, ANGLES),
    "cos": (jnp.cos, ANGLES),
    "asin": (jnp.arcsin, SHARES),
    "acos": (jnp.arccos, SHARES),
    "erf_inv": (erfinv, SHARES),
    "sqrt": (jnp.sqrt, POSITIVE),
    "power": (lambda x: x**1.7, np.logspace(-4, 4, 1001)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_an_elementary_function_has_the_precision_of_single_numbers(name):
    function, places = FUNCTIONS[name]
    x = jnp.asarray(places, jnp.float32)
    with jax.enable_x64(True):
        exact = np.asarray(function(jnp.asarray(np.asarray(x), jnp.float64)))
    found = np.asarray(batched(lambda _, value: function(value))(x))
    scale = np.abs(exact) + (1e-1 if name in ("sin", "cos") else 1e-30)  # sin and cos are small between their zeros
    assert np.max(np.abs(found - exact) / scale) < {"power": 3e-6, "erf_inv": 2e-6}.get(name, 6e-7)


@pytest.mark.parametrize("place", ["origin", "axes", "everywhere"])
def test_the_angle_of_two_numbers_is_right_in_every_quadrant(place):
    rng = np.random.default_rng(0)
    points = {
        "origin": np.zeros((2, 4)),
        "axes": np.array([[0.0, 1.0, 0.0, -1.0], [1.0, 0.0, -1.0, 0.0]]),
        "everywhere": rng.normal(size=(2, 1000)),
    }[place].astype(np.float32)
    found = batched(lambda _, y, x: jnp.arctan2(y, x))(*map(jnp.asarray, points))
    np.testing.assert_allclose(found, np.arctan2(*points.astype(float)), atol=4e-7)


@pytest.mark.floor
def test_the_numbers_of_a_row_and_the_slope_of_a_tanh_are_those_of_jax():
    def swapped_and_sloped(row):
        first, second = jnp.unstack(row)
        return jnp.stack([second, jax.grad(jnp.tanh)(first)])

    rows = jnp.stack([jnp.linspace(-4.0, 4.0, 9), jnp.linspace(1.0, 2.0, 9)])
    found = batched(lambda _, row: swapped_and_sloped(row))(rows)
    np.testing.assert_allclose(found, jax.vmap(swapped_and_sloped, -1, -1)(rows), rtol=1e-4, atol=1e-7)


def test_numbers_that_are_not_finite_stay_so():
    x = jnp.asarray([np.nan, np.inf, -np.inf, 0.0], jnp.float32)
    for function in (jnp.exp, jnp.log, jnp.tanh, jnp.abs, lambda v: jnp.maximum(v, 1.0), lambda v: jnp.minimum(v, 1.0)):
        np.testing.assert_allclose(batched(lambda _, v, f=function: f(v))(x), function(x), rtol=1e-6)
    np.testing.assert_array_equal(batched(lambda _, v: jnp.isfinite(v))(x), jnp.isfinite(x))


@pytest.mark.parametrize("number", [1, 7, 16, 33])
def test_random_numbers_are_those_of_jax(number):
    keys = jax.random.split(jax.random.key(3), number)

    def draw(_, key):
        first, second = jax.random.split(key)
        return jax.random.normal(first, (13,)), jax.random.uniform(jax.random.fold_in(second, 5), (3,), minval=-2.0)

    normal, uniform = batched(draw)(keys)
    expected_normal, expected_uniform = jax.vmap(partial(draw, None), out_axes=-1)(keys)
    np.testing.assert_allclose(normal, expected_normal, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(uniform, expected_uniform, rtol=1e-6)


def one_step(task, episode, action, key):
    """A whole step of the environment, with the start of the next episode where this one is over."""
    moved, outcome = environment.step(task, episode, action)
    after, over = environment.restart(task, episode, moved, outcome, key)
    return after, moved, over, outcome


def situation(task, number=37):
    """Moving episodes, some of them over their bounds, actions and keys."""
    keys = jax.random.split(jax.random.key(0), number)
    episodes = jax.vmap(partial(environment.reset, task), out_axes=-1)(keys)
    velocity, rate = (jax.random.normal(jax.random.key(seed), (3, number)) for seed in (1, 2))
    velocity, rate = 0.6 * task.speed_bound * velocity, 0.6 * task.limit("body_rate") * rate
    state = dataclasses.replace(episodes.state, velocity=tuple(velocity), body_rate=tuple(rate))
    actions = jax.random.uniform(jax.random.key(4), (4, number), minval=-1.2, maxval=1.2)
    return dataclasses.replace(episodes, state=state), actions, keys


# each preset, and each vehicle: a program of its own takes seconds to compile, so not each with each
TASKS = {preset: (preset, {}) for preset in preset_names()} | {
    vehicle: ("baseline", {"vehicle": vehicle}) for vehicle in vehicle_names()
}


# these have every term of the equations and every structure of a task
FEW = ("baseline", "dial", "inspection-refined", "crazyflie-b500", "hummingbird", "racer")


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in FEW)) for name in TASKS])
def test_a_step_and_its_gradient_are_those_of_jax(name):
    preset, edits = TASKS[name]
    _compare(load_task(preset, edits))


@pytest.mark.slow
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_step_with_another_layout_of_rotors_is_that_of_jax(layout):
    task = load_task("baseline")
    vehicle = dataclasses.replace(load_vehicle("crazyflie"), arm=None, rotors=LAYOUTS[layout])
    _compare(dataclasses.replace(task, vehicle=vehicle))


def _compare(task):
    episodes, actions, keys = situation(task)
    loop = batched(one_step, task)
    plain = jax.vmap(partial(one_step, task), in_axes=-1, out_axes=-1)
    found, expected = jax.jit(loop)(episodes, actions, keys), jax.jit(plain)(episodes, actions, keys)
    assert np.any(expected[2]) and not np.all(expected[2])  # some episodes are over
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert one.dtype == other.dtype and one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=2e-5, atol=2e-5)

    def cost(step, episodes, actions):
        after, moved, _, outcome = step(episodes, actions, keys)
        margins = sum(jnp.sum(jnp.minimum(margin, 1.0) ** 2) for margin in outcome.margins.values())
        return (
            jnp.sum(outcome.reward)
            + margins
            + jnp.sum(jnp.stack(moved.state.velocity) ** 2)
            + sum(jnp.sum(part) for part in after.state.position)
        )

    slopes, others = (
        jax.grad(partial(cost, step), (0, 1), allow_int=True)(episodes, actions) for step in (loop, plain)
    )
    for one, other in zip(jax.tree.leaves(slopes), jax.tree.leaves(others), strict=True):
        if one.dtype == jnp.float32 and one.size:
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4 * (1 + float(jnp.max(jnp.abs(other)))))


@pytest.mark.slow
def test_the_gradient_with_respect_to_the_shared_numbers_is_that_of_jax():
    task = load_task("baseline")
    episodes, actions, keys = situation(task)

    def cost(make, mass):
        changed = dataclasses.replace(task, vehicle=dataclasses.replace(task.vehicle, mass=mass))
        return jnp.sum(make(changed)(episodes, actions, keys)[1].state.body_rate[0] ** 2)

    loop = jax.grad(partial(cost, partial(batched, one_step)))(0.03)
    plain = jax.grad(partial(cost, lambda task: jax.vmap(partial(one_step, task), in_axes=-1, out_axes=-1)))(0.03)
    assert float(loop) == pytest.approx(float(plain), rel=1e-4) and float(plain) != 0


def test_a_batch_of_batches_is_computed_one_after_the_other():
    x = jnp.arange(24.0, dtype=jnp.float32).reshape(3, 8)
    np.testing.assert_allclose(jax.vmap(batched(lambda _, v: jnp.sin(v) * v))(x), jnp.sin(x) * x, rtol=1e-6, atol=1e-6)


def test_what_has_no_form_as_a_loop_runs_as_jax_and_says_so():
    x = jnp.linspace(0.1, 2.0, 5)
    with pytest.warns(UserWarning, match="kernels: lgamma of JAX has no form as a loop here"):
        found = batched(lambda _, v: jax.lax.lgamma(v))(x)
    np.testing.assert_array_equal(found, jax.lax.lgamma(x))


def test_kernels_can_be_switched_off():
    code = "from flytune.kernels.batched import available; print(available())"
    out = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"FLYTUNE_KERNELS": "0"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert out.stdout == "False\n"


def test_the_code_of_a_kernel_is_kept_and_a_damaged_file_is_replaced(tmp_path):
    code = (
        "import jax.numpy as jnp\n"
        "from flytune.kernels.batched import batched\n"
        "print(float(batched(lambda _, x: jnp.sin(x) + 1)(jnp.zeros(8))[0]))\n"
    )

    def run():
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        assert done.stdout == "1.0\n"
        (file,) = tmp_path.glob("flytune_*.o")
        return file

    kept = run()
    first, written = kept.read_bytes(), kept.stat().st_mtime_ns
    assert run().stat().st_mtime_ns == written  # it was not compiled again
    kept.write_bytes(first[:-10])
    assert run().read_bytes() == first
