"""Networks: damaged files, odd inputs, outputs and metadata, answers that are no numbers.

They are written without the package ``onnx``; numbers are those of the fields in ``onnx.proto``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from .case import Case, ball, mutate, npy, rng_of

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


GRID = {"in.npy": npy(ball())}
TEXTS: list[str | bytes] = [
    *("", " ", "0", "-1", "1", "2", "1 ", "01", "1.0", "1e9", "1e999", "true", "null", "NaN"),
    *("one", "[]", "{}", "[1]", '"1"', "9" * 5000, "-" + "9" * 5000, "[" * 99999, '{"a":' * 9999),
    *("1000000", b"\xff\xfe", b"\x00", "\n", "4294967297", "9223372036854775808", "0.5", "é"),
]
KEYS = ["format_version", "receptive_field", "training_factors", "value_scaling", "other"]


def odd_nets() -> dict[str, Net]:
    """Return networks that are not what is wanted, or answer what nothing can be made of."""
    numbers = {
        text: float(text) for text in ["nan", "inf", "-inf", "3e38", "-3e38", "1e-45", "1", "-5"]
    }
    nets = {f"adds-{text}": Net(extra=number) for text, number in numbers.items()}
    for operator in ("Sqrt", "Log", "Reciprocal", "Exp", "Neg", "Floor", "Sign", "Acos", "Nothing"):
        nodes = (*NODES[:-1], (operator, ("sum",), ("values",)))
        nets[f"ends-with-{operator}"] = Net(nodes)
    for number in range(4):
        others = [value for k, value in enumerate(INPUTS) if k != number]
        name, kind, shape = INPUTS[number]
        wrong = DOUBLE if kind == FLOAT else INT64
        changed = {
            "missing": others,
            "renamed": [*others, (f"{name}s", kind, shape)],
            "other-type": [*others, (name, wrong, shape)],
            "flat": [*others, (name, kind, ("N",))],
            "deep": [*others, (name, kind, ("V", 27, 1, 1))],
            "fixed": [*others, (name, kind, (1, *shape[1:]))],
            "narrow": [*others, (name, kind, ("V", 26))],
            "negative": [*others, (name, kind, (-1, 27))],
            "twice": [*INPUTS, INPUTS[number]],
        }
        nets |= {f"{name}-{what}": Net(inputs=inputs) for what, inputs in changed.items()}
    outputs = {
        "none": (),
        "renamed": (("result", FLOAT, ("D", "Q")),),
        "double": (("values", DOUBLE, ("D", "Q")),),
        "integer": (("values", INT32, ("D", "Q")),),
        "two": (*OUTPUTS, ("sum", FLOAT, ("D", "Q"))),
        "flat": (("values", FLOAT, ("D",)),),
        "fixed": (("values", FLOAT, (1, 1)),),
    }
    nets |= {f"output-{what}": Net(outputs=values) for what, values in outputs.items()}
    for name, last in {
        "one-column": ("Identity", ("column",), ("values",)),
        "one-row": ("Identity", ("row",), ("values",)),
        "too-many": ("Identity", ("chosen",), ("values",)),
        "turned": ("Transpose", ("sum",), ("values",)),
        "scalar": ("ReduceSum", ("sum",), ("values",)),
        "shape": ("Shape", ("sum",), ("values",)),
        "itself": ("Add", ("values", "sum"), ("values",)),
        "unknown": ("Identity", ("nobody",), ("values",)),
        "nothing": ("Identity", (), ("values",)),
    }.items():
        nets[f"gives-{name}"] = Net((*NODES[:-1], last))
    nets |= {f"opset-{n}": Net(opset=n) for n in (0, 1, 6, 9999, -1, 2**63)}
    nets |= {f"ir-{n}": Net(ir_version=n) for n in (0, 1, 99, -1)}
    return nets | {"empty": Net(()), "domain": Net(domain="some.where"), "bare": Net(metadata={})}


def cases(seed: int) -> Iterator[Case]:
    """Yield the cases of this theme."""
    yield from _both("right", Net().to_bytes())
    for name, net in odd_nets().items():
        yield from _both(name, net.to_bytes())
        yield _upsample(f"{name}-cap", net.to_bytes(), "--cap", "--factor", "2")
    for key in KEYS:
        for number, text in enumerate(TEXTS):
            data = Net(metadata={**METADATA, key: text}).to_bytes()
            yield _upsample(f"{key}-{number}", data, "--max-memory", "400M")
    for number, data in enumerate((b"", b"x", b"\x00" * 999, b"\x08", npy(ball()), b"PK\x03\x04")):
        yield from _both(f"none-{number}", data)
    whole = Net().to_bytes()
    for number in range(260):
        name = f"damaged-{number}"
        yield _upsample(name, mutate(whole, rng_of(name, seed)))
    for number in range(40):
        name = f"cut-{number}"
        yield _upsample(name, whole[: int(rng_of(name, seed).integers(len(whole)))])
    yield from _shipped(seed)


def _shipped(seed: int) -> Iterator[Case]:
    from super_sdf.network.network import shipped_models

    whole = shipped_models()["base-int8"].read_bytes()
    for number in range(60):
        name = f"shipped-{number}"
        rng = rng_of(name, seed)
        first, last = ((0, 3000), (len(whole) - 9000, None), (0, None))[number % 3]
        yield _upsample(name, mutate(whole, rng, first, last))
    weights = bytearray(whole)
    for number in range(20):
        name = f"shipped-weights-{number}"
        at = int(rng_of(name, seed).integers(5000, len(whole) - 20000))
        yield _upsample(name, bytes(weights[:at] + b"\xff" * 64 + weights[at + 64 :]))


def _upsample(name: str, data: bytes, *options: str) -> Case:
    words = ("upsample", "in.npy", "out.ply", "--model", "net.onnx", *options)
    return Case(f"models/{name}", words, {**GRID, "net.onnx": data}, ("out.ply",))


def _both(name: str, data: bytes) -> Iterator[Case]:
    yield _upsample(name, data)
    words = ("batch", "in.npy", "--out", "out", "--jobs", "1", "--model", "net.onnx")
    made = ("out", "out/*")
    yield Case(f"models/{name}-batch", words, {**GRID, "net.onnx": data}, made)
