"""Small networks of the contract as ONNX files, written without the package onnx.

A file is nested fields, each a number, a kind and a payload (protobuf); see onnx.proto.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

FLOAT, INT32, DOUBLE = 1, 6, 11
INPUTS = {
    "patches": (FLOAT, "V", 27),
    "neighbours": (INT32, "V", 27),
    "voxels": (INT32, "D"),
    "offsets": (FLOAT, "Q", 3),
}
# The mean of a voxel's patch plus the sum of the offset: values (D, Q).
MEAN = (
    ("Gather", ("patches", "voxels"), "patch", {}),
    ("ReduceMean", ("patch",), "mean", {"axes": (1,)}),
    ("ReduceMean", ("offsets",), "shift", {"axes": (1,)}),
    ("Transpose", ("shift",), "row", {}),
    ("Add", ("mean", "row"), "sum", {}),
)
SAME = (("Identity", ("sum",), "values", {}),)


def varint(number: int) -> bytes:
    """Write a whole number, seven bits a byte."""
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes(out) + bytes([number])


def entry(number: int, payload: bytes | str | int) -> bytes:
    """Write one field."""
    if isinstance(payload, int):
        return varint(number << 3) + varint(payload)
    data = payload.encode() if isinstance(payload, str) else payload
    return varint(number << 3 | 2) + varint(len(data)) + data


def node(
    kind: str, inputs: tuple[str, ...], result: str, attributes: Mapping[str, object]
) -> bytes:
    """Write an operator; attributes are ints or tuples of ints."""
    body = b"".join(entry(1, name) for name in inputs) + entry(2, result) + entry(4, kind)
    for name, value in attributes.items():
        numbers = isinstance(value, tuple)
        ints = b"".join(entry(8, one) for one in value) if numbers else entry(3, value)
        body += entry(5, entry(1, name) + ints + entry(20, 7 if numbers else 2))
    return entry(1, body)


def declared(number: int, name: str, kind: int, *shape: int | str) -> bytes:
    """Declare an input (11) or an output (12) of a graph."""
    sizes = b"".join(entry(1, entry(1 if isinstance(n, int) else 2, n)) for n in shape)
    return entry(number, entry(1, name) + entry(2, entry(1, entry(1, kind) + entry(2, sizes))))


def write_network(
    path: Path,
    last: tuple[tuple[str, tuple[str, ...], str, Mapping[str, object]], ...] = SAME,
    card: Mapping[str, str] | None = None,
    output: tuple[int | str, ...] = (FLOAT, "D", "Q"),
) -> Path:
    """Write a network that makes "values" of "sum", the mean of the patch plus the offset's."""
    graph = b"".join(node(*step) for step in (*MEAN, *last)) + entry(2, "network")
    graph += b"".join(declared(11, name, *kind) for name, kind in INPUTS.items())
    graph += declared(12, "values", *output)
    card = {"format_version": "1", "receptive_field": "1"} if card is None else card
    about = b"".join(entry(14, entry(1, key) + entry(2, text)) for key, text in card.items())
    model = entry(1, 8) + entry(8, entry(1, "") + entry(2, 13)) + entry(7, graph) + about
    path.write_bytes(model)
    return path
