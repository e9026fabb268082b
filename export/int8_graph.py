"""Blocks in whole numbers, in place of those of an exported graph.

Standard operators only, in the pairs that onnxruntime turns into one: dequantize, multiply,
rectify, quantize. What is gathered is bytes, a quarter of the memory. Sums of whole numbers are
exact in any order, so a voxel's values depend on nothing but its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import onnx
from onnx import helper, numpy_helper

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


class Writer:
    """Nodes and constants in the making, with a prefix; every method returns a value's name."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def op(self, kind: str, *inputs: str, **attributes: int) -> str:
        """Add a node with one output."""
        name = f"{self.prefix}{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [name], name=name, **attributes))
        return name

    def constant(self, array: np.ndarray, label: str) -> str:
        """Add a constant."""
        name = f"{self.prefix}{label}"
        self.constants.append(numpy_helper.from_array(np.asarray(array), name))
        return name

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
    scans = [node for node in graph.node if node.op_type == "Scan"][: len(blocks)]  # then the head
    graph.initializer.append(numpy_helper.from_array(np.float32(1), ONE))
    graph.initializer.append(numpy_helper.from_array(np.uint8(0), NONE))
    for scan, block in zip(scans, blocks, strict=True):
        body = next(attribute.g for attribute in scan.attribute if attribute.name == "body")
        replace_padding(graph, body.node[0].input[0], block)
        replace_body(body, block)


def replace_padding(graph: onnx.GraphProto, padded: str, block: IntBlock) -> None:
    """Round the features before the row of absent neighbours, which is exactly zero, is added."""
    number, concat = next((n, node) for n, node in enumerate(graph.node) if padded in node.output)
    writer = Writer(f"{padded}_")
    scaled = writer.op("Mul", concat.input[0], writer.constant(1 / block.steps, "rates"))
    moved = writer.op("Add", scaled, writer.constant(block.zeros.astype(np.float32), "zeros"))
    absent = writer.constant(block.zeros[None], "absent")
    float_zeros = next(array for array in graph.initializer if array.name == concat.input[1])
    graph.initializer.remove(float_zeros)
    del concat.input[:]
    concat.input.extend([writer.quantize(moved), absent])
    for node in reversed(writer.nodes):
        graph.node.insert(number, node)
    graph.initializer.extend(writer.constants)


def replace_body(body: onnx.GraphProto, block: IntBlock) -> None:
    """Keep how neighbours are gathered, and do the rest in whole numbers."""
    gather, reshape = body.node[:2]
    shape = next(array for array in body.initializer if array.name == reshape.input[1])
    writer = Writer(f"{body.name}_int8_")
    value = reshape.output[0]
    for label, layer in (("conv", block.conv), ("expand", block.expand)):
        value = writer.quantize(writer.op("Relu", writer.layer(value, layer, label)))
    writer.layer(value, block.reduce, "reduce")
    writer.nodes[-1].output[0] = body.output[0].name
    kept = [gather, reshape, *writer.nodes]
    constants = [shape, *writer.constants]
    del body.node[:], body.initializer[:]
    body.node.extend(kept)
    body.initializer.extend(constants)
