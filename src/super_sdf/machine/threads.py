"""Threads, and work that is cut into pieces for them.

Pieces do not depend on each other, so they may run at the same time; results come in their order.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from math import ceil
from typing import TypeVar

from .containers import bound_of_cores

Piece = TypeVar("Piece")
Result = TypeVar("Result")

CHUNK = 1 << 19  # numbers that are worked on at a time, so that temporaries stay in cache
WORTH = 1 << 21  # numbers for each thread, or threads cost more than they save


def count_cores() -> int:
    """Return how many cores this process may use: in a container, its share of them, rounded up."""
    return max(ceil(min(cores_of_system(), bound_of_cores())), 1)


def cores_of_system() -> int:
    """Return how many cores the system lets this process run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def useful_threads(requested: int) -> int:
    """Return the number of threads to use for a requested number, 0 meaning one per core.

    More than there are cores would wait for each other.
    """
    cores = count_cores()
    return min(requested or cores, cores)


def worthwhile(numbers: int, threads: int) -> int:
    """Return how many of the threads are worth starting for work on ``numbers`` numbers."""
    return max(min(threads, numbers // WORTH), 1)


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
    return map_threads(work, chunks_of(count, width), worthwhile(count * width, threads))


def map_threads(
    work: Callable[[Piece], Result], pieces: Sequence[Piece], threads: int = 1
) -> list[Result]:
    """Return ``work(piece)`` for each piece, by as many threads."""
    threads = min(threads, len(pieces))
    if threads < 2:
        return [work(piece) for piece in pieces]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, pieces))
