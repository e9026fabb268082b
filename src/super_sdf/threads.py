"""What a run may take, and how far it is: threads, memory, work in chunks, progress.

Threads and memory are decided once at the start, and passed down. Pieces of work are independent of
each other and may run at the same time; results come in order.
"""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from math import ceil
from pathlib import Path
from typing import TypeVar

import psutil

from .errors import OptionError, OptionTypeError, OutOfMemoryError, seen

Piece = TypeVar("Piece")
Result = TypeVar("Result")

CHUNK = 1 << 19  # temporaries (array elements) per chunk, so that they stay in cache
MIN_PER_THREAD = 1 << 21  # array elements; with fewer, a thread costs more than it saves
MAX_INDEX = 2**31 - 1  # of vertices and nodes, as in mesh files; beyond, one would mean another

GROUPS, OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
SHARE = 0.6  # of the memory that is free, the share that is taken unless a bound is given


def check_count(count: int, what: str) -> int:
    """Return ``count``, the number of ``what``; OptionError if 32-bit numbers are too few."""
    if count > MAX_INDEX:
        said = f"there are {count:,} {what}, but 32-bit indices allow only {MAX_INDEX:,}"
        raise OptionError(f"{said}: use a smaller factor, or fewer samples")
    return count


def cores_of_system() -> int:
    """Return the number of cores that the system lets this process run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def count_cores() -> int:
    """Return the number of cores this process may use; in a container its quota, rounded up."""
    quotas = [float(quota) / int(period) for quota, period in _of_groups("cpu.max")]
    return max(ceil(min([cores_of_system(), *quotas])), 1)


def useful_threads(requested: int) -> int:
    """Return the number of threads to use: as requested, 0 meaning one per core, but no more."""
    cores = count_cores()
    return min(requested or cores, cores)


def worthwhile_threads(size: int, threads: int) -> int:
    """Return how many of the threads are worth starting for work on ``size`` array elements."""
    return max(min(threads, size // MIN_PER_THREAD), 1)


def chunks_of(count: int, width: int) -> list[slice]:
    """Cut ``count`` rows into chunks, when each row needs ``width`` temporaries."""
    step = max(CHUNK // width, 1)
    return [slice(first, min(first + step, count)) for first in range(0, count, step)]


def over_threads(
    work: Callable[[Piece], Result], pieces: Sequence[Piece], threads: int = 1
) -> Iterator[Result]:
    """Yield ``work(piece)`` for each piece, in order, with up to ``threads`` threads."""
    with ThreadPoolExecutor(threads) as pool:  # starts its threads when it gets work
        yield from (pool.map if min(threads, len(pieces)) > 1 else map)(work, pieces)


def map_chunks(
    work: Callable[[slice], Result], count: int, width: int, threads: int = 1
) -> list[Result]:
    """Return ``work(rows)`` for chunks of ``count`` rows that need ``width`` temporaries each."""
    threads = worthwhile_threads(count * width, threads)
    return list(over_threads(work, chunks_of(count, width), threads))


def free_memory() -> int:
    """Return the bytes of memory that are free; in a container what is left of its limit."""
    left = [float(psutil.virtual_memory().available)]
    for most, taken, *stat in _of_groups("memory.max", "memory.current", "memory.stat"):
        cached = int(stat[stat.index("inactive_file") + 1])  # can be dropped
        left.append(max(float(most) - max(int(taken) - cached, 0), 0))
    return int(min(left))


def held_memory() -> int:
    """Return the bytes of memory that this process holds."""
    return int(psutil.Process().memory_info().rss)


def memory_bound(max_memory: int | None = None) -> int:
    """Return how many bytes this process may hold: by default, ``SHARE`` of what is free more."""
    return max_memory or held_memory() + int(SHARE * free_memory())


def check_fits(need: int, what: str, way_out: str, most: int | None = None) -> None:
    """Raise OutOfMemoryError if ``what``, which needs ``need`` bytes, does not fit into memory.

    ``most`` is what the process may hold in all, from ``memory_bound``; by default what is free.
    """
    free = free_memory() if most is None else max(most - held_memory(), 0)
    if need > free:
        allow = "" if most is None else f" of the {in_words(most)} that may be taken in all"
        raise OutOfMemoryError(
            f"{what} needs {in_words(need)} of memory, {in_words(free)}{allow} are free; {way_out}"
        )


def in_words(size: float) -> str:
    """Return a number of bytes as text for users, in the form that ``--max-memory`` takes."""
    return f"{size / 1e9:,.2f} GB" if size >= 1e9 else f"{size / 1e6:,.0f} MB"


def give_back() -> None:
    """Give freed memory back to the system, if the C library has a call for it (glibc)."""
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def _of_groups(*names: str) -> Iterator[list[str]]:
    """Yield the words in files of each control group that this process is in; "inf" for "max".

    Groups (version 2), such as those of containers, are nested; the tightest limit counts. In a
    container the path of the group may not exist: what is mounted there is the group itself.
    """
    with suppress(OSError, IndexError):  # not Linux, or version 1
        inner = GROUPS / OWN.read_text().split("0::/")[1].split("\n")[0]
        for group in (inner, *inner.parents):
            with suppress(OSError):  # no such file
                words = " ".join((group / name).read_text() for name in names).split()
                yield ["inf" if word == "max" else word for word in words]


Progress = Callable[[int, int], None]
"""Called with (done, total), in thousandths of the work; ``done`` never falls and ends at total.

If it raises an exception, the work stops with that exception.
"""
# Share of the time that each step takes with a network on a CPU.
STEPS = {"read": 0.1, "band": 0.03, "network": 0.4, "nodes": 0.14, "isosurface": 0.33}
MESHING = ("band", "network", "nodes", "isosurface")


class Steps:
    """Measures the time of steps, by name, and reports the share of the work that is ``done``.

    ``names`` are the steps that ``finish`` ends, each as often as it does.
    """

    def __init__(self, progress: Progress | None = None, names: Iterable[str] = MESHING) -> None:
        if not (progress is None or callable(progress)):
            said = "give a function of (done, total), in thousandths"
            raise OptionTypeError(f"progress is {seen(progress)}: {said}")
        self.progress, self.done, self.clock = progress, 0.0, time.perf_counter()
        self.scale = 1 / sum(STEPS[name] for name in names)
        self.seconds: dict[str, float] = {}

    def lap(self, name: str) -> None:
        """Add the time since the last lap to a step."""
        last, self.clock = self.clock, time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + self.clock - last

    def show(self, share: float) -> None:
        """Report the share of all work that is done."""
        if self.progress:
            self.progress(round(1000 * share), 1000)

    def finish(self, name: str) -> None:
        """Report that a step is done, and record its time."""
        self.lap(name)
        self.done += self.scale * STEPS[name]
        self.show(self.done)

    def within(self, name: str) -> Callable[[float], None] | None:
        """Return a callback for the share of a step that starts now; None without ``progress``."""
        begin, length = self.done, self.scale * STEPS[name]
        return (lambda share: self.show(begin + share * length)) if self.progress else None
