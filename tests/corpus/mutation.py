"""Random damage to bytes."""

from __future__ import annotations

import numpy as np

ODD = bytes([0x00, 0xFF, 0x7F, 0x80, 0x0A, 0x0D, 0x20, 0x27, 0x28, 0x29, 0x2C, 0x2D, 0x30, 0x39])


def mutate(data: bytes, rng: np.random.Generator, first: int = 0, last: int | None = None) -> bytes:
    """Return the bytes with one to four changes between two positions."""
    last = len(data) if last is None else min(last, len(data))
    for _ in range(int(rng.integers(1, 5))):
        if last <= first:
            break
        data = _change(data, rng, int(rng.integers(first, last)))
        last = min(last, len(data))
    return data


def _change(data: bytes, rng: np.random.Generator, at: int) -> bytes:
    """Return the bytes with one change."""
    length = int(rng.integers(1, 9))
    match int(rng.integers(7)):
        case 0:  # one bit
            return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :]
        case 1:
            return data[:at] + rng.bytes(1) + data[at + 1 :]
        case 2:
            return data[:at] + bytes([ODD[int(rng.integers(len(ODD)))]]) + data[at + 1 :]
        case 3:
            return data[:at] + rng.bytes(length) + data[at:]
        case 4:
            return data[:at] + data[at + length :]
        case 5:  # a piece twice
            return data[: at + length] + data[at:]
        case _:
            return data[:at] + b"\xff" * length + data[at + length :]
