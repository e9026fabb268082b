"""The contract of an ONNX file with this package: its inputs, output and metadata.

Inputs are ``patches`` (V, 27), ``neighbours`` (V, 27), ``voxels`` (D,) and ``offsets`` (Q, 3); the
output is ``values`` (D, Q). Distances and offsets are in half voxels. The metadata, the model card,
holds the training factors, data and accuracy, the width (``channels``), and the receptive field; a
network that sees farther, up to the whole grid, states none. If it states ``wide``, 2, patches have
two more columns: ``grid.derived.wide_distances``. Its entry ``inputs`` is what the network was
trained on: ``EXACT_DISTANCES``, hardly any of them noisy; or ``MASKS``; without the entry,
distances of which some were noisy.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray, IntArray
from ..errors import ModelError, seen
from ..threads import map_chunks

FORMAT_VERSION = 1
EXACT_DISTANCES, MASKS = "exact distances", "masks"
INPUTS = {
    "patches": "tensor(float)",
    "neighbours": "tensor(int32)",
    "voxels": "tensor(int32)",
    "offsets": "tensor(float)",
}
OUTPUT = {"values": "tensor(float)"}
WHOLE = {"receptive_field": range(1, 2**31), "channels": range(1, 2**31), "wide": [2]}  # of a card
MAX_VALUE = np.float32(1e15)  # half voxels; sums of squares are still finite in single precision
Decoder = Callable[[FloatArray, IntArray, IntArray, FloatArray], FloatArray]
"""A network, or any function, that returns values (D, Q) of patches (V, 27), neighbour table
(V, 27), voxels (D,) and offsets (Q, 3). It may have the attributes of ``Adapter``.
"""


def trial(wide: int = 0) -> dict[str, Any]:
    """Return inputs of one voxel, and two offsets, to notice an output with its axes swapped."""
    arrays = np.zeros((1, 27 + wide), np.float32), np.full((1, 27), -1, np.int32)
    return dict(zip(INPUTS, (*arrays, np.zeros(1, np.int32), np.zeros((2, 3), np.float32))))


def read_card(session: Any, path: Path) -> dict[str, Any]:
    """Return the metadata of a file; ModelError if it does not fulfil the contract."""
    try:
        inputs = {given.name: given.type for given in session.get_inputs()}
        outputs = {made.name: made.type for made in session.get_outputs()}
        card = dict(session.get_modelmeta().custom_metadata_map)
    except UnicodeDecodeError as error:
        raise ModelError(f"{path} is damaged: it has names that are not UTF-8 text") from error
    fault, version = "", card.get("format_version")
    if (inputs, outputs, version) != (INPUTS, OUTPUT, str(FORMAT_VERSION)):
        fault = f"format {seen(version)}, inputs {seen(inputs)}, outputs {seen(outputs)}"
    for key, text in card.items():
        with suppress(ValueError, RecursionError):  # others stay text
            card[key] = json.loads(text)
        if key in WHOLE and (type(card[key]) is not int or card[key] not in WHOLE[key]):
            fault = f"{key} {seen(card[key])}"
    if fault:
        said = f"{path} is no super-sdf network of format {FORMAT_VERSION} ({fault})"
        raise ModelError(f"{said}: export it again with export/to_onnx.py")
    return card


@dataclass(frozen=True, eq=False)
class Adapter:
    """A network, or any function, with all that the pipeline asks of it."""

    run: Callable[..., FloatArray]
    receptive_field: int | None = None  # voxels to each side; None: it must see the whole band
    memory_bytes: tuple[float, float] = (680.0, 8.0)  # per voxel that it sees, and per value
    threads: int = 0  # of the CPU, also for the other steps; 0 for one per core
    wide: int = 0  # inputs of a voxel besides its patch

    def __call__(self, *inputs: Any) -> FloatArray:
        """Return what the network does."""
        return self.run(*inputs)


def adapt(network: Decoder) -> Adapter:
    """Return a network with the attributes that it has, and defaults for the others."""
    if isinstance(network, Adapter):
        return network
    names = "receptive_field", "memory_bytes", "threads"
    known = {n: getattr(network, n) for n in names if hasattr(network, n)}
    return Adapter(network, **known, wide=getattr(network, "card", {}).get("wide", 0))


def decode(
    network: Decoder,
    inputs: tuple[FloatArray, IntArray, IntArray],
    offsets: FloatArray,
    blocks: FloatArray,
    threads: int = 1,
) -> None:
    """Run a network once, and write its values into blocks, (Q, D) float32.

    ``inputs`` are patches (V, 27), neighbour table (V, 27) and voxels (D,); ``offsets``, (Q, 3),
    are in half voxels, and so are the values: a row per offset, a column per voxel. ModelError if
    they have another shape or type, or are not finite: later steps do not check.
    """
    count, width = len(inputs[2]), len(offsets)
    values: Any = network(*inputs, offsets)
    kind = getattr(values, "dtype", np.dtype(object)).kind
    if kind != "f" or values.shape != (count, width):
        raise ModelError(
            f"the network gave {getattr(values, 'dtype', type(values).__name__)} of shape "
            f"{np.shape(values)} instead of float32 of shape {(count, width)}, (voxels, offsets)"
        )

    def transpose_and_check(rows: slice) -> bool:
        with np.errstate(over="ignore"):  # values that are too large are found
            some = values[rows].astype(np.float32, copy=False)
        blocks[:, rows] = some.T
        return bool(some.min() >= -MAX_VALUE and some.max() <= MAX_VALUE)  # False for NaN

    if not all(map_chunks(transpose_and_check, count, 4 * width, threads)):
        said = "the network gave values that are NaN, infinite or beyond 1e15"
        raise ModelError(f"{said}: it cannot be used for this grid; use another --model")
