"""What the pipeline asks of a network, and whether the answer can be used."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from ..arrays import FloatArray, IntArray
from ..errors import ModelError
from ..machine.threads import in_chunks
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
) -> FloatArray:
    """Return a network's values, (D, Q) float32 in half voxels, of which all are usable.

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

    Raises
    ------
    ModelError
        If the values have another shape, or are not finite. Nothing after the network looks again.
    """
    tells = progress is not None and getattr(network, "tells_progress", False)
    told: dict[str, Any] = {"progress": progress} if tells else {}
    values = network(*inputs, offsets, **told)
    return check_values(values, (len(inputs[2]), len(offsets)))


def check_values(values: Any, shape: tuple[int, int]) -> FloatArray:
    """Return a network's values as float32 if they are numbers of this shape, else raise."""
    kind = getattr(values, "dtype", type(values).__name__)
    if not isinstance(values, np.ndarray) or values.shape != shape or values.dtype.kind != "f":
        raise ModelError(
            f"the network gave {kind} of shape {np.shape(values)} in place of float32 of shape "
            f"{shape}, (voxels, offsets)"
        )
    with np.errstate(over="ignore"):  # what is too large is refused next
        single: FloatArray = np.ascontiguousarray(values, np.float32)
    bad = sum(in_chunks(*shape, lambda rows: count_unusable(single[rows])))
    if bad:
        raise ModelError(
            f"{bad:,} of the {single.size:,} values that the network gave are NaN, infinite or "
            "beyond 1e15: it cannot be used for this grid; use another --model"
        )
    return single


def count_unusable(values: FloatArray) -> int:
    """Count values that are NaN, infinite or too large, in a moment if there are none."""
    if values.min() >= -LARGEST and values.max() <= LARGEST:  # both false of NaN
        return 0
    return int(np.count_nonzero(~(np.abs(values) <= LARGEST)))
