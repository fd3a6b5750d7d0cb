"""Run directories: the results of a training, and all that a resumed training needs (docs/concepts/definitions.md)."""

import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors
import safetensors.numpy

from flytune.config import document, nested
from flytune.config.files import RUN_FILES, make_folder, write_bytes, write_json, write_text
from flytune.config.recognise import runs_in
from flytune.control.policy import Policy, save_policy
from flytune.errors import BadInput
from flytune.task.files import load_task, write_task
from flytune.task.task import Task

CHECKPOINT = Path("checkpoint") / "train_state.safetensors"  # in a run directory


class RunDirectory:
    """The files of one training; each file is whole or absent.

    Args:
        path: the directory.
        task: what is trained.
        trainer: its name.
        seed: of the training.
        resume: continue the training in the directory, instead of making a new one.
        packages: optional packages whose versions run.json records.
        start: what the training starts from, for run.json; None for new weights.

    Raises:
        BadInput: the directory holds something else, or cannot be written; nothing was changed.
    """

    def __init__(
        self,
        path: Path,
        task: Task,
        trainer: str,
        seed: int,
        resume: bool,
        packages: Sequence[str] = (),
        start: dict[str, Any] | None = None,
    ) -> None:
        self.path = path
        if path.exists() and not path.is_dir():
            raise BadInput(f"out: {path} is a file. Give a directory that does not exist yet.")
        holds_run = (path / "run.json").exists()
        if resume:
            self._check_same(task, trainer, seed, holds_run)
            return
        if holds_run:
            raise BadInput(f"out: {path} already holds a run. Give another directory, or --resume to continue it.")
        if taken := [name for name in (*RUN_FILES, "checkpoint") if os.path.lexists(path / name)]:
            raise BadInput(
                f"out: {path} is no run and holds {taken[0]}, which is not replaced. Give another directory."
            )
        make_folder(path)
        write_text(path / "task.toml", write_task(task))
        write_json(path / "run.json", _facts(task, trainer, seed, packages) | {"from": start})

    def _check_same(self, task: Task, trainer: str, seed: int, holds_run: bool) -> None:
        if not holds_run:
            raise BadInput(f"resume: {self.path} holds no run. Leave out --resume to start one.")
        facts = read_facts(self.path)
        if (facts.get("trainer"), facts.get("seed")) != (trainer, seed):
            raise BadInput(
                f"resume: {self.path} was trained with {facts.get('trainer')}, seed {facts.get('seed')}, "
                f"not {trainer}, seed {seed}. Give the same, or another directory."
            )
        before, now = document.plain(load_task(self.path / "task.toml")), document.plain(task)
        if path := nested.first_difference(before, now):
            raise BadInput(
                f"resume: {self.path} was trained with another {path}. Give {self.path}/task.toml as the task."
            )
        if (self.path / "checkpoint" / "learner.safetensors").exists() and not has_checkpoint(self.path):
            raise BadInput(
                f"resume: {self.path} holds the checkpoint of an older version of flytune (learner.safetensors), which "
                "this version cannot continue. Train again into another directory."
            )
        if not has_checkpoint(self.path):
            raise BadInput(f"resume: {self.path} holds no checkpoint. Train again into another directory.")

    def checkpoint(self, train_state: Any, rows: list[dict[str, Any]]) -> None:
        """Write everything that is needed to continue exactly, and the metrics so far."""
        make_folder(self.path / CHECKPOINT.parent)
        leaves = {f"{index:03d}": np.asarray(_raw(leaf)) for index, leaf in enumerate(jax.tree.leaves(train_state))}
        write_bytes(self.path / CHECKPOINT, safetensors.numpy.save(leaves, {"rows": json.dumps(rows)}))
        write_text(self.path / "metrics.jsonl", "".join(json.dumps(row) + "\n" for row in rows))

    def resume(self, fresh: Any) -> tuple[Any, list[dict[str, Any]]]:
        """The training state and the metrics of the checkpoint, see `read_checkpoint`."""
        return read_checkpoint(self.path, fresh)

    def finish(self, policy: Policy, last_policy: Policy, last: dict[str, Any]) -> None:
        """Write the policies, and run.json as of a complete training; `last` is the last row of the metrics."""
        save_policy(self.path / "policy.safetensors", policy)
        save_policy(self.path / "policy-last.safetensors", last_policy)
        finished = {"finished": True, "steps": last["steps"], "seconds": last["seconds"]}
        write_json(self.path / "run.json", read_facts(self.path) | finished)


