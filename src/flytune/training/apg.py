"""Analytic policy gradient: gradient ascent on the reward, back-propagated through the differentiable simulator.

One update flies `environments` episodes for `window` steps and differentiates their mean reward with respect to the
actor's weights. There is no discount and no critic. Episodes continue from one update to the next. The end of an
episode has no gradient; so each termination condition also adds a smooth barrier on its margin.
"""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
import optax.contrib
from jax.flatten_util import ravel_pytree
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from flytune.config.pytree import pytree
from flytune.control.policy import Network, Policy, make_network
from flytune.kernels.dense import perceptron
from flytune.kernels.programs import program
from flytune.simulation.environment import Episode, Outcome
from flytune.simulation.rollout import Draw, reset_all, rollout
from flytune.task.observation import SIZE, input_scale
from flytune.task.task import Task
from flytune.task.training_settings import ApgSettings
from flytune.training.update import averaged, descend, metrics_of, rollout_sums

PARTS = 2  # of a batch, which are computed apart


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
    return Policy(actor=_here(train_state.ema), input_scale=input_scale(settings.input_scale), squash="tanh")


def last_policy(settings: ApgSettings, train_state: TrainState) -> Policy:
    """The policy of the last update."""
    return Policy(actor=_here(train_state.actor), input_scale=input_scale(settings.input_scale), squash="tanh")


def _here(network: Network) -> Network:
    """A network on JAX's default device, wherever it was."""
    return jax.tree.map(jnp.asarray, jax.device_get(network))


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
    actor = make_network(actor_key, (SIZE, *settings.hidden, 4), last_gain=0.01)
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
    """The cost of a margin: barrier_weight * max(0, barrier_margin - margin)^2."""
    return settings.barrier_weight * jnp.maximum(settings.barrier_margin - margin, 0.0) ** 2


def warm_start(settings: ApgSettings, train_state: TrainState, policy: Policy) -> TrainState:
    """The training state before the first update, with an actor that flies as `policy` does.

    The policy may have been trained on other multiples of the observation; the first layer makes up for that.
    """
    first, *others = policy.actor.weights
    ratio = policy.input_scale / input_scale(settings.input_scale)
    actor = dataclasses.replace(policy.actor, weights=(first * ratio[:, None], *others))
    actor = jax.tree.map(jnp.array, actor)  # copies, because an update donates the memory of its state
    return dataclasses.replace(train_state, actor=actor, ema=jax.tree.map(jnp.array, actor))


def update(task: Task, settings: ApgSettings, train_state: TrainState) -> tuple[TrainState, dict[str, Any]]:
    """The training state after one update, and its metrics.

    The batch is computed in two halves, one after the other or, where JAX has two devices, at the same time; the
    numbers are the same bit by bit.
    """
    number = PARTS if settings.environments % PARTS == 0 else 1
    devices = tuple(jax.devices()[:number]) if jax.device_count() >= number > 1 else ()
    if devices:
        train_state = jax.device_put(train_state, _shardings(devices, train_state))
    return _update(task, settings, number, devices, train_state)


def _shardings(devices: tuple[Any, ...], train_state: TrainState) -> TrainState:
    """Where each array of a training state is: a part of the episodes on each device, the rest on all."""
    mesh = jax.make_mesh((len(devices),), ("part",), devices=devices)
    everywhere, parts = NamedSharding(mesh, PartitionSpec()), _along_last(train_state.episodes)
    shardings = jax.tree.map(lambda _: everywhere, train_state)
    return dataclasses.replace(shardings, episodes=jax.tree.map(partial(NamedSharding, mesh), parts))


def _along_last(tree: Any) -> Any:
    """How arrays are divided whose last axis is the batch."""
    return jax.tree.map(lambda leaf: PartitionSpec(*[None] * (leaf.ndim - 1), "part"), tree)


