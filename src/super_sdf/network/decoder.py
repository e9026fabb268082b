"""What the pipeline asks of a network, and whether the answer can be used."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from ..arrays import FloatArray, IntArray
from ..errors import ModelError
from ..machine.threads import map_chunks
from ..progress import Tell

# Half voxels: the squares of sums of such values are still numbers in single precision.
LARGEST = np.float32(1e15)


class Decoder(Protocol):
    """What the pipeline asks of a network: see ``network.Network``.

    If it has a ``receptive_field`` (voxels to each side), it need not see the whole band at once.
    If it says that it ``tells_progress``, it is given what to tell, as ``progress``. Its
    ``memory_bytes`` say what it takes: see ``footprint.slab_bytes``.
    """

    def __call__(
        self, patches: FloatArray, table: IntArray, voxels: IntArray, offsets: FloatArray
    ) -> FloatArray:
        """Map patches (V, 27), neighbours (V, 27), voxels (D,), offsets (Q, 3) to (D, Q)."""
        ...


def decode(
    network: Decoder,
    inputs: tuple[FloatArray, IntArray, IntArray],
    offsets: FloatArray,
    progress: Tell | None = None,
    threads: int = 1,
) -> FloatArray:
    """Return a network's values in half voxels, of which all are usable.

    Parameters
    ----------
    network : Decoder
        Called once.
    inputs : tuple of arrays
        Patches (V, 27), neighbours (V, 27), voxels (D,).
    offsets : (Q, 3) float32
        In half voxels.
    progress : callable, optional
        Told the share that is done, if the network tells it.
    threads : int
        How many work at a time, after the network.

    Returns
    -------
    (Q, D + 1) float32
        A row for each offset, a column for each voxel, and one of zeros: see ``steps.nodes``.

    Raises
    ------
    ModelError
        If the values have another shape, or are not finite. Nothing after the network looks again.
    """
    tells = progress is not None and getattr(network, "tells_progress", False)
    told: dict[str, Any] = {"progress": progress} if tells else {}
    values = network(*inputs, offsets, **told)
    check_kind(values, (len(inputs[2]), len(offsets)))
    return to_blocks(values, threads)


def check_kind(values: Any, shape: tuple[int, int]) -> None:
    """Raise if a network's values are not floating-point numbers of this shape."""
    kind = getattr(values, "dtype", type(values).__name__)
    if not isinstance(values, np.ndarray) or values.shape != shape or values.dtype.kind != "f":
        raise ModelError(
            f"the network gave {kind} of shape {np.shape(values)} in place of float32 of shape "
            f"{shape}, (voxels, offsets)"
        )


def to_blocks(values: FloatArray, threads: int = 1) -> FloatArray:
    """Return values (D, Q) as blocks (Q, D + 1), if all of them can be used."""
    count, offsets = values.shape
    blocks = np.empty((offsets, count + 1), np.float32)
    blocks[:, count] = 0

    def check_and_turn(rows: slice) -> int:
        with np.errstate(over="ignore"):  # what is too large is refused
            some = values[rows].astype(np.float32, copy=False)
        blocks[:, rows] = some.T
        return count_unusable(some)

    bad = sum(map_chunks(check_and_turn, count, 4 * offsets, threads))
    if bad:
        raise ModelError(
            f"{bad:,} of the {values.size:,} values that the network gave are NaN, infinite or "
            "beyond 1e15: it cannot be used for this grid; use another --model"
        )
    return blocks


def count_unusable(values: FloatArray) -> int:
    """Count values that are NaN, infinite or too large, in a moment if there are none."""
    if values.min() >= -LARGEST and values.max() <= LARGEST:  # both false of NaN
        return 0
    return int(np.count_nonzero(~(np.abs(values) <= LARGEST)))
