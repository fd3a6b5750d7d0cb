"""The epochs of proximal policy optimisation as one kernel, with actor and critic in a thread each.

The same arithmetic as `ppo.learn` in JAX, up to rounding. What the two networks share is the length of the gradient.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from flytune.kernels.learning import Learner, learn
from flytune.task.training_settings import PpoSettings
from flytune.training.surrogate import entropy, learning_rate, log_probability, spread, surrogate

B1, B2, EPS = 0.9, 0.999, 1e-5  # of Adam, as Stable-Baselines3 has them


def learn_in_threads(
    settings: PpoSettings, parameters: Any, optimiser: Any, batch: Any, orders: Array, threads: Any
) -> tuple[Any, Any, dict[str, Array]]:
    """Parameters and optimiser after all minibatches, and the mean losses of the last epoch.

    Args:
        settings: of the training.
        parameters: see `ppo.Parameters`.
        optimiser: the memory of Adam.
        batch: see `ppo.Batch`; samples [S, ...].
        orders: the samples of each minibatch [T, N].
        threads: that may run.
    """
    count = optax.tree_utils.tree_get_all_with_path(optimiser, "count")[0][1]
    restore = ravel_pytree(parameters)[1]
    moments = [restore(optax.tree_utils.tree_get(optimiser, name)) for name in ("mu", "nu")]
    pairs: list[Any] = [_two_vectors(each) for each in (parameters, *moments)]
    states = [jnp.stack(each) for each in zip(*pairs, strict=True)]
    samples = [
        jnp.concatenate([batch.observation, batch.action, batch.log_probability[:, None], batch.advantage[:, None]], 1),
        jnp.concatenate([batch.observation, batch.target[:, None]], 1),
    ]
    minibatches = batch.action.shape[0] // settings.minibatch
    (actor, critic), (of_actor, of_critic) = learn(
        _learners(settings, parameters),
        _descent(settings),
        jnp.asarray(threads, jnp.int32),
        orders.astype(jnp.int32),
        _numbers(settings, batch.advantage[orders], count),
        samples,
        states,
        minibatches,
    )
    vectors = [_one_vector(parameters, *each) for each in zip(actor, critic, strict=True)]
    policy_loss, clip_fraction, approximate_kl, surprise = jnp.mean(of_actor, axis=0) / settings.minibatch
    value_loss = jnp.mean(of_critic) / settings.minibatch
    losses = {
        "loss": policy_loss + settings.value_weight * value_loss - settings.entropy_weight * surprise,
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "clip_fraction": clip_fraction,
        "approximate_kl": approximate_kl,
    }
    after = optax.tree_utils.tree_set(optimiser, count=count + orders.shape[0], mu=vectors[1], nu=vectors[2])
    return restore(vectors[0]), after, losses


def _learners(settings: PpoSettings, parameters: Any) -> tuple[Learner, Learner]:
    """The actor with the standard deviations, and the critic."""

    def actor_cost(log_std: Array, numbers: Array, mean: Array, rest: Array) -> Any:
        advantage = (rest[5] - numbers[0]) / numbers[1]
        logarithm = log_probability(mean, log_std, rest[:4])
        loss, beyond, divergence = surrogate(settings, logarithm, rest[4], advantage)
        surprise = entropy(log_std)
        return loss - settings.entropy_weight * surprise, jnp.stack([loss, beyond, divergence, surprise])

    def critic_cost(_: Array, numbers: Array, value: Array, rest: Array) -> Any:
        error = (value[0] - rest[0]) ** 2
        return settings.value_weight * error, error[None]

    return (
        Learner(parameters.actor.sizes, 4, parameters.actor.sizes[0] + 6, 4, actor_cost),
        Learner(parameters.critic.sizes, 0, parameters.critic.sizes[0] + 1, 1, critic_cost),
    )


def _numbers(settings: PpoSettings, advantage: Array, count: Array) -> Array:
    """What a step needs of each minibatch: mean and spread of the advantages, learning rate, corrections of Adam."""
    counts = count + jnp.arange(advantage.shape[0])
    rate = learning_rate(settings)
    rates: Any = rate(counts) if callable(rate) else jnp.full(counts.shape, rate)
    corrections = 1 - B1 ** (counts + 1), 1 - B2 ** (counts + 1)
    return jnp.stack([jnp.mean(advantage, axis=-1), spread(advantage), rates, *corrections], axis=-1)


def _descent(settings: PpoSettings) -> Callable[..., Array]:
    """A step of Adam with a clipped gradient, of one parameter. Source: Kingma and Ba 2015."""

    def descent(numbers: Array, own: Array, other: Array, gradient: Array, state: Array) -> Array:
        parameter, mean, square = state
        length = jnp.sqrt(own if settings.separate_grad_clipping else own + other)
        gradient = jnp.where(length < settings.max_grad_norm, gradient, gradient / length * settings.max_grad_norm)
        mean, square = B1 * mean + (1 - B1) * gradient, B2 * square + (1 - B2) * gradient**2
        _, _, rate, first, second = numbers
        return jnp.stack([parameter - rate * (mean / first) / (jnp.sqrt(square / second) + EPS), mean, square])

    return descent


def _two_vectors(parameters: Any) -> tuple[Any, Any]:
    """The parameters of the actor with the standard deviations, and of the critic."""
    return jnp.concatenate([ravel_pytree(parameters.actor)[0], parameters.log_std]), ravel_pytree(parameters.critic)[0]


def _one_vector(parameters: Any, actor: Array, critic: Array) -> Array:
    """The two vectors as one, in the order of `ravel_pytree`."""
    network = actor.shape[0] - parameters.log_std.shape[0]
    return jnp.concatenate([actor[:network], critic, actor[network:]])
