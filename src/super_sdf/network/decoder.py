"""Running a network on a band, and checking the values that it returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ..arrays import FloatArray, IntArray
from ..errors import ModelError
from ..progress import ShareCallback
from ..threads import map_chunks

# In half voxels; squares of sums of such values are still finite in single precision.
MAX_VALUE = np.float32(1e15)
# Memory of a network that does not state it: bytes per voxel that it sees, including its row of the
# neighbour table, and per value.
NETWORK_BYTES = (680.0, 8.0)


class Decoder(Protocol):
    """The interface of a network to the pipeline; ``network.Network`` and any function have it.

    It may have the attributes of ``Adapter``; without one, the default there holds.
    """

    def __call__(
        self, patches: FloatArray, table: IntArray, voxels: IntArray, offsets: FloatArray
    ) -> FloatArray:
        """Return values (D, Q) of patches (V, 27), table (V, 27), voxels (D,), offsets (Q, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class Adapter:
    """A network, or any function, with all that the pipeline asks of it."""

    run: Any  # a ``Decoder``
    receptive_field: int | None = None  # voxels to each side; None: it must see the whole band
    reports_progress: bool = False  # whether a call takes ``progress``, a ``ShareCallback``
    memory_bytes: tuple[float, float] = NETWORK_BYTES
    threads: int = 0  # of the CPU, also for the other steps; 0 for one per core


def adapt(network: Decoder | Adapter) -> Adapter:
    """Return a network with the attributes that it has, and defaults for the others."""
    if isinstance(network, Adapter):
        return network
    names = "receptive_field", "reports_progress", "memory_bytes", "threads"
    return Adapter(network, **{n: getattr(network, n) for n in names if hasattr(network, n)})


def decode(
    network: Adapter,
    inputs: tuple[FloatArray, IntArray, IntArray],
    offsets: FloatArray,
    progress: ShareCallback | None = None,
    threads: int = 1,
) -> FloatArray:
    """Run a network once, and return its checked values as blocks, (Q, D + 1) float32.

    ``inputs`` are patches (V, 27), neighbour table (V, 27) and voxels (D,); ``offsets``, (Q, 3),
    are in half voxels, and so are the values: a row per offset, a column per voxel, and a last
    column of zeros, see ``refine.nodes``. ModelError if they have another shape or type, or are not
    finite: later steps do not check.
    """
    reports = progress is not None and network.reports_progress
    values = network.run(*inputs, offsets, **({"progress": progress} if reports else {}))
    shape, is_array = (len(inputs[2]), len(offsets)), isinstance(values, np.ndarray)
    if not (is_array and values.shape == shape and values.dtype.kind == "f"):
        kind = values.dtype if is_array else type(values).__name__
        raise ModelError(
            f"the network gave {kind} of shape {np.shape(values)} instead of float32 of shape "
            f"{shape}, (voxels, offsets)"
        )
    return to_blocks(values, threads)


def to_blocks(values: FloatArray, threads: int = 1) -> FloatArray:
    """Return values (D, Q) as blocks (Q, D + 1), the last column 0; ModelError as ``decode``."""
    count, offsets = values.shape
    blocks = np.empty((offsets, count + 1), np.float32)
    blocks[:, count] = 0

    def transpose_and_check(rows: slice) -> int:
        with np.errstate(over="ignore"):  # values that are too large are counted
            some = values[rows].astype(np.float32, copy=False)
        blocks[:, rows] = some.T
        if some.min() >= -MAX_VALUE and some.max() <= MAX_VALUE:  # both are False for NaN
            return 0
        return int(np.count_nonzero(~(np.abs(some) <= MAX_VALUE)))

    bad = sum(map_chunks(transpose_and_check, count, 4 * offsets, threads))
    if bad:
        raise ModelError(
            f"{bad:,} of the {values.size:,} values that the network gave are NaN, infinite or "
            "beyond 1e15: it cannot be used for this grid; use another --model"
        )
    return blocks
