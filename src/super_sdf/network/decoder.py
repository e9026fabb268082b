"""Running a network, or any function in its place, on a band, and checking its values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import FloatArray, IntArray
from ..errors import ModelError
from ..threads import map_chunks

Decoder = Callable[[FloatArray, IntArray, IntArray, FloatArray], FloatArray]
"""A network, or any function, that returns values (D, Q) of patches (V, 27), neighbour table
(V, 27), voxels (D,) and offsets (Q, 3). It may have the attributes of ``Adapter``.
"""
MAX_VALUE = np.float32(1e15)  # half voxels; sums of squares are still finite in single precision


@dataclass(frozen=True, eq=False)
class Adapter:
    """A network, or any function, with all that the pipeline asks of it."""

    run: Callable[..., FloatArray]
    receptive_field: int | None = None  # voxels to each side; None: it must see the whole band
    memory_bytes: tuple[float, float] = (680.0, 8.0)  # per voxel that it sees, and per value
    threads: int = 0  # of the CPU, also for the other steps; 0 for one per core

    def __call__(self, *inputs: Any) -> FloatArray:
        """Return what the network does."""
        return self.run(*inputs)


def adapt(network: Decoder) -> Adapter:
    """Return a network with the attributes that it has, and defaults for the others."""
    if isinstance(network, Adapter):
        return network
    names = "receptive_field", "memory_bytes", "threads"
    return Adapter(network, **{n: getattr(network, n) for n in names if hasattr(network, n)})


def decode(
    network: Decoder,
    inputs: tuple[FloatArray, IntArray, IntArray],
    offsets: FloatArray,
    threads: int = 1,
) -> FloatArray:
    """Run a network once, and return its values as blocks, (Q, D + 1) float32.

    ``inputs`` are patches (V, 27), neighbour table (V, 27) and voxels (D,); ``offsets``, (Q, 3),
    are in half voxels, and so are the values: a row per offset, a column per voxel, and a last
    column of zeros, see ``refine.nodes``. ModelError if they have another shape or type, or are not
    finite: later steps do not check.
    """
    count, width = len(inputs[2]), len(offsets)
    values: Any = network(*inputs, offsets)
    kind = getattr(values, "dtype", np.dtype(object)).kind
    if kind != "f" or values.shape != (count, width):
        raise ModelError(
            f"the network gave {getattr(values, 'dtype', type(values).__name__)} of shape "
            f"{np.shape(values)} instead of float32 of shape {(count, width)}, (voxels, offsets)"
        )
    blocks = np.empty((width, count + 1), np.float32)
    blocks[:, count] = 0

    def transpose_and_check(rows: slice) -> int:
        with np.errstate(over="ignore"):  # values that are too large are counted
            some = values[rows].astype(np.float32, copy=False)
        blocks[:, rows] = some.T
        if some.min() >= -MAX_VALUE and some.max() <= MAX_VALUE:  # both are False for NaN
            return 0
        return int(np.count_nonzero(~(np.abs(some) <= MAX_VALUE)))

    bad = sum(map_chunks(transpose_and_check, count, 4 * width, threads))
    if bad:
        raise ModelError(
            f"{bad:,} of the {values.size:,} values that the network gave are NaN, infinite or "
            "beyond 1e15: it cannot be used for this grid; use another --model"
        )
    return blocks
