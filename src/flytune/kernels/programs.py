"""Compiled functions that a later process loads instead of tracing and compiling them again.

JAX keeps compiled programs in a folder (`jax_compilation_cache_dir`), but finds one only after it has traced the
function in Python, which takes seconds for a training. The programs here are kept in the same folder under a name that
depends on all that a trace depends on: the source code of flytune, the versions of what it uses, the processor, the
structure and types of the arguments, and the static arguments.
"""

import dataclasses
import functools
import hashlib
import inspect
import math
import os
import pickle
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jax.experimental import serialize_executable
from jaxlib import lapack

from flytune.kernels import native
from flytune.kernels.batched import SWITCH

PACKAGES = ("jax", "jaxlib", "optax", "numpy", "llvmlite")  # whose versions are part of the name
KNOWN = ("builtins", "flytune", *PACKAGES)
SETTINGS = ("jax_enable_x64", "jax_default_matmul_precision", "jax_default_prng_impl", "jax_threefry_partitionable")

_lock = threading.RLock()


class Foreign(Exception):
    """A type or function of a module outside `KNOWN`: what a trace does with it cannot be known beforehand."""


def program(
    *, static: Sequence[str] = (), donate: Sequence[str] = ()
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """A decorator: the function as `jax.jit` compiles it, kept on disk where JAX has a folder for compiled programs.

    Programs are kept for a CPU that is JAX's only device.

    A function that meets code outside flytune, for instance a reward term of a user, is compiled as usual.

    Args:
        static: names of arguments that another program is compiled for.
        donate: names of arguments whose memory the program may use.
    """
    return lambda function: _program(function, static, donate)


def _program(function: Callable[..., Any], static: Sequence[str], donate: Sequence[str]) -> Callable[..., Any]:
    @functools.wraps(function)
    def kept(*args: Any, **kwargs: Any) -> Any:
        return function(*args, **kwargs)

    kept.__name__ = f"kept_{function.__name__}"  # a name that JAX's own cache never sees, see `_compile`
    options: Any = {"static_argnames": tuple(static), "donate_argnames": tuple(donate)}
    usual, compiled = jax.jit(function, **options), jax.jit(kept, **options)
    signature = inspect.signature(function)
    programs: dict[Any, Callable[..., Any]] = {}

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        values = bound.arguments
        fixed = {name: values[name] for name in static}
        leaves, structure = jax.tree.flatten({name: value for name, value in values.items() if name not in fixed})
        if not _possible() or any(isinstance(leaf, Tracer) for leaf in leaves):
            return usual(**values)
        kinds = tuple([_kind(leaf) for leaf in leaves])
        key = (structure, kinds, tuple(fixed.values()), _settings())
        if key not in programs:
            with _lock:  # two threads would trace twice
                if key not in programs:
                    named = _place(function, structure, kinds, fixed)
                    programs[key] = usual if named is None else _load_or_compile(named, compiled, values, fixed)
        return programs[key](**values)

    return call


def _kind(leaf: Any) -> Any:
    """What a program depends on of an array or a number."""
    if isinstance(leaf, jax.Array):
        return leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)  # keys have none
    return jax.api_util.shaped_abstractify(leaf)


def _place(function: Any, structure: Any, kinds: Sequence[Any], fixed: dict[str, Any]) -> Path | None:
    """Where a program is kept; None where it depends on code that is not flytune's."""
    folder: Any = native.cache_folder()
    try:
        described = [_name(function), list(_nodes(structure)), [str(kind) for kind in kinds], _static(fixed)]
    except Foreign:
        return None
    text = repr([described, _surroundings(), _settings()])
    return folder / f"program-{hashlib.sha256(text.encode()).hexdigest()[:40]}"


def _settings() -> tuple[str, ...]:
    """The settings of JAX that a trace depends on."""
    return tuple(str(getattr(jax.config, name)) for name in SETTINGS)


def _possible() -> bool:
    """Whether programs are kept: for a CPU as the only device, and not where JAX shows what happens in a function."""
    shown = any(getattr(jax.config, name) for name in ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs"))
    return native.cache_folder() is not None and not shown and [each.platform for each in jax.devices()] == ["cpu"]


def _load_or_compile(place: Path, compiled: Any, values: dict[str, Any], fixed: dict[str, Any]) -> Callable[..., Any]:
    loaded = _load(place)
    if loaded is None:
        with native.recorded() as kernels:
            loaded = _compile(compiled, values)
        _save(place, loaded, sorted(kernels))
    return lambda **given: loaded(**{name: value for name, value in given.items() if name not in fixed})


def _compile(compiled: Any, values: dict[str, Any]) -> Any:
    """The program, compiled and not read from JAX's own cache: what was read from there cannot be written again."""
    least = jax.config.jax_persistent_cache_min_compile_time_secs  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_persistent_cache_min_compile_time_secs", math.inf)
    try:
        return compiled.lower(**values).compile()
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", least)


def _load(place: Path) -> Any:
    content = native.kept(place)
    if content is None:
        return None
    kernels, uses_lapack, code, in_tree, out_tree = pickle.loads(content)
    if not all(map(native.load, kernels)):
        return None
    if uses_lapack:
        lapack.prepare_lapack_call("geqrf", np.float32)  # JAX does this when it traces; a call before it crashes
    return serialize_executable.deserialize_and_load(code, in_tree, out_tree)


def _save(place: Path, loaded: Any, kernels: Sequence[str]) -> None:
    uses_lapack = 'custom_call_target="lapack' in loaded.as_text()
    native.keep(place, pickle.dumps((kernels, uses_lapack, *serialize_executable.serialize(loaded))))


def _nodes(structure: Any) -> Iterator[Any]:
    """The types and the static fields of a pytree, from the top."""
    node = structure.node_data()
    yield None if node is None else [_name(node[0]), _static(node[1])]
    for child in structure.children():
        yield from _nodes(child)


def _static(value: Any) -> Any:
    """What a static value is, as text or lists of text that are the same in every process."""
    match value:
        case None | bool() | int() | float() | str():
            return repr(value)
        case tuple() | list():
            return [_name(type(value)), *map(_static, value)]
        case dict():
            return [[_static(key), _static(each)] for key, each in value.items()]
        case np.generic() | np.ndarray():
            return [str(value.dtype), value.tolist()]
        case type():
            return _name(value)
        case _ if dataclasses.is_dataclass(value):
            fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
            return [_name(type(value)), _static(fields)]
        case _ if callable(value):
            return _name(value)
    raise Foreign


def _name(thing: Any) -> str:
    """The name of a type or function by which its code is found."""
    module, name = getattr(thing, "__module__", ""), getattr(thing, "__qualname__", "<")
    if module.split(".")[0] not in KNOWN or "<" in name:
        raise Foreign
    return f"{module}.{name}"


@functools.cache
def _surroundings() -> list[str]:
    """What programs depend on beside their arguments and the settings of JAX: code, versions, processor, flags."""
    code = hashlib.sha256()
    folder = Path(__file__).parents[1]
    for path in sorted(folder.rglob("*.py")):
        code.update(f"{path.relative_to(folder)}\n".encode() + path.read_bytes())
    versions = [sys.version, *(metadata.version(package) for package in PACKAGES)]
    devices = [f"{device.platform} {device.device_kind}" for device in jax.devices()]
    variables = [os.environ.get(name, "") for name in ("XLA_FLAGS", SWITCH)]
    return [code.hexdigest(), *versions, *devices, *variables, native.processor()]
