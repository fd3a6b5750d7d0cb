"""A policy trained with Stable-Baselines3, read from the .zip of its `model.save` without unpickling any object."""

import collections
import dataclasses
import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from flytune.control.policy import Network, Policy
from flytune.errors import BadInput
from flytune.export.untrusted.normalisation import (
    Statistics,
    find_statistics,
    read_statistics,
    refuse_misfit,
    scaling_of,
    where_looked,
    why_scaled,
)
from flytune.export.untrusted.pickled import Reader
from flytune.task.observation import SIZE

LARGEST = 16 * 2**20  # bytes that are read of one member; actor and critic of the paper take 50 kB
LARGEST_INDEX = 2**16  # bytes of the list of tensors; 2 kB for the networks of the paper
ENTRIES = 1000  # files in an archive; SB3 writes 6, and one per tensor inside policy.pth
HARMLESS = {"net_arch", "activation_fn", "ortho_init", "log_std_init", "optimizer_class", "optimizer_kwargs"}
ENDS = ("low", "high")
REMEDY = "Give a PPO model with an MlpPolicy, tanh, and flytune's 17 observations and 4 actions, from model.save."


def load_sb3(path: Path, statistics: Path | Literal["none"] | None = None) -> Policy:
    """The policy of a Stable-Baselines3 PPO (or A2C) model: the mean of its Gaussian, clipped into [-1, 1].

    Only numbers are read: no object of the file is unpickled, and no option allows it. The member `data` is read as
    JSON, and pickles in it by a reader that makes inert records of all that they name, see `pickled`. `torch.load` is
    not used, since crafted files could run code through it even with `weights_only=True` (CVE-2025-32434 before torch
    2.6, CVE-2026-24747 before 2.10). Neither torch nor Stable-Baselines3 is needed.

    A model that learned from scaled observations (VecNormalize) needs the statistics of that scaling; they become a
    part of the policy. They are looked for beside the model, `vecnormalize.pkl` for instance.

    Args:
        path: the .zip of `model.save`.
        statistics: the file of statistics, a .pkl of `VecNormalize.save` or an .npz, see `read_statistics`; "none"
            where there are none, though a file of them stands beside the model.

    Raises:
        BadInput: the file is missing, damaged, too large or not such a model, has another architecture or size,
            contains numbers that are not finite, or learned from scaled observations whose statistics are missing.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            _check_size(archive, math.inf)
            about = json.loads(_member(archive, "data"))
            version = _member(archive, "_stable_baselines3_version").decode("ascii").strip()
            if problem := _unknown_kind(about):
                raise BadInput(problem)
            tensors = _tensors(_member(archive, "policy.pth"))
    except FileNotFoundError:
        raise BadInput(f"{path}: no such file. {REMEDY}") from None
    except BadInput as error:
        raise BadInput(f"{path}: {error} {REMEDY}") from None
    # for a damaged archive, zipfile, json and pickle raise exceptions of many classes
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise BadInput(f"{path}: is not a Stable-Baselines3 model ({reason}). {REMEDY}") from None
    if problem := _unknown_shape(tensors) or _not_finite(tensors):
        raise BadInput(f"{path}: {problem} {REMEDY}")
    policy = Policy(
        actor=actor_network(tensors),
        input_scale=jnp.ones(SIZE),
        squash="clip",
        about={"trainer": f"Stable-Baselines3 {version[:40]}"},
    )
    found = _statistics(path, about, statistics)
    if found is None and about.get("_last_obs") is None and about.get("num_timesteps"):
        said = "taken as they are: the file does not say whether they were scaled"
        return dataclasses.replace(policy, about=policy.about | {"observations": said})
    if found is None:
        return policy
    policy = dataclasses.replace(policy, about=policy.about | {"observations": f"scaled by {Path(found.source).name}"})
    return found.fold(policy)


def _statistics(path: Path, about: dict[str, Any], given: Path | Literal["none"] | None) -> Statistics | None:
    """The statistics that the policy needs, None where it learned from raw observations.

    Raises:
        BadInput: they are missing, damaged, or not those of this model.
    """
    try:
        scaling, last = scaling_of(about)
    except BadInput as error:
        raise BadInput(f"{path}: {error} {REMEDY}") from None
    named = f"{path}@vecnormalize="
    beside = find_statistics(path)
    if given is None and scaling == "unknown" and beside:
        raise BadInput(
            f"{path}: does not say whether its observations were scaled, and {beside} may belong to it. "
            f"Give {named}{beside} to use that, or {named}none."
        )
    if given == "none" or (given is None and scaling != "scaled"):
        if scaling == "scaled" and last is not None:
            raise BadInput(f"{path}: {why_scaled(about, last)} It cannot fly without the statistics of the scaling.")
        return None
    source = given or beside
    if source is None:
        raise BadInput(
            f"{path}: {why_scaled(about, last)} {where_looked(path)} Give the statistics that VecNormalize.save wrote: "
            f"as vecnormalize.pkl beside the model, or as {named}FILE."
        )
    found = read_statistics(Path(source))
    if found is None and scaling == "scaled" and last is not None:
        raise BadInput(f"{path}: {why_scaled(about, last)} {source} does not belong to it: it scales rewards alone.")
    if found is not None and scaling == "raw":
        raise BadInput(
            f"{path}: learned from observations as they are (in its last ones, the attitude has norm 1), so the "
            f"statistics {source} do not belong to it. Leave them out."
        )
    if found is not None:
        try:
            refuse_misfit(found, last)
        except BadInput as error:
            raise BadInput(f"{path}: {error}") from None
    return found


def _check_size(archive: zipfile.ZipFile, largest: float) -> None:
    entries = archive.infolist()
    size = sum(entry.file_size for entry in entries)
    if len(entries) > ENTRIES or size > largest:
        raise BadInput(f"holds {len(entries)} entries of {size} bytes, allowed: up to {ENTRIES} of {LARGEST}.")


def _member(archive: zipfile.ZipFile, name: str, largest: int = LARGEST) -> bytes:
    """The bytes of one member, found by its exact name and never written to a file."""
    try:
        information = archive.getinfo(name)
    except KeyError:
        raise BadInput(f"is not a Stable-Baselines3 model (no {name!r} in it).") from None
    if information.file_size > largest:
        raise BadInput(f"{name} unpacks to {information.file_size} bytes, allowed: up to {largest}.")
    with archive.open(information) as file:
        return file.read(largest)


def _tensors(content: bytes) -> dict[str, np.ndarray]:
    """The float32 tensors of a file that torch.save wrote, read without torch.

    The file is a zip with one folder: `data.pkl`, a pickled dictionary of tensors that name their storages, `data/KEY`,
    the numbers of each storage, and `byteorder`.

    Source: PyTorch, notes on serialization, "Serialized file format for torch.save".
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        _check_size(archive, LARGEST)
        folders = {name.partition("/")[0] for name in archive.namelist()}
        if len(folders) != 1:
            raise BadInput(f"its policy.pth holds {len(folders)} folders, allowed: 1.")
        folder = folders.pop()
        if f"{folder}/byteorder" in archive.namelist() and _member(archive, f"{folder}/byteorder") != b"little":
            raise BadInput("its policy.pth has another byte order, allowed: little.")
        found = _Index(_member(archive, f"{folder}/data.pkl", LARGEST_INDEX)).load()
        if not isinstance(found, dict) or not all(isinstance(value, _Tensor) for value in found.values()):
            raise BadInput("its policy.pth does not contain a table of tensors.")
        keys = {tensor.storage for tensor in found.values()}
        storages = {key: np.frombuffer(_member(archive, f"{folder}/data/{key}"), "<f4") for key in keys}
        return {str(name): _numbers(storages[tensor.storage], tensor) for name, tensor in found.items()}


class _Tensor:
    """The place of a tensor's numbers in the file; it stands in for the function of torch that rebuilds a tensor."""

    def __init__(self, storage: Any, offset: Any, size: Any, stride: Any, *rest: Any) -> None:
        self.storage, self.offset, self.size, self.stride = storage, offset, size, stride


class _Index(Reader):
    """A reader of the list of tensors that can only make dictionaries and `_Tensor`s."""

    def find_class(self, module: str, name: str) -> Any:
        """The stand-in for one of the three names that torch.save writes for a table of float32 tensors."""
        if (module, name) == ("collections", "OrderedDict"):
            return collections.OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            # a new function each time, so that a file cannot change anything that outlives it
            return lambda *parts: _Tensor(*parts)  # noqa: PLW0108
        if (module, name) == ("torch", "FloatStorage"):
            return "float32"
        raise BadInput(f"its policy.pth asks for {module[:60]}.{name[:60]}, allowed: tables of float32 tensors.")

    def persistent_load(self, pid: Any) -> str:
        """The key of a storage."""
        kind, dtype, key = pid[:3]
        if (kind, dtype) != ("storage", "float32") or not str(key).isalnum():
            raise BadInput("its policy.pth names a storage that is not float32, allowed: float32.")
        return str(key)


def _numbers(storage: np.ndarray, tensor: _Tensor) -> np.ndarray:
    size, offset = tuple(int(length) for length in tensor.size), int(tensor.offset)
    number = math.prod(size)
    if not 1 <= len(size) <= 2 or min(size) < 1 or not 0 <= offset <= storage.size - number:
        raise BadInput(f"its policy.pth holds a tensor of shape {size} that does not fit into its storage.")
    if tuple(tensor.stride) != ((size[1], 1) if len(size) == 2 else (1,)):
        raise BadInput("its policy.pth holds a tensor that is not contiguous.")
    return storage[offset : offset + number].reshape(size)