def read_checkpoint(directory: Path, fresh: Any, field: str = "resume") -> tuple[Any, list[dict[str, Any]]]:
    """The training state and the metrics of a run's checkpoint; `fresh` is a state of this structure, or its shapes.

    Raises:
        BadInput: the checkpoint is damaged, or of another version of flytune.
    """
    path = directory / CHECKPOINT
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            stored = [file.get_tensor(name) for name in sorted(file.keys())]
            rows = json.loads((file.metadata() or {})["rows"])
    except (safetensors.SafetensorError, OSError, KeyError, ValueError) as error:
        raise BadInput(f"{field}: {path} is damaged ({error}). Train again into another directory.") from None
    leaves, structure = jax.tree.flatten(fresh)
    shapes = [jax.eval_shape(_raw, leaf).shape for leaf in leaves]
    if shapes != [value.shape for value in stored]:
        raise BadInput(f"{field}: {path} is of another version of flytune. Train again into another directory.")
    restored = [
        jax.random.wrap_key_data(value) if _is_key(leaf) else jax.numpy.asarray(value)
        for leaf, value in zip(leaves, stored, strict=True)
    ]
    return jax.tree.unflatten(structure, restored), rows


def has_checkpoint(directory: Path) -> bool:
    """Whether a directory holds the checkpoint of a training."""
    return (directory / CHECKPOINT).exists()


def resume_command(path: Path, trainer: str, seed: int) -> str:
    """The command that continues an interrupted training."""
    words = ["--trainer", trainer, "--seed", str(seed), "--out", str(path), "--resume"]
    return shlex.join(["flytune", "train", str(path / "task.toml"), *words])


def read_facts(directory: Path) -> dict[str, Any]:
    """The content of a run's run.json.

    Raises:
        BadInput: it is missing or damaged.
    """
    path = directory / "run.json"
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
    except OSError:
        raise BadInput(
            f"{directory}: is not a run directory (no run.json). Give one that `flytune train` wrote."
            f"{runs_in(directory)}"
        ) from None
    except ValueError:
        raise BadInput(f"{path}: is damaged. Train again into another directory.") from None
    if not isinstance(facts, dict) or not {"trainer", "seed", "versions", "machine", "command", "time"} <= set(facts):
        raise BadInput(f"{path}: is damaged. Train again into another directory.")
    return facts


def _facts(task: Task, trainer: str, seed: int, optional: Sequence[str]) -> dict[str, Any]:
    packages = ["flytune", "jax", "jaxlib", "numpy", "optax", *optional]
    return {
        "task": task.name,
        "trainer": trainer,
        "seed": seed,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "versions": {name: metadata.version(name) for name in packages} | {"python": platform.python_version()},
        "machine": {"system": platform.system(), "processor": platform.machine(), "cores": os.cpu_count()},
        "device": jax.devices()[0].platform,
        "commit": _commit(),
        "finished": False,
    }


def _commit() -> str | None:
    """The commit of the checkout that flytune runs from, or None where it runs from none."""
    here = Path(__file__).resolve()
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}

    def git(*arguments: str) -> str | None:
        command = ["git", "-C", str(here.parent), *arguments]
        try:
            answer = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False, env=environment)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return answer.stdout.strip() if answer.returncode == 0 else None

    # a package installed inside somebody else's repository is not part of it
    return git("rev-parse", "HEAD") if git("ls-files", "--error-unmatch", here.name) else None


def _is_key(leaf: Any) -> bool:
    return jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _raw(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf
