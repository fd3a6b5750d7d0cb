"""Warm starts: what a training takes over from a policy, and the command that goes on from one that has ended."""

import dataclasses
import hashlib
import json
import os
import shlex
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from flytune.config import document, nested
from flytune.control.policy import Network, Policy
from flytune.errors import BadInput
from flytune.runs.directory import has_checkpoint, read_checkpoint, read_facts, resume_command
from flytune.runs.find import find_controller, split_setting
from flytune.task.files import load_task
from flytune.task.observation import SIZE, input_scale
from flytune.task.task import Task
from flytune.training.trainer import find_trainer


@dataclasses.dataclass(frozen=True)
class Critic:
    """A critic, and the multiples of the observation that it was trained on."""

    network: Network
    input_scale: Float[Array, "17"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class WarmStart:
    """What a training starts from: the flown policy, and the critic of the run where it has one that is kept."""

    policy: Policy
    critic: Critic | None = None
    facts: dict[str, Any]  # for run.json
    field: str = "warm_start"  # how messages call it


def as_warm_start(given: str | Policy | WarmStart) -> WarmStart:
    """The warm start from a policy, or from the name of one, see `find_warm_start`."""
    if isinstance(given, str):
        return find_warm_start(given)
    if isinstance(given, WarmStart):
        return given
    return WarmStart(policy=given, facts=_facts("a policy", given, None))


def find_warm_start(who: str, task: Task | None = None, field: str = "warm_start") -> WarmStart:
    """The warm start from what a name stands for: a run directory, a policy file, or a policy that ships.

    A run of `ppo` also gives its critic. A policy with dials is taken at its setting where the name has one and `task`
    has no dial.

    Raises:
        BadInput: it is no policy with weights, or its checkpoint is damaged.
    """
    found = find_controller(who)
    policy = found.controller
    if not isinstance(policy, Policy):
        raise BadInput(
            f"{field}: {who} has no weights to start from. Allowed: a run directory, a .safetensors policy, a .zip of "
            "Stable-Baselines3, or a policy that ships, for instance baseline-refined."
        )
    if split_setting(who)[1] and not (task is not None and task.dial):
        policy = found.fixed()
    critic = _critic(Path(who)) if os.path.isdir(who) else None
    return WarmStart(policy=policy, critic=critic, facts=_facts(who, policy, critic), field=field)


def rescaled(network: Network, before: Float[Array, "17"], factors: Any) -> Network:
    """The same function of the observation as a network on other multiples of it, one factor per block; a copy."""
    first, *others = network.weights
    ratio = jnp.ones(len(first)).at[:SIZE].set(before / input_scale(factors))
    network = dataclasses.replace(network, weights=(first * ratio[:, None], *others))
    return jax.tree.map(jnp.array, network)  # copies, because an update donates the memory of its state


def check_ended(path: Path, task: Task, trainer: str, seed: int) -> None:
    """Refuse to resume a run with other settings; the line names a command that goes on from its policy.

    What else is wrong with the directory is left to `RunDirectory`.

    Raises:
        BadInput: the task is not that of the run.
    """
    if not (path / "run.json").exists() or not has_checkpoint(path):
        return
    facts, before = read_facts(path), load_task(path / "task.toml")
    changes = nested.changes(document.plain(before), document.plain(task))
    if not changes or (facts["trainer"], facts["seed"]) != (trainer, seed):
        return
    method = find_trainer(trainer)
    length = f"{method.settings_field}.{'steps' if method.settings_field == 'ppo' else 'updates'}"
    more = method.settings(task).updates - method.settings(before).updates
    if length in changes and more > 0 and method.supports_warm_start:  # those that the run had need no repetition
        changes[length] = more if length.endswith("updates") else more * method.settings(task).steps_per_update
    first = next(iter(changes))
    now = nested.look_up(document.plain(task), first)
    told = (
        f"resume: {path} was trained with another {first} ({nested.look_up(document.plain(before), first)}, not {now})"
    )
    if not facts.get("finished"):
        raise BadInput(f"{told}, and has not ended. To continue it as it is: {resume_command(path, trainer, seed)}")
    if not method.supports_warm_start:
        raise BadInput(f"{told}, and has ended. Train again into another directory.")
    told += ", and has ended. To go on"
    if None in changes.values():  # a table that is gone cannot be named on the command line
        raise BadInput(f"{told} from its policy: repeat the command with --from {path} instead of --out and --resume.")
    raise BadInput(f"{told} from its policy: {continue_command(path, trainer, seed, changes)}")


def continue_command(path: Path, trainer: str, seed: int, changes: dict[str, Any] | None = None) -> str:
    """The command that starts a new training from the policy of a run, with changes of its task."""
    words = [
        "flytune",
        "train",
        str(path / "task.toml"),
        "--trainer",
        trainer,
        "--seed",
        str(seed),
        "--from",
        str(path),
    ]
    edits = [f"{name}={json.dumps(value)}" for name, value in (changes or {}).items()]
    return shlex.join([*words, "--set", *edits] if edits else words)


def _critic(path: Path) -> Critic | None:
    """The critic in the checkpoint of a run of `ppo`; None where a run has none."""
    if read_facts(path)["trainer"] != "ppo" or not has_checkpoint(path):
        return None
    task, method = load_task(path / "task.toml"), find_trainer("ppo")
    fresh = jax.eval_shape(lambda key: method.start(task, key), jax.random.key(0))
    train_state, _ = read_checkpoint(path, fresh, "from")
    return Critic(train_state.parameters.critic, input_scale(task.ppo.input_scale))


def _facts(who: str, policy: Policy, critic: Critic | None) -> dict[str, Any]:
    weights = hashlib.sha256()
    for leaf in jax.tree.leaves(policy.actor):
        weights.update(np.asarray(leaf).tobytes())
    return {
        "who": who,
        "task": policy.about.get("task"),
        "vehicle": policy.about.get("vehicle"),
        "actor_sha256": weights.hexdigest(),
        "critic": critic is not None,
    }
