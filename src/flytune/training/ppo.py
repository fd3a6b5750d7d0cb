"""Proximal policy optimisation (Schulman et al. 2017), the paper's algorithm (R16 to R18), read from top to bottom.

Where the paper gives no detail, this follows Stable-Baselines3 2.x: a diagonal Gaussian whose standard deviation does
not depend on the state, advantages normalised per minibatch, gradients clipped by their global norm. An episode that
its horizon truncates counts with the value of its last state; after a failure nothing counts (Pardo et al. 2018).
One update is one compiled function: a rollout and twelve epochs.
"""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from flytune.config.pytree import pytree
from flytune.control.policy import Network, Policy, make_network
from flytune.kernels.dense import perceptron
from flytune.kernels.programs import program
from flytune.simulation.environment import Episode
from flytune.simulation.rollout import Draw, reset_all
from flytune.simulation.rollout import rollout as simulate
from flytune.task.observation import SIZE, input_scale
from flytune.task.task import Task
from flytune.task.training_settings import PpoSettings
from flytune.training.update import averaged, descend, rollout_metrics


@pytree
class Parameters:
    """The parameters that the gradient changes."""

    actor: Network  # 17 -> mean of the action
    critic: Network  # 17 -> value
    log_std: Float[Array, "4"]


@pytree
class TrainState:
    """Everything an update needs and changes."""

    parameters: Parameters
    ema: Network  # exponential moving average of the actor over updates; the one that is flown
    optimiser: Any  # Adam's moments of the parameters as one vector
    episodes: Episode  # a batch, along the last axis
    key: Array
    updates: Array


@pytree
class Batch:
    """Samples of a rollout, along the first axis or axes."""

    observation: Float[Array, "*batch 17"]
    action: Float[Array, "*batch 4"]  # as drawn, before clipping
    log_probability: Float[Array, "*batch"]
    advantage: Float[Array, "*batch"]
    target: Float[Array, "*batch"]  # advantage + value: what the critic learns


def policy(settings: PpoSettings, train_state: TrainState) -> Policy:
    """The policy that is flown: the averaged actor's mean action."""
    return Policy(actor=train_state.ema, input_scale=input_scale(settings.input_scale), squash="clip")


def last_policy(settings: PpoSettings, train_state: TrainState) -> Policy:
    """The policy of the last update, the paper's as printed."""
    return Policy(actor=train_state.parameters.actor, input_scale=input_scale(settings.input_scale), squash="clip")


@program(static=["settings"])
def start(task: Task, settings: PpoSettings, key: Array) -> TrainState:
    """The training state before the first update."""
    actor_key, critic_key, episode_key, key = jax.random.split(key, 4)
    parameters = Parameters(
        actor=make_network(actor_key, (SIZE, *settings.hidden, 4), last_gain=0.01),
        critic=make_network(critic_key, (SIZE, *settings.hidden, 1), last_gain=1.0),
        log_std=jnp.full(4, settings.initial_log_std, float),
    )
    keys = jax.random.split(episode_key, settings.environments)
    return TrainState(
        parameters=parameters,
        ema=parameters.actor,
        optimiser=_optimiser(settings, parameters).init(ravel_pytree(parameters)[0]),
        episodes=reset_all(task, keys),
        key=key,
        updates=jnp.zeros((), jnp.int32),
    )


@program(static=["settings"], donate=["train_state"])
def update(task: Task, settings: PpoSettings, train_state: TrainState) -> tuple[TrainState, dict[str, Any]]:
    """The training state after one update, and its metrics."""
    key, rollout_key, shuffle_key = jax.random.split(train_state.key, 3)
    episodes, batch, seen = rollout(task, settings, train_state.parameters, train_state.episodes, rollout_key)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
    parameters, optimiser, losses = learn(settings, train_state.parameters, train_state.optimiser, flat, shuffle_key)
    after = TrainState(
        parameters=parameters,
        ema=averaged(train_state.ema, parameters.actor, settings.ema_decay, train_state.updates),
        optimiser=optimiser,
        episodes=episodes,
        key=key,
        updates=train_state.updates + 1,
    )
    spread = jnp.var(flat.target)
    explained = 1 - jnp.var(flat.advantage) / jnp.where(spread > 0, spread, 1.0)
    return after, {**seen, **losses, "std": jnp.mean(jnp.exp(parameters.log_std)), "explained_variance": explained}


