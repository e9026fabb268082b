"""Networks: damaged files, odd inputs, outputs and metadata, answers that are no numbers.

They are written without the package ``onnx``; numbers are those of the fields in ``onnx.proto``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from onnx_files import DOUBLE, FLOAT, declared, entry, metadata, node
from onnx_files import INPUTS as CONTRACT

from .case import Case, ball, mutate, npy, rng_of

INT64 = 7
MINUS = 1 << 64  # what a number below 0 is written with
INPUTS = tuple((name, *kind) for name, kind in CONTRACT.items())
OUTPUTS = (("values", FLOAT, "D", "Q"),)
# The middle sample of each voxel, whatever the offset; ``extra`` is added, 0 unless told.
NODES = (
    ("Gather", ("patches", "voxels"), "chosen"),
    ("MatMul", ("chosen", "middle"), "column"),
    ("MatMul", ("offsets", "slope"), "along"),
    ("Transpose", ("along",), "row"),
    ("Add", ("column", "row"), "sum"),
    ("Add", ("sum", "extra"), "values"),
)
METADATA = {"format_version": "1", "receptive_field": "1", "name": "corpus"}


class Net(NamedTuple):
    """What stands in the file of a network."""

    nodes: Sequence[tuple[str, tuple[str, ...], str]] = NODES
    inputs: Sequence[tuple[str | int, ...]] = INPUTS
    outputs: Sequence[tuple[str | int, ...]] = OUTPUTS
    metadata: Mapping[str, str | bytes] = METADATA
    extra: float = 0.0
    opset: int = 17
    ir_version: int = 8
    domain: str = ""

    def to_bytes(self) -> bytes:
        """Return the file."""
        opset = entry(1, self.domain) + entry(2, self.opset % MINUS)
        head = entry(1, self.ir_version % MINUS) + entry(7, self._graph()) + entry(8, opset)
        return head + metadata(self.metadata)

    def _graph(self) -> bytes:
        middle = (np.arange(27) == 13)[:, None]
        tensors = {"middle": middle, "slope": np.zeros((3, 1)), "extra": np.array(self.extra)}
        parts = [*(node(*each, {}) for each in self.nodes), entry(2, "net")]
        parts += [entry(5, _tensor(name, array)) for name, array in tensors.items()]
        parts += [declared(11, *each) for each in self.inputs]
        return b"".join([*parts, *(declared(12, *each) for each in self.outputs)])


def _tensor(name: str, array: np.ndarray) -> bytes:
    dims = b"".join(entry(1, n) for n in array.shape)
    return dims + entry(2, FLOAT) + entry(8, name) + entry(9, array.astype("<f4").tobytes())


GRID = {"in.npy": npy(ball())}
TEXTS: list[str | bytes] = [
    *("", " ", "0", "-1", "1", "2", "1 ", "01", "1.0", "1e9", "1e999", "true", "null", "NaN"),
    *("one", "[]", "{}", "[1]", '"1"', "9" * 5000, "-" + "9" * 5000, "[" * 99999, '{"a":' * 9999),
    *("1000000", b"\xff\xfe", b"\x00", "\n", "4294967297", "9223372036854775808", "0.5", "é"),
]
KEYS = ["format_version", "receptive_field", "training_factors", "value_scaling", "other"]


def odd_nets() -> dict[str, Net]:
    """Return networks that are not what is wanted, or answer what nothing can be made of."""
    texts = ("nan", "inf", "-inf", "3e38", "-3e38", "1e-45", "1", "-5")
    nets = {f"adds-{text}": Net(extra=float(text)) for text in texts}
    for operator in ("Sqrt", "Log", "Reciprocal", "Exp", "Neg", "Floor", "Sign", "Acos", "Nothing"):
        nodes = (*NODES[:-1], (operator, ("sum",), "values"))
        nets[f"ends-with-{operator}"] = Net(nodes)
    for number, (name, kind, *shape) in enumerate(INPUTS):
        others = [value for k, value in enumerate(INPUTS) if k != number]
        declared_as = {
            "renamed": (f"{name}s", kind, *shape),
            "other-type": (name, DOUBLE if kind == FLOAT else INT64, *shape),
            "flat": (name, kind, "N"),
            "deep": (name, kind, "V", 27, 1, 1),
            "fixed": (name, kind, 1, *shape[1:]),
            "negative": (name, kind, MINUS - 1, 27),
        }
        changed = {what: [*others, each] for what, each in declared_as.items()}
        changed |= {"missing": others, "twice": [*INPUTS, INPUTS[number]]}
        nets |= {f"{name}-{what}": Net(inputs=inputs) for what, inputs in changed.items()}
    outputs = {
        "none": (),
        "renamed": (("result", FLOAT, "D", "Q"),),
        "double": (("values", DOUBLE, "D", "Q"),),
        "two": (*OUTPUTS, ("sum", FLOAT, "D", "Q")),
        "flat": (("values", FLOAT, "D"),),
        "fixed": (("values", FLOAT, 1, 1),),
    }
    nets |= {f"output-{what}": Net(outputs=values) for what, values in outputs.items()}
    gives = "Identity column,Identity row,Identity chosen,Transpose sum,ReduceSum sum,Shape sum"
    for each in [*gives.split(","), "Add values sum", "Identity nobody", "Identity"]:
        operator, *inputs = each.split()
        name = each.replace(" ", "-")
        nets[f"gives-{name}"] = Net((*NODES[:-1], (operator, tuple(inputs), "values")))
    nets |= {f"opset-{n}": Net(opset=n) for n in (0, 1, 9999, -1, 2**63)}
    nets |= {f"ir-{n}": Net(ir_version=n) for n in (0, 99, -1)}
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
