"""The losses of proximal policy optimisation, sample by sample. Source: Schulman et al. 2017."""

import math
from typing import Any

import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from flytune.task.training_settings import PpoSettings


def log_probability(
    mean: Float[Array, "*batch 4"], log_std: Float[Array, "4"], action: Float[Array, "*batch 4"]
) -> Float[Array, "*batch"]:
    """The log density of actions under a diagonal Gaussian."""
    squared = ((action - mean) * jnp.exp(-log_std)) ** 2
    return -0.5 * jnp.sum(squared, axis=-1) - jnp.sum(log_std) - 0.5 * 4 * math.log(2 * math.pi)


def entropy(log_std: Float[Array, "4"]) -> Float[Array, ""]:
    """The entropy of a diagonal Gaussian."""
    return jnp.sum(log_std) + 0.5 * 4 * math.log(2 * math.pi * math.e)


def surrogate(
    settings: PpoSettings,
    logarithm: Float[Array, "*batch"],
    old_logarithm: Float[Array, "*batch"],
    advantage: Float[Array, "*batch"],
) -> tuple[Array, Array, Array]:
    """The clipped surrogate loss of each sample, whether its ratio was clipped, and its divergence from the old policy.

    Args:
        settings: hold the range of the ratio.
        logarithm: of the probability that the policy gives the action.
        old_logarithm: of the one that it had when the action was drawn.
        advantage: normalised.
    """
    ratio = jnp.exp(logarithm - old_logarithm)
    clipped = jnp.clip(ratio, 1 - settings.clip_range, 1 + settings.clip_range)
    loss = -jnp.minimum(ratio * advantage, clipped * advantage)
    beyond = (jnp.abs(ratio - 1) > settings.clip_range).astype(jnp.float32)
    return loss, beyond, ratio - 1 - (logarithm - old_logarithm)


def spread(advantage: Float[Array, "*minibatches N"]) -> Float[Array, "*minibatches"]:
    """What the advantages of a minibatch are divided by, after their mean is subtracted."""
    return jnp.std(advantage, axis=-1, ddof=1) + 1e-8


def learning_rate(settings: PpoSettings) -> Any:
    """The learning rate, or its schedule over the minibatches of all updates."""
    rate: Any = settings.learning_rate
    if settings.final_learning_rate < 1:
        minibatches = settings.environments * settings.rollout // settings.minibatch
        total = settings.updates * settings.epochs * minibatches
        rate = optax.linear_schedule(rate, rate * settings.final_learning_rate, total)
    return rate
