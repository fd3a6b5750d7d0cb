"""Observations that were scaled in training: how a file shows it, and how the scaling becomes a part of the policy.

VecNormalize of Stable-Baselines3, and wrappers like it, give a policy clip((o - mean) / sqrt(var + epsilon), -c, c)
instead of the observation o. The statistics are kept in a file of their own. A model alone would fly on raw numbers.
"""

import base64
import dataclasses
import io
import re
import zipfile
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from flytune.control.policy import Policy
from flytune.errors import BadInput
from flytune.export.untrusted.pickled import Record, read_array, read_pickle
from flytune.task.observation import SIZE

LARGEST = 16 * 2**20  # bytes of a file of statistics; VecNormalize writes some kB, and 136 bytes per environment
ATTITUDE, LAST_ACTION = slice(3, 7), slice(13, 17)  # columns whose size is known
UNIT = 1e-3  # how far the norm of an attitude may be from 1; rounding leaves 1e-7, scaling tenths
FITS = 0.1  # the same where statistics undo the scaling: they go on changing while a policy learns
WRAPPER = "VecNormalize"
Observations = Literal["raw", "scaled", "unknown"]


@dataclasses.dataclass(frozen=True)
class Statistics:
    """What is subtracted from each observation, what it is divided by, and where the result is clipped."""

    mean: np.ndarray  # [17]
    deviation: np.ndarray  # [17], sqrt(var + epsilon)
    clip: float  # infinite where nothing is clipped
    source: str  # the file

    def undo(self, scaled: np.ndarray) -> np.ndarray:
        """The observations [N, 17] that were scaled, NaN where they were clipped."""
        return np.where(np.abs(scaled) < self.clip, scaled * self.deviation + self.mean, np.nan)

    def fold(self, policy: Policy) -> Policy:
        """The policy of raw observations that acts as this one does on scaled ones.

        clip((o - m) / s, -c, c) W + b = clip(o, m - c s, m + c s) (W / s) + (b - (m / s) W)
        """
        (first, *weights), (bias, *biases) = policy.actor.weights, policy.actor.biases
        folded = np.asarray(first, float) / self.deviation[:, None]
        shifted = np.asarray(bias, float) - self.mean @ folded
        actor = dataclasses.replace(
            policy.actor,
            weights=(jnp.asarray(folded, jnp.float32), *weights),
            biases=(jnp.asarray(shifted, jnp.float32), *biases),
        )
        reach = self.clip * self.deviation
        bounds = jnp.asarray(np.stack([self.mean - reach, self.mean + reach]), jnp.float32)
        return dataclasses.replace(policy, actor=actor, bounds=bounds if np.isfinite(self.clip) else None)


def scaling_of(about: dict[str, Any]) -> tuple[Observations, np.ndarray | None]:
    """Whether the observations that a model learned from were scaled, and the last ones [N, 17], if it has them.

    A model holds its last observations. Raw ones have an attitude of norm 1, and a last action within [-1, 1]. It
    holds the original ones as well if VecNormalize was there, even if that scaled the rewards alone.

    Raises:
        BadInput: what the model holds there are no observations.
    """
    last, original = (_observations(about, name) for name in ("_last_obs", "_last_original_obs"))
    if last is None:
        return ("unknown" if original is None else "scaled"), None
    norms, actions = np.linalg.norm(last[:, ATTITUDE], axis=1), np.abs(last[:, LAST_ACTION])
    raw = np.all(np.abs(norms - 1) < UNIT) and np.all(actions <= 1 + UNIT)
    return ("raw" if raw else "scaled"), last


def why_scaled(about: dict[str, Any], last: np.ndarray | None) -> str:
    """What in a model shows that its observations were scaled."""
    if last is None:
        return f"{WRAPPER} was around its environment, and the file does not say what it did to the observations."
    norm = np.linalg.norm(last[:, ATTITUDE], axis=1)
    farthest = norm[np.argmax(np.abs(norm - 1))]
    seen = f"in its last observations, the attitude (columns 3 to 6) has the norm {farthest:.3g}, allowed: 1"
    if abs(farthest - 1) < UNIT:
        seen = (
            f"in its last observations, the last action is up to {np.abs(last[:, LAST_ACTION]).max():.3g}, allowed: 1"
        )
    if about.get("_last_original_obs") is not None:
        return f"{WRAPPER} scaled its observations: {seen}."
    return f"it did not learn from flytune's 17 numbers as they are: {seen}. A wrapper scaled them, or they are others."


def refuse_misfit(statistics: Statistics, last: np.ndarray | None) -> None:
    """Refuse statistics that do not give attitudes of norm 1 back.

    Raises:
        BadInput: they belong to another model, or to another time of its training.
    """
    if last is None:
        return
    norms = np.linalg.norm(statistics.undo(last)[:, ATTITUDE], axis=1)
    norms = norms[np.isfinite(norms)]
    if norms.size and abs(np.median(norms) - 1) > FITS:
        raise BadInput(
            f"{statistics.source} does not belong to it: without that scaling, the attitude in its last observations "
            f"has the norm {np.median(norms):.3g}, allowed: 1. Give the statistics that were saved with the model."
        )


