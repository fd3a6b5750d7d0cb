"""Proximal policy optimisation (Schulman et al. 2017), the paper's algorithm (R16 to R18), read from top to bottom.

Where the paper gives no detail, this follows Stable-Baselines3 2.x: a diagonal Gaussian whose standard deviation does
not depend on the state, advantages normalised per minibatch, gradients clipped by their global norm. An episode that
its horizon truncates counts with the value of its last state; after a failure nothing counts (Pardo et al. 2018).
One update is a rollout, in two parts, and twelve epochs.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, UInt32

from flytune.config.pytree import pytree
from flytune.control.policy import Network, Policy, make_network, with_output
from flytune.kernels.batched import available
from flytune.kernels.dense import perceptron
from flytune.kernels.programs import program
from flytune.physics.rotors import hover_action
from flytune.simulation.environment import Episode, Outcome
from flytune.simulation.rollout import Draw, reset_all
from flytune.simulation.rollout import rollout as simulate
from flytune.task.observation import input_scale
from flytune.task.task import Task
from flytune.task.training_settings import PpoSettings
from flytune.training.epochs import B1, B2, EPS, learn_in_threads
from flytune.training.surrogate import entropy, learning_rate, log_probability, spread, surrogate
from flytune.training.threads import PARTS, BusyCores, in_threads
from flytune.training.update import (
    averaged,
    descend,
    metrics_of,
    network_scale,
    rollout_sums,
    turned,
)
from flytune.training.warm_start import Critic, rescaled

_busy_cores = BusyCores()


@pytree
class Parameters:
    """The parameters that the gradient changes."""

    actor: Network  # observation and further inputs -> mean of the action
    critic: Network  # the same -> value
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

    observation: Float[Array, "*batch inputs"]  # scaled
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
        actor=make_network(actor_key, (task.inputs, *settings.hidden, 4), last_gain=0.01),
        critic=make_network(critic_key, (task.inputs, *settings.hidden, 1), last_gain=1.0),
        log_std=jnp.full(4, settings.initial_log_std, float),
    )
    if task.vehicle.action_scale is None:  # then the action 0 does not hover
        actor = with_output(parameters.actor, hover_action(task.vehicle))
        parameters = dataclasses.replace(parameters, actor=actor)
    keys = jax.random.split(episode_key, settings.environments)
    return TrainState(
        parameters=parameters,
        ema=parameters.actor,
        optimiser=_optimiser(settings, parameters).init(ravel_pytree(parameters)[0]),
        episodes=reset_all(task, keys),
        key=key,
        updates=jnp.zeros((), jnp.int32),
    )


def warm_start(
    settings: PpoSettings, train_state: TrainState, policy: Policy, critic: Critic | None = None
) -> TrainState:
    """The training state before the first update, with an actor whose mean action is that of `policy`.

    The critic is `critic`, or has new weights where that is None. The spread of the actions is that of the settings,
    `initial_log_std`, and the optimiser begins anew.
    """
    actor, ema = (rescaled(policy.actor, policy.input_scale, settings.input_scale) for _ in range(2))
    parameters = dataclasses.replace(train_state.parameters, actor=actor)
    if critic is not None:
        network = rescaled(critic.network, critic.input_scale, settings.input_scale)
        parameters = dataclasses.replace(parameters, critic=network)
    return dataclasses.replace(train_state, parameters=parameters, ema=ema)


def update(task: Task, settings: PpoSettings, train_state: TrainState) -> tuple[TrainState, dict[str, Any]]:
    """The training state after one update, and its metrics.

    The rollout is computed in parts, and actor and critic learn apart. On two cores both happen at the same time; the
    numbers are the same bit by bit.
    """
    number = PARTS if settings.environments % PARTS == 0 else 1

    def part(index: int) -> Any:
        return _part(
            task, settings, number, train_state.parameters, train_state.episodes, train_state.key, np.int32(index)
        )

    parts = in_threads(part, number, train_state.updates)
    if isinstance(train_state.updates, Tracer):
        return _learn(settings, train_state, parts, np.int32(1))
    return _busy_cores.run(lambda threads: _learn(settings, train_state, parts, np.int32(threads)))


@program(static=["settings", "number"])
def _part(
    task: Task, settings: PpoSettings, number: int, parameters: Parameters, episodes: Episode, key: Array, index: Array
) -> tuple[Episode, Batch, dict[str, Any], Array]:
    """A part of the episodes after a rollout, its samples and sums, and the orders of a part of the epochs."""
    width, epochs = settings.environments // number, -(-settings.epochs // number)
    mine = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, index * width, width, axis=-1), episodes)
    mine = turned(task, mine, jax.random.fold_in(jax.random.fold_in(key, index), 2))
    rollout_key, shuffle_key = jax.random.split(jax.random.fold_in(key, index))
    narrow = dataclasses.replace(settings, environments=width)
    samples = settings.environments * settings.rollout
    keys = jax.random.split(shuffle_key, epochs)
    return *rollout(task, narrow, parameters, mine, rollout_key), orders(keys, samples)


@program(static=["settings"], donate=["train_state"])
def _learn(settings: PpoSettings, train_state: TrainState, parts: tuple[Any, ...], threads: Array) -> Any:
    """The training state after all epochs over the samples of all parts, and the metrics."""
    episodes, batches, sums, shuffled = zip(*parts, strict=True)
    batch = jax.tree.map(lambda *leaves: _flat(jnp.concatenate(leaves, axis=1)), *batches)
    total = jax.tree.map(lambda *leaves: sum(leaves[1:], start=leaves[0]), *sums)
    order = jnp.concatenate(shuffled)[: settings.epochs]
    before = train_state.parameters, train_state.optimiser
    parameters, optimiser, losses = learn_in_order(settings, *before, batch, order, threads)
    after = TrainState(
        parameters=parameters,
        ema=averaged(train_state.ema, parameters.actor, settings.ema_decay, train_state.updates),
        optimiser=optimiser,
        episodes=jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=-1), *episodes),
        key=jax.random.fold_in(train_state.key, len(parts)),
        updates=train_state.updates + 1,
    )
    variance = jnp.var(batch.target)
    explained = 1 - jnp.var(batch.advantage) / jnp.where(variance > 0, variance, 1.0)
    metrics = {**metrics_of(total), **losses, "explained_variance": explained}
    return after, {**metrics, "std": jnp.mean(jnp.exp(parameters.log_std))}


def _flat(samples: Array) -> Array:
    """Samples [time, environment, ...] as [time * environment, ...]."""
    return samples.reshape(-1, *samples.shape[2:])


def rollout(
    task: Task, settings: PpoSettings, parameters: Parameters, episodes: Episode, key: Array
) -> tuple[Episode, Batch, dict[str, Any]]:
    """The episodes after a rollout, the samples [time, environment, ...], and their sums.

    Args:
        task: of the episodes, or their family.
        settings: `rollout` steps are simulated in `environments` episodes.
        parameters: of actor, critic and exploration.
        episodes: before the rollout, the batch along the last axis.
        key: of noise, exploration and new episodes.
    """
    noise_key, action_key, reset_key = jax.random.split(key, 3)
    steps, width = settings.rollout, settings.environments
    noise = jax.random.split(noise_key, (steps + 1, width))
    draws = Draw(
        noise=noise[:-1],
        keys=jax.random.split(reset_key, (steps, width)),
        controller=jax.random.normal(action_key, (steps, width, 4)),
        next_noise=noise[1:],  # before a reset: what a truncated episode would have gone on from
    )
    factor = network_scale(task, settings.input_scale)

    def decide(memory: Any, observation: Array, draw: Array, episodes: Episode) -> Any:
        seen = observation * factor
        mean = _outputs(parameters.actor, seen)
        action = mean + jnp.exp(parameters.log_std) * draw
        return memory, action, (seen, mean, action)

    def record(task: Task, after: Episode, moved: Episode, outcome: Outcome) -> Any:
        return outcome, moved.reward, moved.steps

    (episodes, _), step = simulate(task, decide, (episodes, ()), draws, record=record)
    (seen, mean, action), following, (outcome, rewards, lengths) = step.notes, step.following * factor, step.record
    value, next_value = (
        _outputs(parameters.critic, each.reshape(-1, task.inputs)).reshape(steps, width) for each in (seen, following)
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
    return episodes, batch, rollout_sums(task, outcome, rewards, lengths)


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

    Args:
        reward: of each step.
        value: V(s_t).
        next_value: of the state an action led to, before any reset, so that truncation bootstraps and termination does
            not.
        terminated: whether the episode failed in this step.
        ended: whether it is over for any reason.
        discount: per step.
        gae_lambda: lambda, per step.

    Source: Schulman et al. 2016, equation 16; Pardo et al. 2018.
    """
    delta = reward + discount * next_value * ~terminated - value

    def back(later: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        delta, ended = now
        here = delta + discount * gae_lambda * ~ended * later
        return here, here

    return jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, ended), reverse=True)[1]