@program(static=["settings", "number", "devices"], donate=["train_state"])
def _update(
    task: Task, settings: ApgSettings, number: int, devices: tuple[Any, ...], train_state: TrainState
) -> tuple[TrainState, dict[str, Any]]:
    key, flight_key = jax.random.split(train_state.key)
    noise_key, reset_key = jax.random.split(flight_key)
    shape = (settings.window, settings.environments)
    draws = Draw(noise=jax.random.split(noise_key, shape), keys=jax.random.split(reset_key, shape))
    gradient, episodes, sums = _in_parts(
        task, settings, number, devices, train_state.actor, train_state.episodes, draws
    )
    actor, optimiser = descend(_optimiser(settings), gradient, train_state.optimiser, train_state.actor)
    after = TrainState(
        actor=actor,
        ema=averaged(train_state.ema, actor, settings.ema_decay, train_state.updates),
        optimiser=optimiser,
        episodes=episodes,
        key=key,
        updates=train_state.updates + 1,
    )
    measured = metrics_of(sums)
    return after, {
        **measured,
        "objective": sums["objective"] / sums["steps"],
        "gradient_norm": optax.tree.norm(gradient),
    }


def _in_parts(
    task: Task,
    settings: ApgSettings,
    number: int,
    devices: tuple[Any, ...],
    actor: Network,
    episodes: Episode,
    draws: Draw,
) -> tuple[Network, Episode, dict[str, Any]]:
    """The gradient, the episodes after the window and the sums of `rollout_sums`, from parts of the batch."""

    def part(actor: Network, episodes: Episode, draws: Draw) -> Any:
        (_, (after, sums)), gradient = jax.value_and_grad(_loss, argnums=2, has_aux=True)(
            task, settings, actor, episodes, draws
        )
        return (jax.tree.map(lambda leaf: leaf / number, gradient), sums), after

    if devices:
        mesh = jax.make_mesh((number,), ("part",), devices=devices)
        divided = _along_last(episodes)
        (gradient, sums), after = jax.shard_map(
            lambda *given: (jax.lax.psum(part(*given)[0], "part"), part(*given)[1]),
            mesh=mesh,
            in_specs=(PartitionSpec(), divided, _along_last(draws)),
            out_specs=(PartitionSpec(), divided),
            check_vma=False,
        )(actor, episodes, draws)
        return gradient, after, sums
    width = settings.environments // number
    results = [
        part(actor, *jax.tree.map(lambda leaf, low=low: leaf[..., low : low + width], (episodes, draws)))
        for low in range(0, settings.environments, width)
    ]
    totals, afters = zip(*results, strict=True)
    gradient, sums = jax.tree.map(lambda *leaves: sum(leaves[1:], start=leaves[0]), *totals)
    return gradient, jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=-1), *afters), sums


def _loss(task: Task, settings: ApgSettings, actor: Network, episodes: Episode, draws: Draw) -> Any:
    """Mean cost per step of a batch, the episodes it ends with, and the sums for its metrics."""
    task = dataclasses.replace(task, initial_state=settings.initial_state)
    first, *others = actor.weights
    scaled = dataclasses.replace(actor, weights=(first * input_scale(settings.input_scale)[:, None], *others))
    parameters, sizes = ravel_pytree(scaled)[0], actor.sizes

    def decide(memory: Any, observation: Array, draw: Any, episodes: Episode) -> Any:
        return memory, perceptron(parameters, sizes, observation.T, squash=True).T, ()

    def record(after: Episode, moved: Episode, outcome: Outcome) -> Any:
        cost = sum((barrier(margin, settings) for margin in outcome.margins.values()), start=jnp.zeros(()))
        return outcome.reward - cost, outcome, moved

    (episodes, _), step = rollout(task, decide, (episodes, ()), draws, record=record, slack=settings.termination_slack)
    worth, outcome, moved = step.record
    sums = rollout_sums(task, outcome, moved.reward, moved.steps)
    return -jnp.mean(worth), (episodes, {**sums, "objective": jnp.sum(worth)})
