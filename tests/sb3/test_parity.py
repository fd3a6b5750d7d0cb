"""Stable-Baselines3's PPO and ours, from the same weights, samples and order: the same advantages, losses, weights."""

import pytest

pytest.importorskip("stable_baselines3", reason="needs flytune[sb3]")

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import torch
from jax.flatten_util import ravel_pytree
from stable_baselines3 import PPO
from stable_baselines3.common import buffers
from stable_baselines3.common.callbacks import BaseCallback

from flytune.control.policy import Network
from flytune.task.files import load_task
from flytune.training import ppo, sb3

KEY = jax.random.key(3)


class Watch(BaseCallback):
    """What each step of a rollout brought."""

    def __init__(self):
        super().__init__()
        self.transitions = []

    def _on_step(self):
        self.transitions.append(self.training_env.transition)
        return True


@dataclasses.dataclass
class Rollout:
    """A model of Stable-Baselines3 after a rollout of its own, and what the rollout was."""

    settings: ppo.PpoSettings
    model: PPO
    transitions: list


def collect(environments, rollout, minibatch):
    """A rollout of Stable-Baselines3, its weights moved off their symmetric start by an update of its own."""
    task = load_task(
        "baseline",
        {
            "horizon": 12,
            "ppo.environments": environments,
            "ppo.rollout": rollout,
            "ppo.minibatch": minibatch,
            "ppo.epochs": 1,
        },
    )
    own = sb3._Model(task, task.ppo, seed=2)
    model, watch = own.model, Watch()
    model.learn(environments * rollout, log_interval=2)
    _, callback = model._setup_learn(environments * rollout, watch, reset_num_timesteps=False)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, rollout)
    return Rollout(task.ppo, model, watch.transitions)


@pytest.fixture
def paper_sized():
    """128 environments x 128 steps, 128 minibatches of 128 per epoch, as the baseline has it."""
    return collect(128, 128, 128)


@pytest.fixture
def small():
    """One minibatch in all."""
    return collect(8, 32, 256)


def as_ours(tensors):
    """Weights, or anything else kept per weight, by torch's names, in our containers."""
    values = {name: jnp.array(tensor.detach().numpy()) for name, tensor in tensors.items()}

    def network(hidden, last):
        layers = [f"mlp_extractor.{hidden}.0", f"mlp_extractor.{hidden}.2", last]
        return Network(
            weights=tuple(values[f"{layer}.weight"].T for layer in layers),
            biases=tuple(values[f"{layer}.bias"] for layer in layers),
        )

    return ppo.Parameters(
        actor=network("policy_net", "action_net"), critic=network("value_net", "value_net"), log_std=values["log_std"]
    )


def flat(parameters):
    return ravel_pytree(parameters)[0]


def our_optimiser(settings, model):
    """The memory of the model's Adam in our optimiser's containers."""
    weights = dict(model.policy.named_parameters())
    memory = {name: model.policy.optimizer.state[weight] for name, weight in weights.items()}
    count = int(memory["log_std"]["step"])
    mean, square = (
        flat(as_ours({name: moments[kind] for name, moments in memory.items()})) for kind in ("exp_avg", "exp_avg_sq")
    )
    fresh = ppo._optimiser(settings, as_ours(weights)).init(flat(as_ours(weights)))

    def filled(part):
        return part._replace(count=jnp.int32(count), mu=mean, nu=square) if hasattr(part, "mu") else part

    return jax.tree.map(filled, fresh, is_leaf=lambda part: hasattr(part, "mu"))


def our_samples(model):
    """The rollout buffer as our samples, in the order Stable-Baselines3 flattens it to."""
    buffer = model.rollout_buffer
    columns = {
        "observation": buffer.observations,
        "action": buffer.actions,
        "log_probability": buffer.log_probs,
        "advantage": buffer.advantages,
        "target": buffer.returns,
    }
    flattened = {name: jnp.array(buffer.swap_and_flatten(column)) for name, column in columns.items()}
    for name in ("log_probability", "advantage", "target"):
        flattened[name] = flattened[name].reshape(-1)
    return ppo.Batch(**flattened)


