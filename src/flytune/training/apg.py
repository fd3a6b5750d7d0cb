"""Analytic policy gradient: gradient ascent on the reward, back-propagated through the differentiable simulator.

One update flies `environments` episodes for `window` steps and differentiates their mean reward with respect to the
actor's weights. There is no discount and no critic. Episodes continue from one update to the next. The end of an
episode has no gradient; so each termination condition also adds a smooth barrier on its margin.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optax.contrib
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from flytune.config.pytree import pytree
from flytune.control.policy import Network, Policy, make_network, with_output
from flytune.kernels.dense import Actor
from flytune.kernels.programs import program
from flytune.physics.rotors import hover_action
from flytune.simulation.environment import Episode, Outcome
from flytune.simulation.rollout import Draw, reset_all, rollout, split_keys
from flytune.task.observation import RATE, input_scale
from flytune.task.task import Task
from flytune.task.training_settings import ApgSettings
from flytune.training.threads import PARTS, in_threads
from flytune.training.update import (
    averaged,
    descend,
    metrics_of,
    network_scale,
    rollout_sums,
    turned,
)
from flytune.training.warm_start import Critic, rescaled


@pytree
class TrainState:
    """Everything an update needs and changes."""

    actor: Network
    ema: Network  # exponential moving average of the actor over updates; the one that is flown
    optimiser: Any
    episodes: Episode  # a batch of them
    key: Array
    updates: Array


def policy(settings: ApgSettings, train_state: TrainState) -> Policy:
    """The policy that is flown: the averaged actor."""
    return Policy(actor=train_state.ema, input_scale=input_scale(settings.input_scale), squash="tanh")


def last_policy(settings: ApgSettings, train_state: TrainState) -> Policy:
    """The policy of the last update."""
    return Policy(actor=train_state.actor, input_scale=input_scale(settings.input_scale), squash="tanh")


def _optimiser(settings: ApgSettings) -> optax.GradientTransformation:
    """Muon for the weights, whose steps are orthogonal matrices, and Adam for the biases.

    Source: Jordan 2024, modded-nanogpt; Liu et al. 2025, Muon is Scalable for LLM Training.
    """
    rate = optax.cosine_decay_schedule(settings.learning_rate, settings.updates, settings.final_learning_rate)
    method = optax.adam(rate, b1=settings.adam_b1, b2=settings.adam_b2)
    if settings.muon_factor > 0:
        method = optax.contrib.muon(
            lambda update: settings.muon_factor * rate(update),
            beta=settings.adam_b1,
            adam_b1=settings.adam_b1,
            adam_b2=settings.adam_b2,
            adam_learning_rate=rate,
        )
    return optax.chain(optax.clip_by_global_norm(settings.max_grad_norm), method)


@program(static=["settings"])
def start(task: Task, settings: ApgSettings, key: Array) -> TrainState:
    """The training state before the first update."""
    task = dataclasses.replace(task, initial_state=settings.initial_state)
    actor_key, episode_key, key = jax.random.split(key, 3)
    actor = make_network(actor_key, (task.inputs, *settings.hidden, 4), last_gain=0.01)
    if task.vehicle.action_scale is None:  # then the action 0 does not hover
        actor = with_output(actor, jnp.arctanh(hover_action(task.vehicle)))
    keys = jax.random.split(episode_key, settings.environments)
    episodes = reset_all(task, keys)
    return TrainState(
        actor=actor,
        ema=actor,
        optimiser=_optimiser(settings).init(actor),  # pyright: ignore[reportArgumentType]
        episodes=episodes,
        key=key,
        updates=jnp.zeros((), jnp.int32),
    )


def barrier(margin: Float[Array, ""], settings: ApgSettings) -> Float[Array, ""]:
    """The cost of a margin: barrier_weight * depth^2 with depth = max(0, barrier_margin - margin).

    Beyond a depth of `barrier_knee` it goes on as a straight line, so that an episode far beyond its bound does not
    outweigh all others.
    """
    depth, knee = jnp.maximum(settings.barrier_margin - margin, 0.0), settings.barrier_knee
    if knee == 0:
        return settings.barrier_weight * depth**2
    near = jnp.minimum(depth, knee)
    return settings.barrier_weight * (near**2 + 2 * knee * (depth - near))


def warm_start(
    settings: ApgSettings, train_state: TrainState, policy: Policy, critic: Critic | None = None
) -> TrainState:
    """The training state before the first update, with an actor that flies as `policy` does; there is no critic.

    The policy may have been trained on other multiples of the observation; the first layer makes up for that.
    """
    actor, ema = (rescaled(policy.actor, policy.input_scale, settings.input_scale) for _ in range(2))
    return dataclasses.replace(train_state, actor=actor, ema=ema)


def update(task: Task, settings: ApgSettings, train_state: TrainState) -> tuple[TrainState, dict[str, Any]]:
    """The training state after one update, and its metrics.

    The batch is computed in two parts. On two cores they are computed at the same time; the numbers are the same bit
    by bit.
    """
    number = PARTS if settings.environments % PARTS == 0 else 1

    def part(index: int) -> Any:
        return _part(task, settings, number, train_state.actor, train_state.episodes, train_state.key, np.int32(index))

    return _descend(settings, train_state, in_threads(part, number, train_state.updates))


@program(static=["settings", "number"])
def _part(
    task: Task, settings: ApgSettings, number: int, actor: Network, episodes: Episode, key: Array, index: Array
) -> tuple[Network, Episode, dict[str, Any]]:
    """The gradient of a part of the batch, its episodes after the window, and its sums for the metrics."""
    width = settings.environments // number
    mine = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, index * width, width, axis=-1), episodes)
    mine = turned(task, mine, jax.random.fold_in(jax.random.fold_in(key, index), 2))
    noise, keys = (
        split_keys(each, settings.window, width) for each in jax.random.split(jax.random.fold_in(key, index))
    )
    (_, (after, sums)), gradient = jax.value_and_grad(_loss, argnums=2, has_aux=True)(
        task, settings, actor, mine, Draw(noise=noise, keys=keys)
    )
    return gradient, after, sums


@program(static=["settings"], donate=["train_state"])
def _descend(settings: ApgSettings, train_state: TrainState, parts: tuple[Any, ...]) -> Any:
    """The training state after a step against the mean gradient of all parts, and the metrics."""
    gradients, episodes, sums = zip(*parts, strict=True)
    gradient = jax.tree.map(lambda *leaves: sum(leaves[1:], start=leaves[0]) / len(leaves), *gradients)
    total = jax.tree.map(lambda *leaves: sum(leaves[1:], start=leaves[0]), *sums)
    actor, optimiser = descend(_optimiser(settings), gradient, train_state.optimiser, train_state.actor)
    after = TrainState(
        actor=actor,
        ema=averaged(train_state.ema, actor, settings.ema_decay, train_state.updates),
        optimiser=optimiser,
        episodes=jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=-1), *episodes),
        key=jax.random.fold_in(train_state.key, len(parts)),
        updates=train_state.updates + 1,
    )
    objective = total["objective"] / total["steps"]
    return after, {**metrics_of(total), "objective": objective, "gradient_norm": optax.tree.norm(gradient)}


def _loss(task: Task, settings: ApgSettings, actor: Network, episodes: Episode, draws: Draw) -> Any:
    """Mean cost per step of a batch, the episodes it ends with, and the sums for its metrics."""
    task = dataclasses.replace(task, initial_state=settings.initial_state)
    first, *others = actor.weights
    factor = network_scale(task, settings.input_scale)
    scaled = dataclasses.replace(actor, weights=(first * factor[:, None], *others))
    parameters, sizes = ravel_pytree(scaled)[0], actor.sizes

    decide = Actor(parameters=parameters, sizes=sizes, squash=True)

    def record(task: Task, after: Episode, moved: Episode, outcome: Outcome) -> Any:
        costs = (task.termination[name].barrier * barrier(each, settings) for name, each in outcome.margins.items())
        cost = sum(costs, start=jnp.zeros(()))
        if task.vehicle.control_rate != RATE:  # like the reward
            cost = cost * (RATE / task.vehicle.control_rate)
        return outcome.reward - cost, *jax.lax.stop_gradient((outcome, moved))

    (episodes, _), step = rollout(task, decide, (episodes, ()), draws, record=record, slack=settings.termination_slack)
    worth, outcome, moved = step.record
    sums = rollout_sums(task, outcome, moved.reward, moved.steps)
    return -jnp.mean(worth), (episodes, {**sums, "objective": jnp.sum(worth)})
