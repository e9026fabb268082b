"""What a run may take, and how far it is: threads, memory, work in chunks, progress.

Threads and memory are decided once at the start, and passed down. Pieces of work are independent of
each other and may run at the same time; results come in order.
"""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from math import ceil
from pathlib import Path
from typing import TypeVar

import psutil

from .errors import OptionError, OutOfMemoryError

Piece = TypeVar("Piece")
Result = TypeVar("Result")

CHUNK = 1 << 19  # temporaries (array elements) per chunk, so that they stay in cache
MIN_PER_THREAD = 1 << 20  # array elements; with fewer, a thread costs more than it saves
MAX_INDEX = 2**31 - 1  # of vertices and nodes, as in mesh files; beyond, one would mean another

GROUPS, OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
SHARE = 0.6  # of the memory that is free, the share that is taken unless a bound is given


def check_count(count: int, what: str) -> int:
    """Return ``count``, the number of ``what``; OptionError if 32-bit numbers are too few."""
    if count > MAX_INDEX:
        raise OptionError(
            f"there are {count:,} {what}, but 32-bit indices allow only {MAX_INDEX:,}: use a "
            "smaller factor, or fewer samples"
        )
    return count


def cores_of_system() -> int:
    """Return the number of cores that the system lets this process run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def count_cores() -> int:
    """Return the number of cores this process may use; in a container its quota, rounded up."""
    quotas = _of_groups(lambda quota, period: int(quota) / int(period), "cpu.max")
    return max(ceil(min([cores_of_system(), *quotas])), 1)


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


def over_threads(
    work: Callable[[Piece], Result], pieces: Sequence[Piece], threads: int = 1
) -> Iterator[Result]:
    """Yield ``work(piece)`` for each piece, in order, with up to ``threads`` threads."""
    if min(threads, len(pieces)) < 2:
        yield from map(work, pieces)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(work, pieces)


def map_chunks(
    work: Callable[[slice], Result], count: int, width: int, threads: int = 1
) -> list[Result]:
    """Return ``work(rows)`` for chunks of ``count`` rows that need ``width`` temporaries each."""
    threads = worthwhile_threads(count * width, threads)
    return list(over_threads(work, chunks_of(count, width), threads))


def call_beside(work: Callable[[], object], stop: Callable[[], object]) -> None:
    """Do some work in another thread, and ``stop`` it at an interrupt; errors are passed on."""
    with ThreadPoolExecutor(1) as pool:  # waits at the end
        try:
            pool.submit(work).result()
        except BaseException:
            stop()
            raise


def free_memory() -> int:
    """Return the bytes of memory that are free; in a container at most what is left of its limit.

    Inactive cached files of a container can be dropped.
    """

    def left(most: str, taken: str, *stat: str) -> int:
        cached = int(stat[stat.index("inactive_file") + 1])
        return max(int(most) - max(int(taken) - cached, 0), 0)

    files = "memory.max", "memory.current", "memory.stat"
    return min([int(psutil.virtual_memory().available), *_of_groups(left, *files)])


def held_memory() -> int:
    """Return the bytes of memory that this process holds."""
    return int(psutil.Process().memory_info().rss)


def memory_bound(max_memory: int | None = None) -> int:
    """Return how many bytes this process may hold in all.

    ``max_memory`` if given; else what the process holds, and ``SHARE`` of what is free.
    """
    return max_memory or held_memory() + int(SHARE * free_memory())


def check_fits(need: int, what: str, way_out: str) -> None:
    """Raise OutOfMemoryError if ``what``, which needs ``need`` bytes, does not fit into memory."""
    if need > (free := free_memory()):
        raise OutOfMemoryError(
            f"{what} needs {in_words(need)} of memory, {in_words(free)} are free; {way_out}"
        )


def check_bound(need: int, what: str, max_memory: int | None, way_out: str = "") -> None:
    """Raise OutOfMemoryError if ``need`` bytes beside what is held pass the process's bound."""
    bound, need = memory_bound(max_memory), need + held_memory()
    if need > bound:
        raise OutOfMemoryError(
            f"{what} needs {in_words(need)} of memory, {in_words(bound)} may be taken in all; "
            f"{way_out}allow more (--max-memory)"
        )


def in_words(size: float) -> str:
    """Return a number of bytes as text for users, in the form that ``--max-memory`` takes."""
    return f"{size / 1e9:,.2f} GB" if size >= 1e9 else f"{size / 1e6:,.0f} MB"


def give_back() -> None:
    """Give freed memory back to the system, if the C library has a call for it (glibc)."""
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def _of_groups(take: Callable[..., Result], *names: str) -> Iterator[Result]:
    """Yield what is taken of the words in files of the control groups that this process is in.

    Groups (version 2), such as those of containers, are nested; the tightest limit counts. In a
    container the path of the group may not exist: what is mounted there is the group itself.
    """
    with suppress(OSError, IndexError):  # not Linux, or version 1
        inner = GROUPS / OWN.read_text().split("0::/")[1].split("\n")[0]
        for group in (inner, *inner.parents):
            with suppress(OSError, ValueError):  # no such file, or the limit is "max"
                yield take(*" ".join((group / name).read_text() for name in names).split())


Progress = Callable[[int, int], None]
"""Called with (done, total), in thousandths of the work; ``done`` never falls and ends at total.

If it raises an exception, the work stops with that exception.
"""
TOTAL = 1000
# Share of the time that each step takes with a network on a CPU.
STEPS = {"band": 0.03, "network": 0.45, "nodes": 0.15, "isosurface": 0.37}


def part_of(progress: Progress | None, begin: float, end: float) -> Progress | None:
    """Return a callback for a part of the work, between two shares of it; None without one."""
    if progress is None:
        return None
    return lambda n, total: progress(round(TOTAL * (begin + (end - begin) * n / total)), TOTAL)


class Stopwatch:
    """Adds up the seconds spent in each stage, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.clock = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        self.take({stage: time.perf_counter() - self.clock})

    def take(self, seconds: Mapping[str, float]) -> None:
        """Add times that were measured elsewhere, and restart the clock."""
        for stage, more in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + more
        self.clock = time.perf_counter()


class StepCounter(Stopwatch):
    """Reports progress and measures time, step by step; ``finish`` ends each step."""

    def __init__(self, progress: Progress | None = None, names: Iterable[str] = STEPS) -> None:
        super().__init__()
        whole = sum(STEPS[name] for name in names)
        self.lengths = {name: STEPS[name] / whole for name in names}
        self.progress, self.done = progress, 0.0

    def show(self, share: float) -> None:
        """Report the share of all work that is done."""
        if self.progress:
            self.progress(round(TOTAL * share), TOTAL)

    def finish(self, name: str) -> None:
        """Report that a step is done, and record its time."""
        self.lap(name)
        self.done += self.lengths[name]
        self.show(1.0 if name == "isosurface" else self.done)

    def within(self, name: str) -> Callable[[float], None] | None:
        """Return a callback for the share of a step that starts now; None without ``progress``."""
        begin, length = self.done, self.lengths[name]
        return (lambda share: self.show(begin + share * length)) if self.progress else None