def both_learn(rollout, monkeypatch):
    """Weights after one epoch of Stable-Baselines3's and of ours, and the losses of both."""
    settings, model = rollout.settings, rollout.model
    samples, before = our_samples(model), as_ours(dict(model.policy.named_parameters()))
    order = np.asarray(ppo.shuffle(jax.random.split(KEY, 1)[0], samples.action.shape[0]))
    ours, _, losses = ppo.learn(settings, before, our_optimiser(settings, model), samples, KEY)
    monkeypatch.setattr(buffers.np.random, "permutation", lambda number: order[:number])
    model.train()
    theirs = as_ours(dict(model.policy.named_parameters()))
    logged = {name: float(model.logger.name_to_value[key]) for name, key in sb3.LOSSES.items()}
    return before, theirs, ours, logged, {name: float(loss) for name, loss in losses.items()}


# Two programs that round a weight below 1 differ by up to 6e-8, the spacing of float32 there, and Adam's step of up to
# 2e-4 adds the rounding of its gradient, relative to the gradient's size: 1e-7 in all. Each minibatch adds as much.
PER_MINIBATCH = 1e-7


def assert_same_epoch(rollout, monkeypatch, minibatches, smallest_change):
    before, theirs, ours, logged, losses = both_learn(rollout, monkeypatch)
    np.testing.assert_allclose(flat(ours), flat(theirs), rtol=0, atol=minibatches * PER_MINIBATCH)
    changes = np.abs(flat(theirs) - flat(before))
    assert np.median(changes) > smallest_change > 100 * minibatches * PER_MINIBATCH  # else the above says little
    for name in ("policy_loss", "value_loss", "clip_fraction", "approximate_kl"):
        assert losses[name] == pytest.approx(logged[name], rel=1e-4, abs=1e-6), name
    return logged, losses


def test_one_minibatch_gives_the_same_losses_and_weights(small, monkeypatch):
    logged, losses = assert_same_epoch(small, monkeypatch, minibatches=1, smallest_change=5e-5)
    assert losses["loss"] == pytest.approx(logged["loss"], rel=1e-6)


def test_an_epoch_of_the_papers_size_gives_the_same_losses_and_weights(paper_sized, monkeypatch):
    logged, _ = assert_same_epoch(paper_sized, monkeypatch, minibatches=128, smallest_change=2e-3)
    assert logged["clip_fraction"] > 0.01 and logged["approximate_kl"] > 1e-3  # the clipping has been at work


def test_the_order_of_samples_matters_more_than_the_tolerance(paper_sized, monkeypatch):
    # the comparison above would see another order of samples, and so any other difference of that size
    rollout = paper_sized
    samples, start = our_samples(rollout.model), as_ours(dict(rollout.model.policy.named_parameters()))
    ours, _, _ = ppo.learn(rollout.settings, start, our_optimiser(rollout.settings, rollout.model), samples, KEY)
    other, _, _ = ppo.learn(
        rollout.settings, start, our_optimiser(rollout.settings, rollout.model), samples, jax.random.key(4)
    )
    assert np.abs(flat(ours) - flat(other)).max() > 100 * 128 * PER_MINIBATCH


def test_advantages_are_the_same_where_episodes_fail_and_where_their_time_is_up(paper_sized):
    settings, model = paper_sized.settings, paper_sized.model
    buffer = model.rollout_buffer

    def column(name):
        return np.stack([getattr(transition, name) for transition in paper_sized.transitions])

    def value(observations):
        with torch.no_grad():
            return model.policy.predict_values(torch.from_numpy(observations)).numpy()[:, 0]

    terminated, truncated = column("terminated"), column("truncated")
    assert terminated.sum() > 100 and truncated.sum() > 100
    following = np.stack([value(transition.final_observation) for transition in paper_sized.transitions])
    ours = ppo.advantages(
        *map(jnp.asarray, (column("reward"), buffer.values, following, terminated, terminated | truncated)),
        settings.discount,
        settings.gae_lambda,
    )
    # sums of some 20 terms of size 1 in another order
    np.testing.assert_allclose(ours, buffer.advantages, rtol=1e-5, atol=5e-6)
    assert np.abs(buffer.advantages).mean() > 0.1
