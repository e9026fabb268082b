"""What Linux says of the processor, and the limits that control groups set, as of a container.

Control groups are nested; the tightest limit counts. Other systems say nothing here.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import suppress
from math import inf
from pathlib import Path

CPUINFO = "/proc/cpuinfo"
GROUPS = Path("/sys/fs/cgroup")
OWN = Path("/proc/self/cgroup")
# What x86-64-v2 adds, as Linux and as manuals name it. NumPy and onnxruntime are built for it.
SECOND_LEVEL = {
    "ssse3": "SSSE3",
    "sse4_1": "SSE4.1",
    "sse4_2": "SSE4.2",
    "popcnt": "POPCNT",
    "cx16": "CMPXCHG16B",
}


def described() -> dict[str, str]:
    """Return what Linux says of the first processor, by name; empty on other systems."""
    with suppress(OSError), open(CPUINFO, "rb", buffering=0) as file:
        first, _, _ = file.read(1 << 13).decode("ascii", "replace").partition("\n\n")
        pairs = (line.partition(":") for line in first.splitlines())
        return {name.strip(): value.strip() for name, _, value in pairs}
    return {}


def processor_name() -> str:
    """Return the model of the processor, or its architecture if the system does not tell."""
    import platform  # here, since every command imports this module first

    return described().get("model name") or platform.processor() or platform.machine()


def lacks_avx2() -> bool:
    """Return whether this is an x86 processor that has AVX but not AVX2, as of 2011 to 2013."""
    flags = described().get("flags", "").split()
    return "avx" in flags and "avx2" not in flags


def check_processor() -> None:
    """End the process with one line if NumPy would crash here; called before it is imported."""
    flags = described().get("flags", "").split()  # only of x86
    lacking = [name for flag, name in SECOND_LEVEL.items() if flags and flag not in flags]
    if lacking:
        sys.exit(
            f"Error: this processor has no {', '.join(lacking)}, and NumPy and onnxruntime need "
            "x86-64-v2: use another machine; a virtual one needs the host's processor (-cpu host)"
        )


def left_memory() -> int | None:
    """Return how many bytes this process may still take, None without a limit.

    The kernel counts cached files as used, but drops inactive ones when memory is short, so those
    are subtracted.
    """
    left = [room for group in _groups("memory") if (room := _left_in(group)) is not None]
    return min(left, default=None)


def bound_of_cores() -> float:
    """Return how many cores' worth of time this process may use, infinity without a limit."""
    return min(map(_cores_of, _groups("cpu")), default=inf)


def _groups(controller: str) -> Iterator[Path]:
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
    for limit_name, used_name, cache_name in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ):
        with suppress(OSError, ValueError):  # of the other version, or the limit is "max"
            limit, used = (int((group / name).read_text()) for name in (limit_name, used_name))
            statistics: dict[str, int] = {}
            with suppress(OSError, ValueError):
                lines = (group / "memory.stat").read_text().splitlines()
                statistics = {key: int(number) for key, number in map(str.split, lines)}
            return max(limit - max(used - statistics.get(cache_name, 0), 0), 0)
    return None


def _cores_of(group: Path) -> float:
    with suppress(OSError, ValueError):  # as above
        quota, period = (group / "cpu.max").read_text().split()
        return int(quota) / int(period)
    with suppress(OSError, ValueError):
        quota, period = ((group / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        if int(quota) > 0:
            return int(quota) / int(period)
    return inf
