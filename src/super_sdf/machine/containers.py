"""The limits of memory and processor time that a Linux control group sets, as of a container.

Control groups are nested; the tightest limit counts. Other systems have none.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from math import inf
from pathlib import Path

GROUPS = Path("/sys/fs/cgroup")
OWN = Path("/proc/self/cgroup")


def left_memory() -> int | None:
    """Return how many bytes this process may still take, None without a limit.

    The kernel counts cached files as used, but drops inactive ones when memory is short, so those
    are subtracted.
    """
    left = [room for group in groups("memory") if (room := _left_in(group)) is not None]
    return min(left, default=None)


def bound_of_cores() -> float:
    """Return how many cores' worth of time this process may use, infinity without a limit."""
    return min(map(_cores_of, groups("cpu")), default=inf)


def groups(controller: str) -> Iterator[Path]:
    """Yield the folders of the groups that this process is in, innermost first.

    In a container the path of the group may not exist: what is mounted there is the group itself.
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
    """Return the bytes that a group of version 2 or 1 leaves, None without a limit."""
    for limit_name, used_name, cache_name in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ):
        with suppress(OSError, ValueError):  # of the other version, or the limit is "max"
            limit = int((group / limit_name).read_text())
            used = int((group / used_name).read_text())
            return max(limit - max(used - _statistic(group, cache_name), 0), 0)
    return None


def _statistic(group: Path, name: str) -> int:
    """Return an entry of a group's memory statistics, 0 if there is none of that name."""
    with suppress(OSError, ValueError):
        for line in (group / "memory.stat").read_text().splitlines():
            key, number = line.split()
            if key == name:
                return int(number)
    return 0


def _cores_of(group: Path) -> float:
    """Return how many cores' worth of time a group of version 2 or 1 may use."""
    with suppress(OSError, ValueError):  # as above
        quota, period = (group / "cpu.max").read_text().split()
        return int(quota) / int(period)
    with suppress(OSError, ValueError):
        quota, period = ((group / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        if int(quota) > 0:
            return int(quota) / int(period)
    return inf
