"""What every test shares: a single-threaded XLA, a compilation cache, and types that are checked while tests run."""

import ctypes
import gc
import os
import shutil
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Self

import pytest

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

import hypothesis
import jax
from beartype import BeartypeConf, FrozenDict, beartype
from jaxtyping import install_import_hook
from tests.chromium import BROWSERS, ON_A_MAC, Browser

hypothesis.settings.register_profile("flytune", deadline=None)  # no test depends on how busy the machine is
hypothesis.settings.load_profile("flytune")

# A float may be an int, and in compiled code it is a tracer. Beartype knows no Self outside of a decorated class.
RULES = BeartypeConf(hint_overrides=FrozenDict({float: float | int | jax.Array, Self: object}))


def check_types(function):
    """The function with its types and shapes checked at each call.

    Three kinds are left out: constructors, since JAX rebuilds our dataclasses with tracers in their numbers; the
    package's own `__getattr__`, without which its names are not known yet; and the arguments of what a user calls from
    Python, since these functions refuse a bad argument in their own words.
    """
    if function.__name__ == "__init__" or function.__module__ == "flytune":
        return function
    if function.__qualname__ in import_module("flytune").__all__:
        hints = function.__annotations__
        function.__annotations__ = {"return": hints["return"]} if "return" in hints else {}
    return beartype(function, conf=RULES)


sys.modules["flytune_type_checker"] = checker = ModuleType("flytune_type_checker")
checker.check_types = check_types
install_import_hook("flytune", "flytune_type_checker.check_types")


@pytest.fixture(autouse=True, scope="module")
def _compiled_programs_are_freed():
    """Frees the programs that a file's tests compiled: each takes some 5 to 10 MB, and JAX keeps all of them."""
    yield
    jax.clear_caches()
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim:  # the C library of most Linux systems keeps what was freed until it is told to give it back
        trim(0)


@pytest.fixture
def browser(chromium):
    """A running browser, sent to an empty page afterwards: figures in space would go on being drawn."""
    yield chromium
    chromium.call("Page.navigate", url="about:blank")


@pytest.fixture(scope="session")
def chromium(tmp_path_factory):
    """A running headless Chromium; skips where there is none, except in continuous integration, where it fails."""
    found = [path for name in BROWSERS if (path := shutil.which(name))] + [p for p in ON_A_MAC if Path(p).exists()]
    if not found:
        reason = f"no browser: none of {', '.join(BROWSERS)} is installed"
        pytest.fail(reason) if os.environ.get("CI") else pytest.skip(reason)
    running = Browser(found[0], tmp_path_factory.mktemp("profile"))
    yield running
    running.close()
