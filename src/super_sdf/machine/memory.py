"""How much memory is free and held, asked before memory is taken: a killed process tells nothing.

On Linux the files of /proc answer; elsewhere psutil does, which takes 25 ms to import.
"""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress
from pathlib import Path

from ..errors import OutOfMemoryError
from .system import left_memory

SYSTEM = Path("/proc/meminfo")
PROCESS = Path("/proc/self/status")
MOUNTS = Path("/proc/self/mountinfo")
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's mallopt, from malloc.h
SHARE = 0.6  # of the memory that is free, the share that is taken unless a bound is given
ROOM_SHARE = 0.25  # of what a bound leaves, the share that an unpacked array may take


def free_memory() -> int | None:
    """Return the bytes of memory that are free, None if the system does not tell.

    In a container with a memory limit, at most what is left of the limit.
    """
    try:
        sizes = _read_sizes(SYSTEM)
    except OSError:
        return _by_psutil("free")
    rooms = [room for room in (sizes.get("MemAvailable"), left_memory()) if room is not None]
    return min(rooms) if "MemAvailable" in sizes else None


def memory_bound(max_memory: int | None = None) -> int | None:
    """Return how many bytes this process may hold in all, None if that is not known.

    ``max_memory`` if given; else what the process holds, and ``SHARE`` of what is free.
    """
    free = free_memory()
    if max_memory is not None or free is None:
        return max_memory
    return (held_memory() or 0) + int(SHARE * free)


def held_memory(peak: bool = False, pid: int | None = None) -> int | None:
    """Return the bytes of memory that this process holds, None if the system does not tell.

    With ``peak``, the most that it has held since ``forget_peak``; with ``pid``, those of another
    process, None once it has ended.
    """
    try:
        sizes = _read_sizes(Path(f"/proc/{pid}/status") if pid else PROCESS)
    except OSError:
        return _peak_elsewhere() if peak else _by_psutil("rss", pid)
    return sizes.get("VmHWM" if peak else "VmRSS")


def _read_sizes(path: Path) -> dict[str, int]:
    """Return the sizes in a file of /proc, in bytes, by name."""
    fields = (line.split(":", 1) for line in path.read_text().splitlines())
    return {name: int(text.split()[0]) * 1024 for name, text in fields if text.endswith(" kB")}


def _by_psutil(what: str, pid: int | None = None) -> int | None:
    """Return the bytes that are "free", that a process "rss" holds, or its peak "peak_wset".

    None without psutil, once the process has ended, and where it has no peak.
    """
    with suppress(ImportError, AttributeError):
        import psutil

        if what == "free":
            return int(psutil.virtual_memory().available)
        with suppress(psutil.Error):  # it has ended
            return int(getattr(psutil.Process(*[pid] if pid else []).memory_info(), what))
    return None


def _peak_elsewhere() -> int | None:
    """Return the peak of this process since its start: Windows tells psutil, others getrusage."""
    if (peak := _by_psutil("peak_wset")) is not None:
        return peak
    with suppress(ImportError):
        import resource

        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    return None


def is_in_memory(folder: str) -> bool:
    """Return whether the files in a folder are in memory, as those in /tmp often are.

    Only Linux tells; elsewhere they seldom are.
    """
    with suppress(OSError):
        device = os.stat(folder).st_dev
        number = f"{os.major(device)}:{os.minor(device)}"
        for line in MOUNTS.read_text().splitlines():
            place, _, kind = line.partition(" - ")
            if place.split()[2] == number:
                return kind.split()[0] in ("tmpfs", "ramfs")
    return False


def give_back() -> None:
    """Give freed memory back to the system, if the C library has a call for it (glibc)."""
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def reuse_freed() -> None:
    """Let this process use freed memory again, as glibc's own settings do after a while.

    Dask sets ``MALLOC_TRIM_THRESHOLD_`` for its workers: then all arrays of more than 128 kB come
    from the system as fresh pages, and converting a grid takes half as much processor time again.
    """
    with suppress(OSError, AttributeError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, 32 << 20)
        mallopt(M_TRIM_THRESHOLD, 64 << 20)


def forget_peak() -> None:
    """Measure the peak of memory from now on; only Linux can, elsewhere it counts from the start.

    Freed memory is given back first: used again, it would not show in the peak.
    """
    give_back()
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def in_words(size: int) -> str:
    """Return a number of bytes as text for users, in the form that ``--max-memory`` takes."""
    return f"{size / 1e9:,.2f} GB" if size >= 1e9 else f"{size / 1e6:,.0f} MB"


def advised(need: int) -> str:
    """Return how much to allow for work that needs ``need`` bytes: plans vary slightly."""
    return in_words(int(1.03 * need) + 1_000_000)


def check_fits(need: int, what: str, way_out: str) -> None:
    """Raise OutOfMemoryError if ``what``, which needs ``need`` bytes, does not fit into memory."""
    free = free_memory()
    if free is not None and need > free:
        raise OutOfMemoryError(
            f"{what} needs {in_words(need)} of memory, {in_words(free)} are free; {way_out}"
        )
