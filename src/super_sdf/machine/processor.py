"""The processor of this machine as Linux describes it; other systems say nothing here."""

from __future__ import annotations

import os
import sys
from contextlib import suppress

CPUINFO = "/proc/cpuinfo"
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
    with suppress(OSError):
        file = os.open(CPUINFO, os.O_RDONLY)
        try:
            first, _, _ = os.read(file, 1 << 13).decode("ascii", "replace").partition("\n\n")
        finally:
            os.close(file)
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


def lacking_instructions() -> list[str]:
    """Return the instructions of x86-64-v2 that this processor lacks; empty if it is no x86."""
    flags = described().get("flags", "").split()
    return [name for flag, name in SECOND_LEVEL.items() if flags and flag not in flags]


def check_processor() -> None:
    """End the process with one line if NumPy would crash here; called before it is imported."""
    lacking = lacking_instructions()
    if lacking:
        sys.exit(
            f"Error: this processor has no {', '.join(lacking)}, and NumPy and onnxruntime need "
            "x86-64-v2: use another machine; a virtual one needs the host's processor (-cpu host)"
        )
