"""The time from a command to a controller that meets a requirement, as a user waits for it."""

import dataclasses
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

REPETITIONS = 3  # of the command with compiled programs at hand
SETTLED, KEPT, ERROR = 99, 99, 0.01  # of 100 trials on every axis; of 100 trials; m in the median


@dataclasses.dataclass(frozen=True, kw_only=True)
class TimeToRequirement:
    """How long `flytune train baseline` takes in a process of its own, with start-up and evaluation.

    The requirement: at least 99 of 100 trials settle on every axis, their median steady-state error is at most 1 cm,
    and at least 99 stay within the speed bound.
    """

    cold: float  # s, with nothing compiled
    warm: list[float]  # s, each repetition
    met: bool
    memory: float  # MiB, the peak of one process


def time_to_requirement(task: str = "baseline") -> TimeToRequirement:
    """Seconds until a controller for a preset is trained and evaluated; this takes half a minute."""
    with tempfile.TemporaryDirectory() as folder:
        cold, _ = _trained(task, Path(folder), 0)
        repetitions = [_trained(task, Path(folder), 1 + number) for number in range(REPETITIONS)]
    return TimeToRequirement(
        cold=cold,
        warm=[seconds for seconds, _ in repetitions],
        met=all(met for _, met in repetitions),
        memory=resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10),
    )


def _trained(task: str, folder: Path, number: int) -> tuple[float, bool]:
    """The seconds of one command, and whether its controller meets the requirement."""
    out, started = folder / str(number), time.perf_counter()
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder / "programs")}
    command = [sys.executable, "-m", "flytune", "train", task, "--out", str(out)]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    seconds = time.perf_counter() - started
    found: dict[str, Any] = json.loads((out / "evaluation.json").read_text())
    settled = min(axis["settled"] for axis in found["axes"].values())
    kept = found["trials"] - found["violations"]["speed"]
    error = found["position"]["steady_state_error"]["median"]
    return seconds, settled >= SETTLED and kept >= KEPT and error is not None and error <= ERROR