def rollout(
    task: Task, settings: PpoSettings, parameters: Parameters, episodes: Episode, key: Array
) -> tuple[Episode, Batch, dict[str, Any]]:
    """The episodes after `settings.rollout` steps, the samples [time, environment, ...], and their metrics."""
    noise_key, action_key, reset_key = jax.random.split(key, 3)
    steps, width = settings.rollout, settings.environments
    noise = jax.random.split(noise_key, (steps + 1, width))
    draws = Draw(
        noise=noise[:-1],
        keys=jax.random.split(reset_key, (steps, width)),
        controller=jax.random.normal(action_key, (steps, width, 4)),
        next_noise=noise[1:],  # before a reset: what a truncated episode would have gone on from
    )
    factor = input_scale(settings.input_scale)

    def decide(memory: Any, observation: Array, draw: Array, episodes: Episode) -> Any:
        seen = observation * factor
        mean = _outputs(parameters.actor, seen)
        action = mean + jnp.exp(parameters.log_std) * draw
        return memory, action, (seen, mean, action)

    (episodes, _), step = simulate(
        task, decide, (episodes, ()), draws, record=lambda task, after, moved, outcome: (outcome, moved)
    )
    (seen, mean, action), following, (outcome, moved) = step.notes, step.following * factor, step.record
    value, next_value = (
        _outputs(parameters.critic, each.reshape(-1, SIZE)).reshape(steps, width) for each in (seen, following)
    )
    advantage = advantages(
        outcome.reward,
        value,
        next_value,
        outcome.terminated,
        outcome.terminated | outcome.truncated,
        settings.discount,
        settings.gae_lambda,
    )
    batch = Batch(
        observation=seen,
        action=action,
        log_probability=log_probability(mean, parameters.log_std, action),
        advantage=advantage,
        target=advantage + value,
    )
    return episodes, batch, rollout_metrics(task, outcome, moved.reward, moved.steps)


def _outputs(network: Network, inputs: Float[Array, "batch inputs"]) -> Float[Array, "batch outputs"]:
    return perceptron(ravel_pytree(network)[0], network.sizes, inputs.T).T


def advantages(
    reward: Float[Array, "time *batch"],
    value: Float[Array, "time *batch"],
    next_value: Float[Array, "time *batch"],
    terminated: Array,
    ended: Array,
    discount: float,
    gae_lambda: float,
) -> Float[Array, "time *batch"]:
    """Generalised advantage estimates.

        delta_t = r_t + discount * V(s_{t+1}) * (not terminated) - V(s_t)
        A_t     = delta_t + discount * lambda * (not ended) * A_{t+1}

    `next_value` is the value of the state an action led to, before any reset, so that truncation bootstraps and
    termination does not.

    Source: Schulman et al. 2016, equation 16; Pardo et al. 2018.
    """
    delta = reward + discount * next_value * ~terminated - value

    def back(later: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        delta, ended = now
        here = delta + discount * gae_lambda * ~ended * later
        return here, here

    return jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, ended), reverse=True)[1]


def log_probability(
    mean: Float[Array, "*batch 4"], log_std: Float[Array, "4"], action: Float[Array, "*batch 4"]
) -> Float[Array, "*batch"]:
    """The log density of actions under a diagonal Gaussian."""
    squared = ((action - mean) * jnp.exp(-log_std)) ** 2
    return -0.5 * jnp.sum(squared, axis=-1) - jnp.sum(log_std) - 0.5 * 4 * math.log(2 * math.pi)


def learn(
    settings: PpoSettings, parameters: Parameters, optimiser: Any, batch: Batch, key: Array
) -> tuple[Parameters, Any, dict[str, Array]]:
    """Parameters and optimiser after all epochs over the samples [S, ...], and the mean losses of the last epoch."""
    samples = batch.action.shape[0]
    # one vector, so that clipping and Adam are a few long loops and not many short ones
    flat, restore = ravel_pytree(parameters)
    method = _optimiser(settings, parameters)
    # one matrix, so that shuffling is one gather
    columns = jnp.concatenate(
        [
            batch.observation,
            batch.action,
            jnp.stack([batch.log_probability, batch.advantage, batch.target], axis=-1),
        ],
        axis=-1,
    )

    def epoch(carry: Any, key: Array) -> Any:
        shuffled = columns[shuffle(key, samples)].reshape(-1, settings.minibatch, columns.shape[-1])
        return jax.lax.scan(minibatch, carry, jnp.swapaxes(shuffled, 1, 2))

    def minibatch(carry: Any, rows: Array) -> Any:
        flat, optimiser = carry
        part = Batch(
            observation=rows[:SIZE].T,
            action=rows[SIZE : SIZE + 4].T,
            log_probability=rows[SIZE + 4],
            advantage=rows[SIZE + 5],
            target=rows[SIZE + 6],
        )
        gradient, losses = jax.grad(lambda flat: loss(settings, restore(flat), part), has_aux=True)(flat)
        return descend(method, gradient, optimiser, flat), losses

    keys = jax.random.split(key, settings.epochs)
    (flat, optimiser), losses = jax.lax.scan(epoch, (flat, optimiser), keys)
    return restore(flat), optimiser, {name: jnp.mean(values[-1]) for name, values in losses.items()}


def shuffle(key: Array, number: int) -> Array:
    """The indices 0 to number - 1 in random order.

    One sort of random numbers whose low bits are the index: thirty times faster on a CPU than a sort of pairs. Of
    16,384 indices about one in thirty shares its 18 random bits with another, and such two keep their order; with
    fewer than 16 random bits left, `jax.random.permutation` does it.
    """
    low = max(number - 1, 1).bit_length()
    if low > 16:
        return jax.random.permutation(key, number)
    mask = jnp.uint32(2**low - 1)
    random = jax.random.bits(key, (number,), jnp.uint32) & ~mask
    return jnp.sort(random | jnp.arange(number, dtype=jnp.uint32)) & mask


def loss(settings: PpoSettings, parameters: Parameters, batch: Batch) -> tuple[Array, dict[str, Array]]:
    """The clipped surrogate, value and entropy loss of one minibatch, and its parts. Source: Schulman et al. 2017."""
    advantage = batch.advantage
    advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage, ddof=1) + 1e-8)
    logarithm = log_probability(_outputs(parameters.actor, batch.observation), parameters.log_std, batch.action)
    ratio = jnp.exp(logarithm - batch.log_probability)
    clipped = jnp.clip(ratio, 1 - settings.clip_range, 1 + settings.clip_range)
    policy_loss = -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
    value_loss = jnp.mean((_outputs(parameters.critic, batch.observation)[:, 0] - batch.target) ** 2)
    entropy = jnp.sum(parameters.log_std) + 0.5 * 4 * math.log(2 * math.pi * math.e)
    total = policy_loss + settings.value_weight * value_loss - settings.entropy_weight * entropy
    parts = {
        "loss": total,
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "clip_fraction": jnp.mean(jnp.abs(ratio - 1) > settings.clip_range),
        "approximate_kl": jnp.mean(ratio - 1 - (logarithm - batch.log_probability)),
    }
    return total, parts


def _optimiser(settings: PpoSettings, parameters: Parameters) -> optax.GradientTransformation:
    """What makes a step of a gradient, both as one vector."""
    rate: Any = settings.learning_rate
    if settings.final_learning_rate < 1:
        minibatches = settings.environments * settings.rollout // settings.minibatch
        total = settings.updates * settings.epochs * minibatches
        rate = optax.linear_schedule(rate, rate * settings.final_learning_rate, total)
    return optax.chain(_clipping(settings, parameters), optax.adam(rate, eps=1e-5))


def _clipping(settings: PpoSettings, parameters: Parameters) -> optax.GradientTransformation:
    """Gradients no longer than `max_grad_norm`: as a whole, or the critic's and the rest each for itself."""
    if not settings.separate_grad_clipping:
        return optax.clip_by_global_norm(settings.max_grad_norm)
    theirs = jax.tree.map(jnp.zeros_like, parameters)
    theirs = dataclasses.replace(theirs, critic=jax.tree.map(jnp.ones_like, parameters.critic))
    is_critic = ravel_pytree(theirs)[0]

    def clip(gradient: Any, parameters: Any = None) -> Any:
        squares = gradient**2
        critic = jnp.sum(squares * is_critic)
        actor = jnp.sum(squares * (1 - is_critic))
        longest = settings.max_grad_norm
        shrink = [jnp.minimum(1.0, longest / jnp.sqrt(jnp.maximum(part, 1e-30))) for part in (critic, actor)]
        return gradient * (is_critic * shrink[0] + (1 - is_critic) * shrink[1])

    return optax.stateless(clip)
