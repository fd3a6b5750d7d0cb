"""Threads and memory of a training: how many cores it may use, and work that two of them do at the same time."""

import ctypes
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, TypeVar

import jax
from jax.core import Tracer

from flytune.errors import BadInput

T = TypeVar("T")

PARTS = 2  # of a batch, which two cores can compute at the same time
CORES = "FLYTUNE_CORES"  # in the environment: how many cores a training may use at most

# parameters of glibc's mallopt: the size from which a block is mapped by itself, the free memory that is given back,
# and the number of arenas; all but the first arena map blocks of 64 MB and more by themselves
MMAP_THRESHOLD, TRIM_THRESHOLD, ARENA_MAX = -3, -1, -8


def keep_freed_memory() -> None:
    """Let this process keep the memory that it frees, where the C library is glibc.

    An update allocates and frees tens of megabytes. Otherwise the operating system takes the memory back each time, and
    clears every page before it gives it out again: half of the time of an update.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(MMAP_THRESHOLD, 2**30)
        mallopt(TRIM_THRESHOLD, 2**31 - 1)
        mallopt(ARENA_MAX, 1)


def free_cores() -> int:
    """The number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cores() -> int:
    """The number of processor cores that a training may use: those of this process, or fewer by `FLYTUNE_CORES`.

    Raises:
        BadInput: `FLYTUNE_CORES` is no whole number from 1 on.
    """
    wanted = os.environ.get(CORES, "").strip()
    if not wanted:
        return free_cores()
    if not (wanted.isascii() and wanted.isdigit() and int(wanted) > 0):
        raise BadInput(
            f"{CORES}: {wanted!r} is not allowed. Allowed: a whole number, 1 or more. Set another, or unset it."
        )
    return min(free_cores(), int(wanted))


def in_threads(part: Callable[[int], T], number: int, tracer: Any) -> tuple[T, ...]:
    """`part` of 0, 1, ... of at most `PARTS` parts: at the same time where a training may use two cores.

    Args:
        part: of an index; it calls a program.
        number: of parts.
        tracer: an array of the caller, by which a trace is known; a thread of its own would not know of it.
    """
    if isinstance(tracer, Tracer):
        return tuple(map(part, range(number)))

    def finished(index: int) -> T:
        return jax.block_until_ready(part(index))

    return tuple((_threads().map if cores() > 1 else map)(finished, range(number)))


@lru_cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(PARTS, "flytune-part")


class BusyCores:
    """How many threads work on one problem together, which pays only where both find a core of their own at once.

    Beside other load, two threads that wait for each other are slower than one. Then one works, and two try again
    after some updates.
    """

    FREE, PAUSE = 1.6, 15  # seconds of processor per second that show free cores; updates in one thread after fewer

    def __init__(self) -> None:
        self._pause = 0

    def run(self, work: Callable[[int], T]) -> T:
        """`work` of a number of threads, 1 or 2; its result does not depend on it."""
        if cores() == 1 or self._pause:
            self._pause = max(0, self._pause - 1)
            return work(1)
        wall, processor = time.perf_counter(), time.process_time()
        result = jax.block_until_ready(work(PARTS))
        if time.process_time() - processor < self.FREE * (time.perf_counter() - wall):
            self._pause = self.PAUSE
        return result
