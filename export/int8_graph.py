"""Blocks in whole numbers, in place of those of an exported graph.

Standard operators only, in the pairs that onnxruntime turns into one: dequantize, multiply,
rectify, quantize. What is gathered is bytes, a quarter of the memory. Sums of whole numbers are
exact in any order, so a voxel's values depend on nothing but its neighbours.
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
    """A linear layer: ``(values @ weight + bias) * scales``, values whole from 0 to 255."""

    weight: np.ndarray  # (K, n) int8
    scales: np.ndarray  # (n,) float32
    bias: np.ndarray  # (n,) int32


@dataclass(frozen=True, eq=False)
class IntBlock:
    """A residual block. Features f are read as ``f / steps + zeros``, rounded, from 0 to 255."""

    steps: np.ndarray  # (C,) float32
    zeros: np.ndarray  # (C,) uint8
    conv: IntLayer
    expand: IntLayer
    reduce: IntLayer


class IntWriter(Writer):
    """A part of the graph, with layers on whole numbers."""

    def quantize(self, value: str) -> str:
        """Round to 0 to 255; what is below or above is cut off."""
        return self.op("QuantizeLinear", value, ONE, NONE)

    def layer(self, value: str, layer: IntLayer, label: str) -> str:
        """Add a linear layer on whole numbers."""
        scales = self.constant(layer.scales, f"{label}.scales")
        operands = [self.op("DequantizeLinear", value, ONE, NONE)]
        # onnxruntime joins the four only where the zeros, all 0, are written out
        for name, array, axis in (("weight", layer.weight, 1), ("bias", layer.bias, 0)):
            zeros = self.constant(np.zeros(len(layer.scales), array.dtype), f"{label}.{name}_zeros")
            whole = self.constant(array, f"{label}.{name}")
            operands.append(self.op("DequantizeLinear", whole, scales, zeros, axis=axis))
        return self.op("Gemm", *operands)


def replace_blocks(graph: onnx.GraphProto, blocks: list[IntBlock]) -> None:
    """Put the blocks in the place of a graph's own, the Scan nodes in their order."""
    scans = [node for node in graph.node if node.op_type == "Scan"]
    graph.initializer.append(numpy_helper.from_array(np.float32(1), ONE))
    graph.initializer.append(numpy_helper.from_array(np.uint8(0), NONE))
    for scan, block in zip(scans[1:-1], blocks, strict=True):  # between stem and head
        body = next(attribute.g for attribute in scan.attribute if attribute.name == "body")
        round_features(graph, body, block)
        replace_layers(body, block)


def round_features(graph: onnx.GraphProto, body: onnx.GraphProto, block: IntBlock) -> None:
    """Let a block gather rounded features: absent ones, exactly zero, become the block's zeros."""
    gather = body.node[1]  # after that of the table
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
    """Keep how a block gathers neighbours and adds its change; make the change in whole numbers."""
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
