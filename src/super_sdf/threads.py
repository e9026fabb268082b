"""The threads, memory and indices of a run, and work cut into chunks for threads.

Threads and memory are decided once at the start, and passed down to every step. Pieces of work are
independent of each other and may run at the same time; results come in order.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import ceil
from typing import TypeVar

from .errors import OptionError
from .machine.memory import held_memory, memory_bound
from .machine.system import bound_of_cores

Piece = TypeVar("Piece")
Result = TypeVar("Result")

CHUNK = 1 << 19  # temporaries (array elements) per chunk, so that they stay in cache
MIN_PER_THREAD = 1 << 21  # array elements; with fewer, a thread costs more than it saves
MAX_INDEX = 2**31 - 1  # of vertices and nodes, as in mesh files; beyond, one would mean another


@dataclass(frozen=True)
class Resources:
    """The threads that a run may use, and the bytes that its process may hold; None: no bound."""

    threads: int = 1
    memory: int | None = None


ONE_THREAD = Resources()
"""One thread, and no memory bound."""


def allot(threads: int = 0, max_memory: int | None = None) -> Resources:
    """Return what a run may use: the threads asked for, 0 for one per core, which is also the most.

    Without ``max_memory``, the bytes are what the process holds and a share of the free memory.
    """
    return Resources(useful_threads(threads), memory_bound(max_memory))


def allot_each(count: int, threads: int = 0, max_memory: int | None = None) -> Resources:
    """Return the share of each of ``count`` processes in the threads and memory of this machine."""
    bound = memory_bound(max_memory)
    if bound is not None:
        bound = max(1, bound - (held_memory() or 0)) // count
    return Resources(threads or max(1, count_cores() // count), bound)


def check_count(count: int, what: str) -> int:
    """Return ``count``, the number of ``what``; OptionError if 32-bit numbers are too few."""
    if count > MAX_INDEX:
        raise OptionError(
            f"there are {count:,} {what}, but 32-bit indices allow only {MAX_INDEX:,}: use a "
            "smaller factor, or fewer samples"
        )
    return count


def count_cores() -> int:
    """Return the number of cores this process may use; in a container its quota, rounded up."""
    return max(ceil(min(cores_of_system(), bound_of_cores())), 1)


def cores_of_system() -> int:
    """Return the number of cores that the system lets this process run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def useful_threads(requested: int) -> int:
    """Return the number of threads to use: as requested, 0 meaning one per core, but no more."""
    cores = count_cores()
    return min(requested or cores, cores)


def worthwhile_threads(size: int, threads: int) -> int:
    """Return how many of the threads are worth starting for work on ``size`` array elements."""
    return max(min(threads, size // MIN_PER_THREAD), 1)


def rows_in_chunk(width: int) -> int:
    """Return the rows per chunk when each row needs ``width`` temporaries."""
    return max(CHUNK // width, 1)


def chunks_of(count: int, width: int) -> list[slice]:
    """Cut ``count`` rows into chunks, when each row needs ``width`` temporaries."""
    step = rows_in_chunk(width)
    return [slice(first, min(first + step, count)) for first in range(0, count, step)]


def map_chunks(
    work: Callable[[slice], Result], count: int, width: int, threads: int = 1
) -> list[Result]:
    """Return ``work(rows)`` for chunks of ``count`` rows that need ``width`` temporaries each."""
    return map_threads(work, chunks_of(count, width), worthwhile_threads(count * width, threads))


def map_threads(
    work: Callable[[Piece], Result], pieces: Sequence[Piece], threads: int = 1
) -> list[Result]:
    """Return ``work(piece)`` for each piece, in order, with up to ``threads`` threads."""
    return list(over_threads(work, pieces, threads))


def over_threads(
    work: Callable[[Piece], Result], pieces: Sequence[Piece], threads: int = 1
) -> Iterator[Result]:
    """Yield the same, so that not all need to be held."""
    threads = min(threads, len(pieces))
    if threads < 2:
        yield from map(work, pieces)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(work, pieces)
