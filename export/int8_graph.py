"""Replace the blocks of an exported graph by blocks in integer arithmetic.

Only standard operators are used, in the sequence that onnxruntime fuses: dequantize, multiply,
rectify, quantize. The gathered features are bytes, a quarter of the memory. Integer sums are exact
in any order, so the values of a voxel depend only on its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import onnx
from onnx import numpy_helper

from export.writer import Writer

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
    """A residual block. Its features f are quantized as ``f / steps + zeros``, from 0 to 255."""

    steps: np.ndarray  # (C,) float32
    zeros: np.ndarray  # (C,) uint8
    conv: IntLayer
    expand: IntLayer
    reduce: IntLayer


class IntWriter(Writer):
    """A part of the graph, with integer layers."""

    def quantize(self, value: str) -> str:
        """Round to 0..255, saturating."""
        return self.op("QuantizeLinear", value, ONE, NONE)

    def layer(self, value: str, layer: IntLayer, label: str) -> str:
        """Add an integer linear layer."""
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
    graph.initializer.append(numpy_helper.from_array(np.float32(1), ONE))
    graph.initializer.append(numpy_helper.from_array(np.uint8(0), NONE))
    for scan, block in zip(scans[1:-1], blocks, strict=True):  # between stem and head
        body = next(attribute.g for attribute in scan.attribute if attribute.name == "body")
        round_features(graph, body, block)
        replace_layers(body, block)


def round_features(graph: onnx.GraphProto, body: onnx.GraphProto, block: IntBlock) -> None:
    """Let a block gather quantized features; absent ones, exactly 0, become its zero points."""
    gather = body.node[1]  # body.node[0] gathers the table
    features = gather.input[0]
    writer = IntWriter(f"{body.name}_features_")
    scaled = writer.op("Mul", features, writer.constant(1 / block.steps, "rates"))
    moved = writer.op("Add", scaled, writer.constant(block.zeros.astype(np.float32), "zeros"))
    gather.input[0] = writer.quantize(moved)
    number = next(n for n, node in enumerate(graph.node) if features in node.output)
    for node in reversed(writer.nodes):
        graph.node.insert(number + 1, node)
    graph.initializer.extend(writer.constants)


def replace_layers(body: onnx.GraphProto, block: IntBlock) -> None:
    """Replace the layers of a block by integer ones; gathering and the residual sum stay."""
    table, gather, reshape, *layers, kept, added = body.node
    shape = next(array for array in body.initializer if array.name == reshape.input[1])
    writer = IntWriter(f"{body.name}_int8_")
    value = reshape.output[0]
    for label, layer in (("conv", block.conv), ("expand", block.expand)):
        value = writer.quantize(writer.op("Relu", writer.layer(value, layer, label)))
    writer.layer(value, block.reduce, "reduce")
    writer.nodes[-1].output[0] = layers[-1].output[0]
    nodes = [table, gather, reshape, *writer.nodes, kept, added]
    constants = [shape, *writer.constants]
    del body.node[:], body.initializer[:]
    body.node.extend(nodes)
    body.initializer.extend(constants)
