"""A fingerprint of the values that a network gives on this machine.

Processors of some kinds round differently. Where fingerprints agree, slabs of one surface meet.
"""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple

import numpy as np

from ..machine.processor import processor_name
from ..neighbourhood import NEIGHBOURHOOD
from .network import load_network

SIDE, CENTRE, RADIUS = 12, 5.63, 4.0  # of a ball, in index units; the centre is not on a sample


class Fingerprint(NamedTuple):
    """What a network computes, and where.

    ``digest`` is the SHA-256 of its values on a small ball; ``device`` is "cpu" or "cuda",
    ``processor`` the model of the processor, and ``precision`` "float32" or "int8".
    """

    digest: str
    device: str
    processor: str
    precision: str


def fingerprint_of(model: str, precision: str, device: str) -> Fingerprint:
    """Return the fingerprint of a network, named as for ``load_network``; its errors, too."""
    network = load_network(model, precision=precision, device=device, threads=1)
    digest = hashlib.sha256(network(*small_ball()).tobytes()).hexdigest()
    return Fingerprint(digest, network.device, processor_name(), network.precision)


def small_ball() -> tuple[Any, Any, Any, Any]:
    """Return the inputs of a network for a ball: the 624 voxels of its band, and 125 offsets."""
    ijk = np.indices((SIDE,) * 3).reshape(3, -1).T
    band = ijk[np.abs(_distances(ijk)) < 3]  # 1.5 voxels
    around = band[:, None] + NEIGHBOURHOOD
    row_of = np.full((SIDE + 2,) * 3, -1, np.int32)
    row_of[tuple(band.T + 1)] = np.arange(len(band))
    table = row_of[tuple(np.moveaxis(around + 1, -1, 0))]
    offsets = np.indices((5,) * 3).reshape(3, -1).T / 2 - 1
    voxels = np.arange(len(band), dtype=np.int32)
    return _distances(around), table, voxels, offsets.astype(np.float32)


def _distances(ijk: Any) -> Any:
    """Return the signed distances of the ball at indices (..., 3), in half voxels."""
    x, y, z = np.moveaxis(ijk - CENTRE, -1, 0)
    return (2 * (np.sqrt(x * x + y * y + z * z) - RADIUS)).astype(np.float32)
