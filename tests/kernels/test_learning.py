"""Two learners as one kernel: a regression by two perceptrons, beside the same in JAX and NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytune.kernels.dense import parameters_of, plain
from flytune.kernels.learning import Learner, learn

SAMPLES, STEPS, WIDTH, RATE = 40, 7, 20, 0.1
SIZES = (3, 5, 2), (3, 4, 4, 1)


def squared_error(further, numbers, outputs, rest):
    """Of the outputs and a shift, which is a further parameter."""
    error = jnp.sum((outputs + jnp.sum(further) - rest[0]) ** 2)
    return numbers[0] * error, jnp.stack([error, outputs[0]])


def descent(numbers, own, other, gradient, state):
    """A step along the gradient divided by the length of both; the rest of the state counts and keeps the lengths."""
    return jnp.stack([state[0] - RATE * gradient / jnp.sqrt(own + other), state[1] + 1, own - other])


LEARNERS = tuple(Learner(sizes, further, 4, 2, squared_error) for sizes, further in zip(SIZES, (2, 0), strict=True))


@pytest.fixture(scope="module")
def given():
    """Orders, numbers, samples and states."""
    random = np.random.default_rng(0)
    orders = np.stack([random.permutation(SAMPLES)[:WIDTH] for _ in range(STEPS)]).astype(np.int32)
    numbers = random.uniform(0.5, 2.0, (STEPS, 1)).astype(np.float32)
    samples = [random.normal(size=(SAMPLES, 4)).astype(np.float32) for _ in LEARNERS]
    states = [random.normal(size=(3, each.parameters)).astype(np.float32) for each in LEARNERS]
    return tuple(jax.tree.map(jnp.asarray, each) for each in (orders, numbers, samples, states))


def run(given, threads, kept=STEPS):
    orders, numbers, samples, states = given
    return learn(LEARNERS, descent, jnp.int32(threads), orders, numbers, samples, states, kept)


def by_hand(given):
    """States and records as `learn` gives them, step by step in JAX."""
    orders, numbers, samples, states = given
    records = [[], []]
    for order, number in zip(orders, numbers, strict=True):
        gradients = []
        for learner, sample, state, record in zip(LEARNERS, samples, states, records, strict=True):
            columns, network = sample[order].T, parameters_of(learner.sizes)

            def mean(parameters, learner=learner, columns=columns, network=network, number=number):
                outputs = plain(parameters[:network], learner.sizes, columns[:3])
                costs, recorded = jax.vmap(squared_error, (None, None, 1, 1))(
                    parameters[network:], number, outputs, columns[3:]
                )
                return jnp.mean(costs), jnp.sum(recorded, axis=0)

            gradient, recorded = jax.grad(mean, has_aux=True)(state[0])
            gradients.append(gradient)
            record.append(recorded)
        first, second = (jnp.sum(gradient**2) for gradient in gradients)
        states = [
            jax.vmap(descent, (None, None, None, 0, 1), 1)(number, *lengths, gradient, state)
            for gradient, state, lengths in zip(gradients, states, ((first, second), (second, first)), strict=True)
        ]
    return states, [np.stack(record) for record in records]


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_two_learners_learn_as_step_by_step_in_jax(given, threads):
    found, wanted = run(given, threads), by_hand(given)
    for each, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(each, other, rtol=2e-4, atol=2e-5)
    moved = [np.abs(after[0] - before[0]).max() for after, before in zip(found[0], given[3], strict=True)]
    assert min(moved) > 0.05  # else the above says little


def test_each_learner_gets_the_length_of_the_others_gradient(given):
    # what `descent` keeps is the own squared length less the other's, so both keep the same with another sign
    (first, second), _ = run(given, 2)
    assert float(first[2, 0]) == -float(second[2, 0]) != 0


def test_one_thread_and_two_give_the_same_bits(given):
    one, two = run(given, 1), [run(given, 2) for _ in range(20)]
    for each in two:
        for first, second in zip(jax.tree.leaves(one), jax.tree.leaves(each), strict=True):
            np.testing.assert_array_equal(first, second)


def test_a_length_that_is_no_number_ends_and_reaches_the_other(given):
    orders, numbers, samples, states = given
    broken = [samples[0].at[:, 0].set(jnp.nan), samples[1]]
    (first, second), _ = run((orders, numbers, broken, states), 2)
    assert np.isnan(first[0]).all() and np.isnan(second[0]).all()


def test_records_of_the_last_minibatches_are_kept(given):
    orders, numbers, samples, states = given
    even = orders[:6], numbers[:6], samples, states
    for all_of_them, last in zip(run(even, 1, 6)[1], run(even, 1, 2)[1], strict=True):
        np.testing.assert_array_equal(all_of_them[4:], last)


def test_several_kernels_at_the_same_time_do_not_disturb_each_other(given):
    # each has cells of its own, and a thread of its own beside that of XLA: none waits for a thread of another
    from concurrent.futures import ThreadPoolExecutor

    wanted = run(given, 1)
    with ThreadPoolExecutor(8) as pool:
        for found in pool.map(lambda _: run(given, 2), range(32)):
            for first, second in zip(jax.tree.leaves(wanted), jax.tree.leaves(found), strict=True):
                np.testing.assert_array_equal(first, second)
