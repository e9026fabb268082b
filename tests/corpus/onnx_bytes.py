"""Small ONNX networks as bytes, written without the package ``onnx``: right ones and wrong ones.

Numbers are those of the fields in ``onnx.proto``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

FLOAT, INT32, INT64, DOUBLE = 1, 6, 7, 11
KINDS = {"f": FLOAT, "i": INT32, "l": INT64, "d": DOUBLE}
Value = tuple[str, int, tuple[int | str, ...]]
"""A name, its type, and its shape: a number or a name for each axis."""

INPUTS: tuple[Value, ...] = (
    ("patches", FLOAT, ("V", 27)),
    ("neighbours", INT32, ("V", 27)),
    ("voxels", INT32, ("D",)),
    ("offsets", FLOAT, ("Q", 3)),
)
OUTPUTS: tuple[Value, ...] = (("values", FLOAT, ("D", "Q")),)
Node = tuple[str, Sequence[str], Sequence[str]]
"""An operator, what goes in and what comes out."""

# The middle sample of each voxel, whatever the offset; ``extra`` is added, 0 unless told.
NODES: tuple[Node, ...] = (
    ("Gather", ("patches", "voxels"), ("chosen",)),
    ("MatMul", ("chosen", "middle"), ("column",)),
    ("MatMul", ("offsets", "slope"), ("along",)),
    ("Transpose", ("along",), ("row",)),
    ("Add", ("column", "row"), ("sum",)),
    ("Add", ("sum", "extra"), ("values",)),
)
METADATA = {"format_version": "1", "receptive_field": "1", "name": "corpus"}


@dataclass(frozen=True)
class Net:
    """What stands in the file of a network."""

    nodes: Sequence[Node] = NODES
    inputs: Sequence[Value] = INPUTS
    outputs: Sequence[Value] = OUTPUTS
    metadata: Mapping[str, str | bytes] = field(default_factory=lambda: METADATA)
    extra: float = 0.0
    opset: int = 17
    ir_version: int = 8
    domain: str = ""

    def to_bytes(self) -> bytes:
        """Return the file."""
        parts = [_number(1, self.ir_version), _bytes(7, self._graph())]
        parts.append(_bytes(8, _bytes(1, self.domain) + _number(2, self.opset)))
        parts += [_bytes(14, _bytes(1, k) + _bytes(2, v)) for k, v in self.metadata.items()]
        return b"".join(parts)

    def _graph(self) -> bytes:
        middle = np.zeros((27, 1), np.float32)
        middle[13] = 1
        tensors = {
            "middle": middle,
            "slope": np.zeros((3, 1), np.float32),
            "extra": np.array(self.extra, np.float32),
        }
        parts = [_bytes(1, _node(*node)) for node in self.nodes]
        parts.append(_bytes(2, "net"))
        parts += [_bytes(5, _tensor(name, array)) for name, array in tensors.items()]
        parts += [_bytes(11, _value(*value)) for value in self.inputs]
        parts += [_bytes(12, _value(*value)) for value in self.outputs]
        return b"".join(parts)


def _varint(number: int) -> bytes:
    number &= (1 << 64) - 1
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes([*out, number])


def _number(key: int, number: int) -> bytes:
    return _varint(key << 3) + _varint(number)


def _bytes(key: int, data: bytes | str) -> bytes:
    raw = data.encode() if isinstance(data, str) else data
    return _varint(key << 3 | 2) + _varint(len(raw)) + raw


def _node(operator: str, inputs: Iterable[str], outputs: Iterable[str]) -> bytes:
    parts = [_bytes(1, name) for name in inputs] + [_bytes(2, name) for name in outputs]
    return b"".join([*parts, _bytes(4, operator)])


def _tensor(name: str, array: np.ndarray) -> bytes:
    dims = b"".join(_number(1, n) for n in array.shape)
    raw = array.astype("<f4").tobytes() if array.ndim else struct.pack("<f", array)
    return dims + _number(2, FLOAT) + _bytes(8, name) + _bytes(9, raw)


def _value(name: str, kind: int, shape: Sequence[int | str]) -> bytes:
    axes = [_number(1, n) if isinstance(n, int) else _bytes(2, n) for n in shape]
    dims = b"".join(_bytes(1, axis) for axis in axes)
    tensor = _number(1, kind) + _bytes(2, dims)
    return _bytes(1, name) + _bytes(2, _bytes(1, tensor))
