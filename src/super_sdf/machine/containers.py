"""What a Linux control group, as containers are, leaves to this process: memory and cores.

Groups lie in each other; each may have bounds, and the tightest counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from math import inf
from pathlib import Path

GROUPS = Path("/sys/fs/cgroup")
OWN = Path("/proc/self/cgroup")


def left_memory() -> int | None:
    """Return how many bytes this process may still take, None without a bound.

    Files that the system keeps in memory count as taken there, but are let go of when that is
    short; those not in use are left out, therefore.
    """
    left = [room for group in groups("memory") if (room := _left_in(group)) is not None]
    return min(left, default=None)


def bound_of_cores() -> float:
    """Return how many cores' time this process may take, infinity without a bound."""
    return min(map(_cores_of, groups("cpu")), default=inf)


def groups(controller: str) -> Iterator[Path]:
    """Yield the folders of the groups that this process is in, the innermost first.

    In a container the path of its group may not be there: what is, is the group itself.
    """
    with suppress(OSError):
        for line in OWN.read_text().splitlines():
            _, names, path = line.split(":", 2)
            if names and controller not in names.split(","):
                continue
            root = GROUPS / controller if names else GROUPS
            inner = root / path.strip("/")
            yield from (folder for folder in (inner, *inner.parents) if folder.is_relative_to(root))


def _left_in(group: Path) -> int | None:
    """Return what a group leaves, of version 2 or 1; None where there is no bound."""
    for bound, taken, kept in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ):
        with suppress(OSError, ValueError):  # of the other version, or its bound is the word "max"
            limit = int((group / bound).read_text())
            used = int((group / taken).read_text())
            return max(limit - max(used - _statistic(group, kept), 0), 0)
    return None


def _statistic(group: Path, name: str) -> int:
    """Return an entry of a group's statistics, 0 if it is not there."""
    with suppress(OSError, ValueError):
        for line in (group / "memory.stat").read_text().splitlines():
            key, number = line.split()
            if key == name:
                return int(number)
    return 0


def _cores_of(group: Path) -> float:
    """Return how many cores' time a group may take, of version 2 or 1."""
    with suppress(OSError, ValueError):  # as above
        quota, period = (group / "cpu.max").read_text().split()
        return int(quota) / int(period)
    with suppress(OSError, ValueError):
        quota, period = ((group / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        if int(quota) > 0:
            return int(quota) / int(period)
    return inf