def learn(
    settings: PpoSettings, parameters: Parameters, optimiser: Any, batch: Batch, key: Array, threads: Any = 1
) -> tuple[Parameters, Any, dict[str, Array]]:
    """Parameters and optimiser after all epochs over the samples [S, ...], and the mean losses of the last epoch.

    Args:
        settings: of the surrogate, the minibatches and the optimiser.
        parameters: before.
        optimiser: its moments before.
        batch: the samples.
        key: of their order in each epoch.
        threads: 1 or 2, where kernels run.
    """
    shuffled = orders(jax.random.split(key, settings.epochs), batch.action.shape[0])
    return learn_in_order(settings, parameters, optimiser, batch, shuffled, threads)


def orders(keys: Array, samples: int) -> UInt32[Array, "epochs samples"]:
    """The order of the samples in each epoch, one epoch per key."""
    return jax.lax.map(lambda key: shuffle(key, samples), keys)


def learn_in_order(
    settings: PpoSettings, parameters: Parameters, optimiser: Any, batch: Batch, orders: Array, threads: Any
) -> tuple[Parameters, Any, dict[str, Array]]:
    """The same with the samples in a given order [epochs, S]: one kernel in up to two threads where kernels run."""
    if available():
        orders = orders.reshape(-1, settings.minibatch)
        return learn_in_threads(settings, parameters, optimiser, batch, orders, threads)
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

    def epoch(carry: Any, order: Array) -> Any:
        shuffled = columns[order].reshape(-1, settings.minibatch, columns.shape[-1])
        return jax.lax.scan(minibatch, carry, jnp.swapaxes(shuffled, 1, 2))

    def minibatch(carry: Any, rows: Array) -> Any:
        flat, optimiser = carry
        part = Batch(
            observation=rows[:-7].T,
            action=rows[-7:-3].T,
            log_probability=rows[-3],
            advantage=rows[-2],
            target=rows[-1],
        )
        gradient, losses = jax.grad(lambda flat: loss(settings, restore(flat), part), has_aux=True)(flat)
        return descend(method, gradient, optimiser, flat), losses

    (flat, optimiser), losses = jax.lax.scan(epoch, (flat, optimiser), orders)
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
    advantage = (batch.advantage - jnp.mean(batch.advantage)) / spread(batch.advantage)
    logarithm = log_probability(_outputs(parameters.actor, batch.observation), parameters.log_std, batch.action)
    losses, beyond, divergence = surrogate(settings, logarithm, batch.log_probability, advantage)
    policy_loss = jnp.mean(losses)
    value_loss = jnp.mean((_outputs(parameters.critic, batch.observation)[:, 0] - batch.target) ** 2)
    total = policy_loss + settings.value_weight * value_loss - settings.entropy_weight * entropy(parameters.log_std)
    parts = {
        "loss": total,
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "clip_fraction": jnp.mean(beyond),
        "approximate_kl": jnp.mean(divergence),
    }
    return total, parts


def _optimiser(settings: PpoSettings, parameters: Parameters) -> optax.GradientTransformation:
    """What makes a step of a gradient, both as one vector."""
    return optax.chain(_clipping(settings, parameters), optax.adam(learning_rate(settings), B1, B2, EPS))


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
