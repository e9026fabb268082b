"""Replace the blocks of an exported graph by blocks in integer arithmetic.

Only standard operators are used, in the sequence that onnxruntime fuses: dequantize, multiply,
quantize, which rectifies, too. With a Relu between, onnxruntime 1.21 to 1.30 make two nodes of one
name in a Scan and refuse them. The gathered features are bytes, a quarter of the memory. Integer
sums are exact in any order, so the values of a voxel depend only on its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import onnx
from onnx import TensorProto, numpy_helper

from export.onnx_graph import EARLY, Writer, declared, rows_of

ONE = "int8_one"
NONE = "int8_none"


@dataclass(frozen=True, eq=False)
class IntLayer:
    """A linear layer: ``(values @ weight + bias) * scales``, with integer values from 0 to 255."""

    weight: np.ndarray  # (K, n) int8
    scales: np.ndarray  # (n,) float32
    bias: np.ndarray  # (n,) int32


@dataclass(frozen=True, eq=False)
class IntBlock:
    """A residual block. Its features f are quantized as ``f / step + zero``, from 0 to 255."""

    step: np.float32
    zero: np.uint8
    conv: IntLayer
    expand: IntLayer
    reduce: IntLayer


class IntWriter(Writer):
    """A part of the graph, with integer layers."""

    def quantize(self, value: str) -> str:
        """Round to 0..255, saturating: negative values become 0."""
        return self.op("QuantizeLinear", value, ONE, NONE)

    def layer(self, value: str, layer: IntLayer, label: str) -> str:
        scales = self.constant(layer.scales, f"{label}.scales")
        operands = [self.op("DequantizeLinear", value, ONE, NONE)]
        # onnxruntime fuses the operators only if the zero points, all 0, are explicit
        for name, array, axis in (("weight", layer.weight, 1), ("bias", layer.bias, 0)):
            zeros = self.constant(np.zeros(len(layer.scales), array.dtype), f"{label}.{name}_zeros")
            whole = self.constant(array, f"{label}.{name}")
            operands.append(self.op("DequantizeLinear", whole, scales, zeros, axis=axis))
        return self.op("Gemm", *operands)


def replace_blocks(graph: onnx.GraphProto, blocks: list[IntBlock]) -> None:
    """Replace the blocks of a graph, its Scan nodes in order."""
    scans = [node for node in graph.node if node.op_type == "Scan"]
    scans = [node for node in scans if body_of(node).name not in ("stem", "gate", "head")]
    scans.sort(key=lambda scan: body_of(scan).name == f"block{EARLY}")  # it is the last one
    graph.initializer.append(numpy_helper.from_array(np.float32(1), ONE))
    graph.initializer.append(numpy_helper.from_array(np.uint8(0), NONE))
    made_by = {name: node for node in graph.node for name in node.output}
    rounded: dict[str, str] = {}
    for scan, block in zip(scans, blocks, strict=True):
        read = made_by[body_of(scan).node[1].input[0]]  # the first node gathers the table
        gathered = made_by[read.input[2]] if read.op_type == "ScatterND" else read
        source = gathered.input[0]
        if source not in rounded:  # two blocks may read the same features
            rounded[source] = add_rounded(body_of(made_by[source]), block)
            made_by[source].output.append(rounded[source])
        gathered.input[0] = rounded[source]
        keep_absent(graph, read, block)
        replace_layers(scan, block)


def body_of(scan: onnx.NodeProto) -> onnx.GraphProto:
    """Return the graph that a Scan runs for each chunk."""
    return next(attribute.g for attribute in scan.attribute if attribute.name == "body")


def add_rounded(body: onnx.GraphProto, block: IntBlock) -> str:
    """Let a body return its features rounded, too, for the next block; return their name.

    Rounded here they are still in cache.
    """
    features = body.output[0]
    writer = IntWriter(f"{body.name}_rounded_")
    step, zero = writer.constant(block.step, "step"), writer.constant(block.zero, "zero")
    rounded = writer.op("QuantizeLinear", features.name, step, zero)
    body.node.extend(writer.nodes)
    body.initializer.extend(writer.constants)
    body.output.append(rows_of(rounded, TensorProto.UINT8, len(block.reduce.scales)))
    return f"{rounded}_chunks"


def keep_absent(graph: onnx.GraphProto, read: onnx.NodeProto, block: IntBlock) -> None:
    """Set the last row that a block reads, which index -1 refers to, to the zero point."""
    name, width = read.output[0], len(block.reduce.scales)
    writer = IntWriter(f"{read.name}_absent_")
    read.output[0] = f"{name}_written"
    row = writer.constant(np.full((1, width), block.zero))
    writer.op("ScatterND", read.output[0], writer.constant(np.array([[-1]])), row)
    writer.nodes[0].output[0] = name
    graph.node.insert(list(graph.node).index(read) + 1, writer.nodes[0])
    graph.initializer.extend(writer.constants)
    # one shape for both names, so that onnxruntime changes the array in place
    for value in (f"{name}_written", name):
        graph.value_info.append(declared(value, TensorProto.UINT8, ["padded", width]))


def replace_layers(scan: onnx.NodeProto, block: IntBlock) -> None:
    """Replace the layers of a block by integer ones, without the mask of the padding."""
    body = body_of(scan)
    table, gather, reshape, *_, kept, added = body.node
    shape = next(array for array in body.initializer if array.name == reshape.input[1])
    writer = IntWriter(f"{body.name}_int8_")
    value = reshape.output[0]
    for label, layer in (("conv", block.conv), ("expand", block.expand)):
        value = writer.quantize(writer.layer(value, layer, label))
    writer.layer(value, block.reduce, "reduce")
    writer.nodes[-1].output[0] = kept.output[0]
    nodes = [table, gather, reshape, *writer.nodes, added]
    constants = [shape, *writer.constants]
    del body.node[:], body.initializer[:]
    body.node.extend(nodes)
    body.initializer.extend(constants)
    del scan.input[2], body.input[2]
    next(a for a in scan.attribute if a.name == "num_scan_inputs").i = 2
