"""The network as an ONNX graph.

It is built by hand because no exporter does this: every layer runs as a Scan over chunks of voxels.
Gathered rows are 27 times as large as the features; in chunks they stay in cache and need hardly
any memory. The voxels are padded to whole chunks, by at least one absent voxel, whose features are
kept at 0: index -1 of the neighbour table refers to the last of them. So a block reads one array of
features and writes the next, and there is no other array of that size. Only standard operators are
used.

The last blocks of a gated network get their voxels from NonZero. Their features stand in an array
of their own and, for the next block to gather, in a copy of all features.

A chunk that fits a processor's cache is too small for a GPU. So its size is an initializer that is
also an input, which the runtime may override.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from export.network import PLACES, SuperSdfNet
from super_sdf.arrays import CENTRE
from super_sdf.network import onnx as sessions
from super_sdf.refine import band

CHUNK_INPUT = sessions.CHUNK_INPUT
CHUNK = 512  # voxels at a time; the runtime chooses its own, see ``CPU_CHUNK``
EARLY = "_early"  # the block for voxels that go no deeper
THRESHOLD = "gate.threshold"  # an input with a default, like the chunk


class Writer:
    """Nodes and constants with prefixed names; every method returns the name of a value."""

    def __init__(self, prefix: str = "") -> None:
        self.prefix = prefix
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def op(self, kind: str, *inputs: str, **attributes: Any) -> str:
        name = f"{self.prefix}{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [name], name=name, **attributes))
        return name

    def constant(self, array: Any, label: str | None = None) -> str:
        name = f"{self.prefix}{label or f'constant_{len(self.constants)}'}"
        self.constants.append(numpy_helper.from_array(np.asarray(array), name))
        return name


class Graph(Writer):
    """A part of the graph, with parameters and layers of the network."""

    def __init__(self, net: SuperSdfNet, prefix: str = "") -> None:
        super().__init__(prefix)
        self.net, self.channels = net, net.config.channels
        named = [*net.named_parameters(), *net.named_buffers()]
        self.names = {id(tensor): name for name, tensor in named}
        self.tables = {27: "neighbours"}  # by the number of places of its rows

    def whole(self, number: int) -> str:
        return self.constant(np.array(number, np.int64))

    def wholes(self, *numbers: int) -> str:
        return self.constant(np.array(numbers, np.int64))

    def real(self, number: float) -> str:
        return self.constant(np.float32(number))

    def parameter(self, tensor: torch.Tensor, *, transposed: bool = False) -> str:
        """Add a parameter under its name in the network, by which ``read_weights`` finds it."""
        array, name = tensor.detach().numpy(), self.names[id(tensor)]
        array = array.T.copy() if transposed else array
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def layer(self, value: str, layer: torch.nn.Linear) -> str:
        product = self.op("MatMul", value, self.parameter(layer.weight, transposed=True))
        return self.op("Add", product, self.parameter(layer.bias))

    def two_layers(self, value: str, first: torch.nn.Linear, second: torch.nn.Linear) -> str:
        return self.layer(self.op("Relu", self.layer(value, first)), second)

    def silu(self, value: str) -> str:
        return self.op("Mul", value, self.op("Sigmoid", value))

    def flat(self, chunks: str, width: int) -> str:
        """Return chunks as one array, with the padding at its end."""
        return self.op("Reshape", chunks, self.wholes(-1, width))

    def in_chunks(self, rows: str) -> str:
        """Return features (N, C) in chunks, (n, chunk, C)."""
        shape = self.op("Concat", self.wholes(-1), CHUNK_INPUT, self.wholes(self.channels), axis=0)
        return self.op("Reshape", rows, shape)

    def scan(
        self, body: Graph, name: str, given: dict[str, Declared], results: list[Declared]
    ) -> list[str]:
        """Run a body on every chunk of the values ``given``; return the names of its results."""
        inputs = list(given.values())
        graph = helper.make_graph(body.nodes, name, inputs, results, body.constants)
        names = [f"{name}_{number}" for number in range(len(results))]
        scan = helper.make_node("Scan", list(given), names, body=graph, num_scan_inputs=len(given))
        self.nodes.append(scan)
        return names


Declared = onnx.ValueInfoProto
declared = helper.make_tensor_value_info


def rows_of(name: str, kind: int, *width: int | str) -> Declared:
    """Declare a chunk of rows, in the body of a Scan."""
    return declared(name, kind, ["rows", *width])


def build_graph(net: SuperSdfNet) -> onnx.GraphProto:
    graph = Graph(net)
    rows = graph.op("Shape", "patches", start=0, end=1)
    end = graph.op("Squeeze", graph.op("Add", rows, fill_up(graph, rows, CHUNK_INPUT)))
    numbers = graph.op("Range", graph.whole(0), end, graph.whole(1))
    numbers, there = masked_chunks(graph, numbers, graph.op("Squeeze", rows))
    for count in sorted({block.conv.places for block in net.all_blocks()} - {27}):
        columns = graph.wholes(*PLACES[count])
        graph.tables[count] = graph.op("Gather", "neighbours", columns, axis=1)
    features, excess = scan_stem(graph, numbers, there)
    channels, gated = net.config.channels, net.config.gated
    for number in range(len(net.blocks) - gated):
        seen = net.blocks[number].conv.seen
        everywhere = graph.flat(first_channels(graph, features, seen, channels), seen)
        features = scan_block(graph, number, features, everywhere, numbers, there)
    whole = graph.flat(features, channels)
    if gated:
        early = scan_block(graph, EARLY, features, whole, numbers, there)
        whole = deepen(graph, features, graph.flat(early, channels), rows)
    per_offset = graph.op("Concat", trunk(graph), interpolation(graph), axis=1)
    scan_head(graph, whole, excess, graph.op("Transpose", per_offset, perm=[1, 0]))
    graph.constants.append(numpy_helper.from_array(np.array([CHUNK], np.int64), CHUNK_INPUT))
    inputs = [
        declared("patches", TensorProto.FLOAT, ["V", 27 + net.config.wide]),
        declared("neighbours", TensorProto.INT32, ["V", 27]),
        declared("voxels", TensorProto.INT32, ["D"]),
        declared("offsets", TensorProto.FLOAT, ["Q", 3]),
        declared(CHUNK_INPUT, TensorProto.INT64, [1]),  # has a default, and so has the threshold
        *([declared(THRESHOLD, TensorProto.FLOAT, [1])] if gated else []),
    ]
    outputs = [declared("values", TensorProto.FLOAT, ["D", "Q"])]
    return helper.make_graph(graph.nodes, "super_sdf", inputs, outputs, graph.constants)


def first_channels(graph: Writer, features: str, count: int, channels: int) -> str:
    """Return the first ones of the channels of features (..., C)."""
    if count == channels:
        return features
    ends = (graph.constant(np.array([end], np.int64)) for end in (0, count, -1))
    return graph.op("Slice", features, *ends)


def fill_up(graph: Graph, count: str, size: str) -> str:
    """Return the number of rows to pad to whole chunks, from 1 to a chunk."""
    return graph.op("Sub", size, graph.op("Mod", count, size))


def masked_chunks(graph: Graph, numbers: str, count: str) -> tuple[str, str]:
    """Return indices of voxels, (n, chunk), and a mask of 1 and 0, (n, chunk, 1).

    Numbers from ``count`` on are padding: they have the index of the last voxel and mask 0.
    """
    there = graph.op("Cast", graph.op("Less", numbers, count), to=TensorProto.FLOAT)
    last = graph.op("Sub", count, graph.whole(1))
    shape = graph.op("Concat", graph.wholes(-1), CHUNK_INPUT, axis=0)
    column = graph.op("Concat", shape, graph.wholes(1), axis=0)
    present = graph.op("Reshape", graph.op("Min", numbers, last), shape)
    return present, graph.op("Reshape", there, column)


def samples_of(body: Graph, patches: str) -> str:
    """Return patches without the inputs besides the samples, (n, 27)."""
    if not body.net.config.wide:
        return patches
    return body.op("Slice", patches, body.wholes(0), body.wholes(27), body.wholes(1))


def scan_stem(graph: Graph, numbers: str, there: str) -> tuple[str, str]:
    """Add the stem; return features (n, chunk, C) and excess (n chunk, 1).

    The excess, by which samples differ by more than distances can, is for ``noisy_voxels``.
    """
    body = Graph(graph.net, "stem_")
    patch = body.op("Gather", "patches", "some", axis=0)
    made = body.two_layers(patch, graph.net.stem[0], graph.net.stem[2])
    features, patch = body.op("Mul", made, "there"), samples_of(body, patch)
    centre = body.op("Gather", patch, body.wholes(CENTRE), axis=1)
    apart = body.op("Abs", body.op("Sub", patch, centre))
    beyond = body.op("Sub", apart, body.constant(band.MAX_DIFFERENCE))
    most = body.op("ReduceMax", beyond, body.wholes(1), keepdims=1)
    excess = body.op("Mul", most, "there")
    given = {
        numbers: rows_of("some", TensorProto.INT64),
        there: rows_of("there", TensorProto.FLOAT, 1),
    }
    results = [(features, graph.channels), (excess, 1)]
    made = [rows_of(name, TensorProto.FLOAT, width) for name, width in results]
    features, excess = graph.scan(body, "stem", given, made)
    return features, graph.op("Reshape", excess, graph.wholes(-1))


def scan_block(
    graph: Graph, number: int | str, features: str, everywhere: str, numbers: str, there: str
) -> str:
    """Add a residual block on chunks of voxels; return their features (n, chunk, C).

    Their neighbours' are gathered from those of all voxels, ``everywhere``.
    """
    block = graph.net.early if number == EARLY else graph.net.blocks[number]
    body = Graph(graph.net, f"block{number}_")
    table = body.op("Gather", graph.tables[block.conv.places], "some", axis=0)
    gathered = body.op("Gather", everywhere, table, axis=0)
    columns = body.op("Reshape", gathered, body.wholes(-1, len(block.conv.weight)))
    product = body.op("MatMul", columns, body.parameter(block.conv.weight))
    mixed = body.op("Relu", body.op("Add", product, body.parameter(block.conv.bias)))
    change = body.op("Mul", body.two_layers(mixed, block.expand, block.reduce), "there")
    result = body.op("Add", "features_of_some", change)
    given = {
        numbers: rows_of("some", TensorProto.INT64),
        features: rows_of("features_of_some", TensorProto.FLOAT, graph.channels),
        there: rows_of("there", TensorProto.FLOAT, 1),
    }
    results = [rows_of(result, TensorProto.FLOAT, graph.channels)]
    return graph.scan(body, f"block{number}", given, results)[0]


def deepen(graph: Graph, first: str, early: str, rows: str) -> str:
    """Add the blocks that run where the gate is open; return the features of all voxels (N, C).

    They read those after the first blocks, (n, chunk, C), and write onto the ``early`` ones (N, C).
    Rows are filled up with the last one of the padding, which stays 0.
    """
    channels, blocks = graph.channels, range(len(graph.net.blocks))[-graph.net.config.gated :]
    features, open_rows = graph.flat(first, channels), gate(graph, early, rows)
    fill = fill_up(graph, graph.op("Shape", open_rows), CHUNK_INPUT)
    end = graph.op("Sub", graph.op("Shape", features, start=0, end=1), graph.wholes(1))
    pads = graph.op("Concat", graph.wholes(0), fill, axis=0)
    chosen = graph.op("Pad", open_rows, pads, graph.op("Squeeze", end))
    some, there = masked_chunks(graph, chosen, graph.op("Squeeze", rows))
    deep = graph.in_chunks(graph.op("Gather", features, chosen, axis=0))
    places = graph.op("Unsqueeze", chosen, graph.wholes(1))
    everywhere = graph.flat(first, channels)  # of its own, since int8 reads bytes there
    for number in blocks:
        deep = scan_block(graph, number, deep, everywhere, some, there)
        onto = early if number == blocks[-1] else everywhere
        everywhere = graph.op("ScatterND", onto, places, graph.flat(deep, channels))
    return everywhere


def gate(graph: Graph, features: str, rows: str) -> str:
    """Add the gate, in chunks; return the rows (n,) of the voxels where it is open."""
    body, layers = Graph(graph.net, "gate_"), graph.net.gate.layers
    made = body.two_layers("features_of_some", layers[0], layers[2])
    some = rows_of("features_of_some", TensorProto.FLOAT, graph.channels)
    given, results = {graph.in_chunks(features): some}, [rows_of(made, TensorProto.FLOAT, 1)]
    doubts = graph.op("Reshape", *graph.scan(body, "gate", given, results), graph.wholes(-1))
    doubts = graph.op("Slice", doubts, graph.wholes(0), rows)
    above = graph.op("Greater", doubts, graph.parameter(graph.net.gate.threshold))
    sample = graph.op("Gather", "patches", graph.whole(CENTRE), axis=1)
    near = graph.op("LessOrEqual", graph.op("Abs", sample), graph.real(band.DECODE_LIMIT))
    both = graph.op("NonZero", graph.op("And", above, near))
    return graph.op("Squeeze", both, graph.wholes(0))


def scan_head(graph: Graph, features: str, excess: str, per_offset: str) -> None:
    """Add the head, in chunks of voxels: coefficients times functions, plus correction.

    The intermediate array of a voxel is five times as large as its features. A chunk has at least
    as many rows as there are offsets: with fewer, sums would depend on the number of threads.
    """
    count, offsets = (graph.op("Shape", name, start=0, end=1) for name in ("voxels", "offsets"))
    size = graph.op("Max", CHUNK_INPUT, offsets)
    pads = graph.op("Concat", graph.wholes(0), fill_up(graph, count, size), axis=0)
    filled = graph.op("Pad", "voxels", pads, graph.constant(np.array(0, np.int32)))
    chunks = graph.op("Reshape", filled, graph.op("Concat", graph.wholes(-1), size, axis=0))
    body, net = Graph(graph.net, "head_"), graph.net
    chosen = body.op("Gather", features, "some", axis=0)
    branch = body.op("Relu", body.layer(chosen, net.branch))
    patches = samples_of(body, body.op("Gather", "patches", "some", axis=0))
    kept = body.op("MatMul", body.op("Concat", chosen, branch, patches, axis=1), per_offset)
    correction = body.layer(chosen, net.correction)
    if net.config.keeps_samples:
        correction = body.op("Mul", correction, noisy_voxels(body, excess))
    values = rows_of(body.op("Add", kept, correction), TensorProto.FLOAT, "Q")
    stacked = graph.scan(body, "head", {chunks: rows_of("some", TensorProto.INT32)}, [values])
    whole = graph.op("Reshape", *stacked, graph.op("Concat", graph.wholes(-1), offsets, axis=0))
    ends = [whole, graph.wholes(0), count, graph.wholes(0)]
    graph.nodes.append(helper.make_node("Slice", ends, ["values"]))


def noisy_voxels(body: Graph, excess: str) -> str:
    """Add a mask, (n, 1) of 0 and 1, of the noisy voxels of a chunk: see ``network.is_noisy``."""
    table = body.op("Gather", "neighbours", "some", axis=0)
    around = body.op("Gather", excess, table, axis=0)
    worst = body.op("ReduceMax", around, body.wholes(1), keepdims=1)
    return body.op("Cast", body.op("Greater", worst, body.real(0)), to=TensorProto.FLOAT)


def trunk(graph: Graph) -> str:
    """Add the functions of the offset, (Q, functions)."""
    module = graph.net.trunk
    at_sample = graph.constant(module.raw(torch.zeros(1, 3)).detach().numpy())
    waves = graph.constant(module.waves.numpy())
    angles = graph.op("Mul", graph.op("Unsqueeze", "offsets", graph.wholes(2)), waves)
    flat = graph.op("Flatten", angles, axis=1)
    value = graph.op("Concat", "offsets", graph.op("Sin", flat), graph.op("Cos", flat), axis=1)
    first, _, second, _, last = module.layers
    value = graph.silu(graph.layer(graph.silu(graph.layer(value, first)), second))
    functions = graph.op("Sub", graph.layer(value, last), at_sample)
    # Exactly 0 at the sample, however that was rounded: samples that are 0 must stay 0.
    length = graph.op("ReduceMax", graph.op("Abs", "offsets"), graph.wholes(1), keepdims=1)
    elsewhere = graph.op("Greater", length, graph.real(0))
    return graph.op("Mul", functions, graph.op("Cast", elsewhere, to=TensorProto.FLOAT))


def interpolation(graph: Graph) -> str:
    """Add the weights (Q, 27) of quadratic interpolation: see network.interpolation_weights."""
    at = graph.op("Mul", "offsets", graph.real(0.5))
    half, square = graph.op("Mul", at, graph.real(0.5)), graph.op("Mul", at, at)
    half_square = graph.op("Mul", square, graph.real(0.5))
    middle = graph.op("Sub", graph.real(1), square)
    ends = [graph.op(kind, half_square, half) for kind in ("Sub", "Add")]
    parts = [graph.op("Unsqueeze", p, graph.wholes(2)) for p in (ends[0], middle, ends[1])]
    weights = graph.op("Concat", *parts, axis=2)  # (Q, 3, 3)
    x, y, z = (graph.op("Gather", weights, graph.whole(n), axis=1) for n in range(3))
    x = graph.op("Unsqueeze", x, graph.wholes(2, 3))
    y = graph.op("Unsqueeze", y, graph.wholes(1, 3))
    z = graph.op("Unsqueeze", z, graph.wholes(1, 2))
    return graph.op("Flatten", graph.op("Mul", graph.op("Mul", x, y), z), axis=1)
