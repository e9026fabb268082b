"""How much memory is free, asked before it is taken: a killed process says nothing."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from .errors import OutOfMemoryError


def free_memory() -> int | None:
    """Return the bytes of memory that are free, None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    sizes = dict(line.split(":") for line in lines)
    return int(sizes["MemAvailable"].split()[0]) * 1024 if "MemAvailable" in sizes else None


def held_memory(peak: bool = False) -> int | None:
    """Return the bytes that this process holds, or held at most since ``forget_peak``."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    sizes = dict(line.split(":", 1) for line in lines)
    return int(sizes["VmHWM" if peak else "VmRSS"].split()[0]) * 1024


def forget_peak() -> None:
    """Count the peak of memory from now on; where the system cannot, it stays the process's.

    What was freed is given back first, for else it would be used again unseen.
    """
    import ctypes

    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def check_fits(need: int, what: str, way_out: str) -> None:
    """Raise if ``need`` bytes are not free; ``what`` needs them."""
    free = free_memory()
    if free is not None and need > free:
        raise OutOfMemoryError(
            f"{what} needs {need / 1e9:,.1f} GB of memory, {free / 1e9:,.1f} GB are free; {way_out}"
        )