def find_statistics(model: Path) -> Path | None:
    """The file of statistics that stands beside a model under one of the usual names, or in the only folder there."""
    stem, steps = model.stem, re.fullmatch(r"(.*)_(\d+_steps)", model.stem)
    names = [f"{stem}_vecnormalize", f"{stem}.vecnormalize"]
    if steps:  # of the callback that saves checkpoints
        names.append(f"{steps[1]}_vecnormalize_{steps[2]}")
    names += ["vecnormalize", "vec_normalize"]
    places = [model.with_name(f"{name}{end}") for name in names for end in (".pkl", ".npz")]
    below = in_folders(model)
    return next((place for place in places + below[:1] * (len(below) == 1) if place.is_file()), None)


def in_folders(model: Path) -> list[Path]:
    """The files of statistics in the folders beside a model; RL Zoo keeps them in one named as the environment."""
    return sorted(model.parent.glob("*/vecnormalize.pkl"))


def where_looked(model: Path) -> str:
    """Where `find_statistics` has looked without success, as a sentence."""
    below = [str(each.relative_to(model.parent)) for each in in_folders(model)]
    if len(below) > 1:
        return f"Several may belong to it: {', '.join(below[:3])}{', ...' * (len(below) > 3)}."
    return "There is no vecnormalize.pkl beside the model, nor in a folder there."


def read_statistics(path: Path) -> Statistics | None:
    """The statistics of a file, None where it scales no observations (rewards alone).

    A .pkl is what `VecNormalize.save` wrote; it is read without running any of it. A .npz holds the arrays `mean` and
    `var` [17], and may hold `epsilon` (1e-8 where it is left out) and `clip` (infinite where it is left out).

    Raises:
        BadInput: it is missing, damaged, too large, or of other observations.
    """
    try:
        with open(path, "rb") as file:
            content = file.read(LARGEST + 1)
        if len(content) > LARGEST:
            raise BadInput(f"is larger than {LARGEST // 2**20} MiB.")
        found = _from_arrays(content) if path.suffix == ".npz" else _from_wrapper(read_pickle(content))
        return None if found is None else _checked(found, str(path))
    except BadInput as error:
        raise BadInput(
            f"{path}: {error} Allowed: what VecNormalize.save wrote, or an .npz with mean and var."
        ) from None
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror}). Allowed: a file of statistics.") from None
    # for a damaged file, pickle, zipfile and NumPy raise exceptions of many classes
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise BadInput(
            f"{path}: is damaged ({reason}). Allowed: what VecNormalize.save wrote, or an .npz with mean and var."
        ) from None


def _observations(about: dict[str, Any], name: str) -> np.ndarray | None:
    kept = about.get(name)
    if kept is None:
        return None
    try:
        found = read_array(read_pickle(base64.b64decode(kept[":serialized:"], validate=True)))
        return found.reshape(-1, SIZE)
    except BadInput as error:
        raise BadInput(f"its {name} cannot be read: it {error}") from None
    except Exception as error:
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise BadInput(f"its {name} cannot be read ({reason}).") from None


def _from_wrapper(found: Any) -> dict[str, np.ndarray] | None:
    state = found.state if isinstance(found, Record) else None
    if not isinstance(state, dict) or not {"norm_obs", "epsilon", "clip_obs"} <= set(state):
        raise BadInput(f"holds {getattr(found, 'path', type(found).__name__)}, and no statistics of observations.")
    if not state["norm_obs"]:
        return None
    statistics = state["obs_rms"].state
    if not isinstance(statistics, dict):
        raise BadInput("holds statistics of several blocks of observations.")
    given = {"mean": statistics["mean"], "var": statistics["var"]}
    given |= {"epsilon": state["epsilon"], "clip": state["clip_obs"]}
    return {name: read_array(value) for name, value in given.items()}


def _from_arrays(content: bytes) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > LARGEST:
            raise BadInput(f"unpacks to more than {LARGEST // 2**20} MiB.")
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        unknown = set(arrays.files) - {"mean", "var", "epsilon", "clip", "count"}
        if unknown or not {"mean", "var"} <= set(arrays.files):
            raise BadInput(f"holds the arrays {sorted(arrays.files)!s:.80}.")
        return {name: np.asarray(arrays[name], float) for name in arrays.files if name != "count"}


def _checked(found: dict[str, np.ndarray], source: str) -> Statistics:
    mean, var = found["mean"].reshape(-1), found["var"].reshape(-1)
    epsilon, clip = float(found.get("epsilon", 1e-8)), float(found.get("clip", np.inf))
    if mean.shape != (SIZE,) or var.shape != (SIZE,):
        raise BadInput(f"holds statistics of {mean.size} and {var.size} numbers, allowed: {SIZE}.")
    with np.errstate(invalid="ignore"):
        deviation = np.sqrt(var + epsilon)
    if not (np.all(np.isfinite(mean)) and np.all(np.isfinite(deviation)) and np.all(deviation > 0) and clip > 0):
        raise BadInput("holds statistics that are not finite, or variances and a clip that are not above 0.")
    return Statistics(mean=mean, deviation=deviation, clip=clip, source=source)
