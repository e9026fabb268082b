"""Running a network on a band, and checking the values that it returns."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from ..arrays import FloatArray, IntArray
from ..errors import ModelError
from ..machine.threads import map_chunks
from ..progress import ShareCallback

# In half voxels; squares of sums of such values are still finite in single precision.
MAX_VALUE = np.float32(1e15)


class Decoder(Protocol):
    """The interface of a network to the pipeline; ``network.Network`` and any function have it.

    Optional attributes:

    ``receptive_field``
        Voxels to each side that a value depends on. Without it, the network must see the whole
        band at once.
    ``reports_progress``
        True if a call takes the argument ``progress``, a ``ShareCallback``.
    ``memory_bytes``
        Memory that a call takes: see ``footprint.slab_bytes``.
    ``threads``
        CPU threads, also for the other steps; 0 for one per core.
    """

    def __call__(
        self, patches: FloatArray, table: IntArray, voxels: IntArray, offsets: FloatArray
    ) -> FloatArray:
        """Return values (D, Q) of patches (V, 27), table (V, 27), voxels (D,), offsets (Q, 3)."""
        ...


def decode(
    network: Decoder,
    inputs: tuple[FloatArray, IntArray, IntArray],
    offsets: FloatArray,
    progress: ShareCallback | None = None,
    threads: int = 1,
) -> FloatArray:
    """Run a network, and return its checked values as blocks.

    Parameters
    ----------
    network : Decoder
        Called once.
    inputs : tuple of arrays
        Patches (V, 27), neighbour table (V, 27), voxels (D,).
    offsets : (Q, 3) float32
        Query offsets in half voxels.
    progress : callable, optional
        Called with the finished share, if the network reports it.
    threads : int
        Threads to use after the network.

    Returns
    -------
    (Q, D + 1) float32
        Values in half voxels: a row per offset, a column per voxel, and a last column of zeros.
        See ``steps.nodes``.

    Raises
    ------
    ModelError
        If the values have another shape or type, or are not finite. Later steps do not check.
    """
    reports = progress is not None and getattr(network, "reports_progress", False)
    options: dict[str, Any] = {"progress": progress} if reports else {}
    values = network(*inputs, offsets, **options)
    check_output(values, (len(inputs[2]), len(offsets)))
    return to_blocks(values, threads)


def check_output(values: Any, shape: tuple[int, int]) -> None:
    """Raise ModelError if a network's values are not floating-point numbers of this shape."""
    kind = getattr(values, "dtype", type(values).__name__)
    if not isinstance(values, np.ndarray) or values.shape != shape or values.dtype.kind != "f":
        raise ModelError(
            f"the network gave {kind} of shape {np.shape(values)} instead of float32 of shape "
            f"{shape}, (voxels, offsets)"
        )


def to_blocks(values: FloatArray, threads: int = 1) -> FloatArray:
    """Return values (D, Q) as blocks (Q, D + 1), the last column 0.

    Raises
    ------
    ModelError
        If any value is not finite, or beyond ``MAX_VALUE``.
    """
    count, offsets = values.shape
    blocks = np.empty((offsets, count + 1), np.float32)
    blocks[:, count] = 0

    def transpose_and_check(rows: slice) -> int:
        with np.errstate(over="ignore"):  # values that are too large are counted
            some = values[rows].astype(np.float32, copy=False)
        blocks[:, rows] = some.T
        return count_unusable(some)

    bad = sum(map_chunks(transpose_and_check, count, 4 * offsets, threads))
    if bad:
        raise ModelError(
            f"{bad:,} of the {values.size:,} values that the network gave are NaN, infinite or "
            "beyond 1e15: it cannot be used for this grid; use another --model"
        )
    return blocks


def count_unusable(values: FloatArray) -> int:
    """Count values that are NaN, infinite or too large; fast if there are none."""
    if values.min() >= -MAX_VALUE and values.max() <= MAX_VALUE:  # both are False for NaN
        return 0
    return int(np.count_nonzero(~(np.abs(values) <= MAX_VALUE)))
