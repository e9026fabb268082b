"""Small networks of the contract as ONNX files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import onnx
from onnx import TensorProto, helper

INPUTS = {
    "patches": (TensorProto.FLOAT, ["V", 27]),
    "neighbours": (TensorProto.INT32, ["V", 27]),
    "voxels": (TensorProto.INT32, ["D"]),
    "offsets": (TensorProto.FLOAT, ["Q", 3]),
}
# The mean of a voxel's patch plus the sum of the offset: values (D, Q).
MEAN = (
    helper.make_node("Gather", ["patches", "voxels"], ["patch"]),
    helper.make_node("ReduceMean", ["patch"], ["mean"], axes=[1]),
    helper.make_node("ReduceMean", ["offsets"], ["shift"], axes=[1]),
    helper.make_node("Transpose", ["shift"], ["row"]),
    helper.make_node("Add", ["mean", "row"], ["sum"]),
)


def write_network(
    path: Path,
    last: tuple[str, str] = ("Identity", "sum"),
    card: Mapping[str, str] | None = None,
    kind: int = TensorProto.FLOAT,
    shape: Sequence[int | str] = ("D", "Q"),
) -> Path:
    """Write a network that makes "values" of "sum", the mean of the patch plus the offset's."""
    attributes = {"to": kind} if last[0] == "Cast" else {}
    end = helper.make_node(last[0], [last[1]], ["values"], **attributes)
    inputs = [helper.make_tensor_value_info(name, *about) for name, about in INPUTS.items()]
    output = helper.make_tensor_value_info("values", kind, shape)
    graph = helper.make_graph([*MEAN, end], "network", inputs, [output])
    opsets = [helper.make_opsetid("", 13)]
    model = helper.make_model(graph, ir_version=8, opset_imports=opsets)
    card = {"format_version": "1", "receptive_field": "1"} if card is None else card
    helper.set_model_props(model, dict(card))
    onnx.save(model, path)
    return path