def _unknown_kind(about: Any) -> str | None:
    """What in the description is not allowed, or None."""
    if not isinstance(about, dict):
        return "has a damaged description."
    policy, options = about.get("policy_class"), about.get("policy_kwargs")
    module = policy.get("__module__") if isinstance(policy, dict) else None
    if module != "stable_baselines3.common.policies" or not isinstance(options, dict):
        found = f"has the policy of another algorithm, or a custom policy (module {str(module)[:60]!r})"
        return f"{found}, allowed: the MlpPolicy of PPO or A2C."
    if about.get("use_sde") or options.get("use_sde"):
        return "explores by gSDE, allowed: a plain Gaussian."
    if options.get("squash_output"):
        return "squashes its output, allowed: a plain Gaussian."
    activation = str(options.get("activation_fn", "Tanh"))[:80]
    if activation not in ("Tanh", "<class 'torch.nn.modules.activation.Tanh'>"):
        return f"has the activation {activation}, allowed: tanh."
    custom = set(options) - HARMLESS - {":type:", ":serialized:", "use_sde", "squash_output"}
    if custom:
        return f"was made with policy_kwargs {str(sorted(custom))[:120]}, allowed: {', '.join(sorted(HARMLESS))}."
    for name, size in (("observation_space", SIZE), ("action_space", 4)):
        space = about.get(name)
        found = space.get("_shape") if isinstance(space, dict) else None
        # the same numbers in a row or a column: gym-pybullet-drones gives every model the shapes [1, N] and [1, 4]
        if not isinstance(found, list) or [length for length in found if length != 1] != [size]:
            kind = str(space.get(":type:"))[:80] if found is None and isinstance(space, dict) else found
            other = " examples/gym_pybullet_drones.py shows how to fly another layout." if size == SIZE else ""
            return f"has {name} {str(kind)[:80]}, allowed: [{size}], or [1, {size}].{other}"
    low, high = (str(about["action_space"].get(end)).replace("[", " ").replace("]", " ").split() for end in ENDS)
    if low != ["-1."] * 4 or high != ["1."] * 4:
        return f"has actions from {low} to {high}, allowed: -1 to 1."
    return None


def actor_network(tensors: dict[str, np.ndarray]) -> Network:
    """The actor of an MlpPolicy, from its tensors by the names in its `state_dict`."""
    layers = _layers(tensors)
    return Network(
        weights=tuple(jnp.asarray(tensors[f"{layer}.weight"].T) for layer in layers),
        biases=tuple(jnp.asarray(tensors[f"{layer}.bias"]) for layer in layers),
    )


def _layers(tensors: dict[str, np.ndarray]) -> list[str]:
    """The names of the actor's layers, first to last."""
    hidden = [f"mlp_extractor.policy_net.{2 * index}" for index in range(len(tensors))]
    return [*(name for name in hidden if f"{name}.weight" in tensors), "action_net"]


def _unknown_shape(tensors: dict[str, np.ndarray]) -> str | None:
    """What in the tensors does not belong to the actor of an MlpPolicy, or None."""
    critic = ("mlp_extractor.value_net.", "value_net.")
    names, layers = {name for name in tensors if not name.startswith(critic)}, _layers(tensors)
    if names != {"log_std", *(f"{layer}.{part}" for layer in layers for part in ("weight", "bias"))}:
        return f"has another architecture ({str(sorted(names))[:120]})."
    width = SIZE
    for layer in layers:
        weight, bias = tensors[f"{layer}.weight"].shape, tensors[f"{layer}.bias"].shape
        if len(weight) != 2 or weight[1] != width or bias != weight[:1]:
            return f"{layer} has shape {weight}, allowed: (outputs, {width})."
        width = weight[0]
    return None if width == 4 else f"gives {width} actions, allowed: 4."


def _not_finite(tensors: dict[str, np.ndarray]) -> str | None:
    bad = [name for name, tensor in tensors.items() if not np.all(np.isfinite(tensor))]
    return f"{bad[0]} holds numbers that are not finite." if bad else None
