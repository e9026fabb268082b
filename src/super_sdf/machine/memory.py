"""How much memory is free, asked before it is taken: a killed process says nothing."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from pathlib import Path

from ..errors import OutOfMemoryError
from .containers import left_memory

# Of the memory that is free, what is taken unless told otherwise.
SHARE = 0.6


def free_memory() -> int | None:
    """Return the bytes of memory that are free, None where the system does not say.

    In a container that is bounded, what is left of its bound if that is less.
    """
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    sizes = dict(line.split(":") for line in lines)
    if "MemAvailable" not in sizes:
        return None
    free = int(sizes["MemAvailable"].split()[0]) * 1024
    left = left_memory()
    return free if left is None else min(free, left)


def memory_bound(max_memory: int | None = None) -> int | None:
    """Return how many bytes this process may hold in all, None if nobody can say.

    ``max_memory`` if that is given, else what it holds and ``SHARE`` of what is free.
    """
    free = free_memory()
    if max_memory is not None or free is None:
        return max_memory
    return (held_memory() or 0) + int(SHARE * free)


def held_memory(peak: bool = False) -> int | None:
    """Return the bytes that this process holds, or held at most since ``forget_peak``."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    sizes = dict(line.split(":", 1) for line in lines)
    return int(sizes["VmHWM" if peak else "VmRSS"].split()[0]) * 1024


def give_back() -> None:
    """Give the system back what was freed, where the C library has such a call (glibc)."""
    with suppress(OSError, AttributeError, TypeError):  # the last: Windows knows no CDLL(None)
        ctypes.CDLL(None).malloc_trim(0)


def forget_peak() -> None:
    """Count the peak of memory from now on; where the system cannot, it stays the process's.

    What was freed is given back first, for else it would be used again unseen.
    """
    give_back()
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def in_words(size: int) -> str:
    """Return a number of bytes as users read it, and as ``--max-memory`` takes it."""
    return f"{size / 1e9:,.2f} GB" if size >= 1e9 else f"{size / 1e6:,.0f} MB"


def check_fits(need: int, what: str, way_out: str) -> None:
    """Raise if ``need`` bytes are not free; ``what`` needs them."""
    free = free_memory()
    if free is not None and need > free:
        raise OutOfMemoryError(
            f"{what} needs {in_words(need)} of memory, {in_words(free)} are free; {way_out}"
        )
