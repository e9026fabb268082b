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

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from export.network import SuperSdfNet
from export.writer import Writer
from super_sdf.neighbourhood import CENTRE
from super_sdf.network.onnx import CHUNK_INPUT
from super_sdf.steps.band import DECODE_LIMIT, MAX_DIFFERENCE

CHUNK = 512  # voxels at a time; on a CPU 256 to 2048 differ by a few percent
EARLY = "_early"  # the block for voxels that go no deeper
THRESHOLD = "gate.threshold"  # an input with a default, like the chunk


class Graph(Writer):
    """A part of the graph, with parameters and layers of the network."""

    def __init__(self, net: SuperSdfNet, prefix: str = "") -> None:
        super().__init__(prefix)
        named = [*net.named_parameters(), *net.named_buffers()]
        self.names = {id(tensor): name for name, tensor in named}

    def integers(self, *numbers: int) -> str:
        """Add an int64 constant."""
        return self.constant(np.array(numbers, np.int64))

    def parameter(self, tensor: torch.Tensor, *, transposed: bool = False) -> str:
        """Add a parameter under its name in the network, by which ``read_weights`` finds it."""
        array = tensor.detach().numpy()
        name = self.names[id(tensor)]
        self.constants.append(
            numpy_helper.from_array(array.T.copy() if transposed else array, name)
        )
        return name

    def layer(self, value: str, layer: torch.nn.Linear) -> str:
        """Add a linear layer (torch keeps its weight transposed)."""
        product = self.op("MatMul", value, self.parameter(layer.weight, transposed=True))
        return self.op("Add", product, self.parameter(layer.bias))

    def relu(self, value: str) -> str:
        """Add a rectifier."""
        return self.op("Relu", value)

    def silu(self, value: str) -> str:
        """Add ``x sigmoid(x)``."""
        return self.op("Mul", value, self.op("Sigmoid", value))


def build_graph(net: SuperSdfNet) -> onnx.GraphProto:
    """Build the graph of the network."""
    graph = Graph(net)
    rows = graph.op("Shape", "patches", start=0, end=1)
    numbers, there = chunked_voxels(graph, rows)
    features, excess = scan_stem(graph, net, numbers, there)
    channels, first = net.config.channels, len(net.blocks) - net.config.gated
    for number in range(first):
        everywhere = flat(graph, features, channels)
        features = scan_block(graph, net, number, features, everywhere, numbers, there)
    if net.config.gated:
        first, everywhere = features, flat(graph, features, channels)
        early = scan_block(graph, net, EARLY, first, everywhere, numbers, there)
        features = deepen(graph, net, first, flat(graph, early, channels), rows)
    else:
        features = flat(graph, features, channels)
    per_offset = graph.op("Concat", trunk(graph, net), interpolation(graph), axis=1)
    transposed = graph.op("Transpose", per_offset, perm=[1, 0])
    scan_head(graph, net, features, excess, transposed)
    graph.constants.append(numpy_helper.from_array(np.array([CHUNK], np.int64), CHUNK_INPUT))
    given = inputs()
    if net.config.gated:
        given.append(helper.make_tensor_value_info(THRESHOLD, TensorProto.FLOAT, [1]))
    return helper.make_graph(graph.nodes, "super_sdf", given, [output()], graph.constants)


def inputs() -> list[onnx.ValueInfoProto]:
    """Return the declared inputs of every network; the last has a default."""
    return [
        helper.make_tensor_value_info("patches", TensorProto.FLOAT, ["V", 27]),
        helper.make_tensor_value_info("neighbours", TensorProto.INT32, ["V", 27]),
        helper.make_tensor_value_info("voxels", TensorProto.INT32, ["D"]),
        helper.make_tensor_value_info("offsets", TensorProto.FLOAT, ["Q", 3]),
        helper.make_tensor_value_info(CHUNK_INPUT, TensorProto.INT64, [1]),
    ]


def output() -> onnx.ValueInfoProto:
    """Return the declared output."""
    return helper.make_tensor_value_info("values", TensorProto.FLOAT, ["D", "Q"])


def fill_up(graph: Graph, count: str, size: str) -> str:
    """Return the number of rows to pad to whole chunks, from 1 to a chunk."""
    return graph.op("Sub", size, graph.op("Mod", count, size))


def chunked_voxels(graph: Graph, rows: str) -> tuple[str, str]:
    """Return the indices of the voxels, (n, chunk), and a mask of 1 and 0, (n, chunk, 1).

    Padding has the index of the last voxel and mask 0.
    """
    zero, one = (graph.constant(np.array(number, np.int64)) for number in (0, 1))
    count = graph.op("Squeeze", rows)
    end = graph.op("Squeeze", graph.op("Add", rows, fill_up(graph, rows, CHUNK_INPUT)))
    return in_chunks(graph, graph.op("Range", zero, end, one), count)


def in_chunks(graph: Graph, numbers: str, count: str) -> tuple[str, str]:
    """Return indices of voxels in chunks, and a mask: see ``chunked_voxels``."""
    there = graph.op("Cast", graph.op("Less", numbers, count), to=TensorProto.FLOAT)
    last = graph.op("Sub", count, graph.constant(np.array(1, np.int64)))
    shape = graph.op("Concat", graph.integers(-1), CHUNK_INPUT, axis=0)
    column = graph.op("Concat", shape, graph.integers(1), axis=0)
    present = graph.op("Reshape", graph.op("Min", numbers, last), shape)
    return present, graph.op("Reshape", there, column)


def flat(graph: Graph, chunks: str, *width: int) -> str:
    """Return chunks as one array, with the padding at its end."""
    return graph.op("Reshape", chunks, graph.integers(-1, *width))


def rows_of(name: str, kind: int, *width: int | str) -> onnx.ValueInfoProto:
    """Declare a chunk of rows, in the body of a Scan."""
    return helper.make_tensor_value_info(name, kind, ["rows", *width])


def scan_stem(graph: Graph, net: SuperSdfNet, numbers: str, there: str) -> tuple[str, str]:
    """Add the stem; return features (n, chunk, C) and excess (n chunk, 1).

    The excess, by which samples differ by more than distances can, is for ``noisy_voxels``.
    """
    body, channels = Graph(net, "stem_"), net.config.channels
    patch = body.op("Gather", "patches", "some", axis=0)
    made = body.layer(body.relu(body.layer(patch, net.stem[0])), net.stem[2])
    features = body.op("Mul", made, "there")
    centre = body.op("Gather", patch, body.integers(CENTRE), axis=1)
    apart = body.op("Abs", body.op("Sub", patch, centre))
    beyond = body.op("Sub", apart, body.constant(MAX_DIFFERENCE))
    most = body.op("ReduceMax", beyond, body.integers(1), keepdims=1)
    excess = body.op("Mul", most, "there")
    given = [rows_of("some", TensorProto.INT64), rows_of("there", TensorProto.FLOAT, 1)]
    results = [
        rows_of(features, TensorProto.FLOAT, channels),
        rows_of(excess, TensorProto.FLOAT, 1),
    ]
    subgraph = helper.make_graph(body.nodes, "stem", given, results, body.constants)
    names = ["stem_features", "stem_excess"]
    graph.nodes.append(
        helper.make_node("Scan", [numbers, there], names, body=subgraph, num_scan_inputs=2)
    )
    return names[0], flat(graph, names[1])


def scan_block(
    graph: Graph,
    net: SuperSdfNet,
    number: int | str,
    features: str,
    everywhere: str,
    numbers: str,
    there: str,
) -> str:
    """Add a residual block on chunks of voxels; return their features (n, chunk, C).

    Their neighbours' are gathered from those of all voxels, ``everywhere``.
    """
    block = net.early if number == EARLY else net.blocks[number]
    channels = net.config.channels
    body = Graph(net, f"block{number}_")
    table = body.op("Gather", "neighbours", "some", axis=0)
    gathered = body.op("Gather", everywhere, table, axis=0)
    columns = body.op("Reshape", gathered, body.integers(-1, 27 * channels))
    product = body.op("MatMul", columns, body.parameter(block.conv.weight))
    mixed = body.relu(body.op("Add", product, body.parameter(block.conv.bias)))
    change = body.layer(body.relu(body.layer(mixed, block.expand)), block.reduce)
    result = body.op("Add", "features_of_some", body.op("Mul", change, "there"))
    given = [
        rows_of("some", TensorProto.INT64),
        rows_of("features_of_some", TensorProto.FLOAT, channels),
        rows_of("there", TensorProto.FLOAT, 1),
    ]
    results = [rows_of(result, TensorProto.FLOAT, channels)]
    subgraph = helper.make_graph(body.nodes, f"block{number}", given, results, body.constants)
    return graph.op("Scan", numbers, features, there, body=subgraph, num_scan_inputs=3)


def deepen(graph: Graph, net: SuperSdfNet, first: str, early: str, rows: str) -> str:
    """Add the blocks that run where the gate is open; return the features of all voxels (N, C).

    They read those after the first blocks and write onto the ``early`` ones.

    Rows are filled up with the last one of the padding, which stays 0.
    """
    channels, blocks = net.config.channels, range(len(net.blocks))[-net.config.gated :]
    features = flat(graph, first, channels)
    open_rows = gate(graph, net, early, rows)
    fill = fill_up(graph, graph.op("Shape", open_rows), CHUNK_INPUT)
    end = graph.op("Sub", graph.op("Shape", features, start=0, end=1), graph.integers(1))
    pads = graph.op("Concat", graph.integers(0), fill, axis=0)
    chosen = graph.op("Pad", open_rows, pads, graph.op("Squeeze", end))
    some, there = in_chunks(graph, chosen, graph.op("Squeeze", rows))
    shape = graph.op("Concat", graph.integers(-1), CHUNK_INPUT, graph.integers(channels), axis=0)
    deep = graph.op("Reshape", graph.op("Gather", features, chosen, axis=0), shape)
    places = graph.op("Unsqueeze", chosen, graph.integers(1))
    everywhere = flat(graph, first, channels)  # of its own, since int8 reads bytes there
    for number in blocks:
        deep = scan_block(graph, net, number, deep, everywhere, some, there)
        onto = early if number == blocks[-1] else everywhere
        everywhere = graph.op("ScatterND", onto, places, flat(graph, deep, channels))
    return everywhere


def gate(graph: Graph, net: SuperSdfNet, features: str, rows: str) -> str:
    """Add the gate, in chunks; return the rows (n,) of the voxels where it is open."""
    channels = net.config.channels
    shape = graph.op("Concat", graph.integers(-1), CHUNK_INPUT, graph.integers(channels), axis=0)
    body, layers = Graph(net, "gate_"), net.gate.layers
    made = body.layer(body.relu(body.layer("features_of_some", layers[0])), layers[2])
    given, result = (
        rows_of(name, TensorProto.FLOAT, width)
        for name, width in (("features_of_some", channels), (made, 1))
    )
    subgraph = helper.make_graph(body.nodes, "gate", [given], [result], body.constants)
    chunks = graph.op("Reshape", features, shape)
    doubts = flat(graph, graph.op("Scan", chunks, body=subgraph, num_scan_inputs=1))
    doubts = graph.op("Slice", doubts, graph.integers(0), rows)
    above = graph.op("Greater", doubts, graph.parameter(net.gate.threshold))
    sample = graph.op("Gather", "patches", graph.constant(np.array(CENTRE, np.int64)), axis=1)
    limit = graph.constant(np.float32(DECODE_LIMIT))
    near = graph.op("LessOrEqual", graph.op("Abs", sample), limit)
    both = graph.op("NonZero", graph.op("And", above, near))
    return graph.op("Squeeze", both, graph.integers(0))


def scan_head(graph: Graph, net: SuperSdfNet, features: str, excess: str, per_offset: str) -> None:
    """Add the head, in chunks of voxels; its result is the output.

    The intermediate array of a voxel is five times as large as its features. A chunk has at least
    as many rows as there are offsets: with fewer, sums would depend on the number of threads.
    """
    count, offsets = (graph.op("Shape", name, start=0, end=1) for name in ("voxels", "offsets"))
    size = graph.op("Max", CHUNK_INPUT, offsets)
    pads = graph.op("Concat", graph.integers(0), fill_up(graph, count, size), axis=0)
    filled = graph.op("Pad", "voxels", pads, graph.constant(np.array(0, np.int32)))
    chunks = graph.op("Reshape", filled, graph.op("Concat", graph.integers(-1), size, axis=0))
    subgraph = head_body(net, features, excess, per_offset)
    stacked = graph.op("Scan", chunks, body=subgraph, num_scan_inputs=1)
    whole = graph.op("Reshape", stacked, graph.op("Concat", graph.integers(-1), offsets, axis=0))
    ends = [whole, graph.integers(0), count, graph.integers(0)]
    graph.nodes.append(helper.make_node("Slice", ends, ["values"]))


def head_body(net: SuperSdfNet, features: str, excess: str, per_offset: str) -> onnx.GraphProto:
    """Return the head for a chunk of voxels: coefficients times functions, plus correction."""
    body = Graph(net, "head_")
    chosen = body.op("Gather", features, "some", axis=0)
    branch = body.relu(body.layer(chosen, net.branch))
    patches = body.op("Gather", "patches", "some", axis=0)
    per_voxel = body.op("Concat", chosen, branch, patches, axis=1)
    kept = body.op("MatMul", per_voxel, per_offset)
    correction = body.layer(chosen, net.correction)
    if net.config.keeps_samples:
        correction = body.op("Mul", correction, noisy_voxels(body, excess))
    values = body.op("Add", kept, correction)
    given, made = rows_of("some", TensorProto.INT32), rows_of(values, TensorProto.FLOAT, "Q")
    return helper.make_graph(body.nodes, "head", [given], [made], body.constants)


def noisy_voxels(body: Graph, excess: str) -> str:
    """Add a mask, (n, 1) of 0 and 1, of the noisy voxels of a chunk: see ``network.is_noisy``."""
    table = body.op("Gather", "neighbours", "some", axis=0)
    around = body.op("Gather", excess, table, axis=0)
    worst = body.op("ReduceMax", around, body.integers(1), keepdims=1)
    above = body.op("Greater", worst, body.constant(np.float32(0)))
    return body.op("Cast", above, to=TensorProto.FLOAT)


def trunk(graph: Graph, net: SuperSdfNet) -> str:
    """Add the functions of the offset, (Q, functions)."""
    origin = torch.zeros(1, 3)
    at_sample = graph.constant(net.trunk.raw(origin).detach().numpy())
    waves = graph.constant(net.trunk.waves.numpy())
    angles = graph.op("Mul", graph.op("Unsqueeze", "offsets", graph.integers(2)), waves)
    flat = graph.op("Flatten", angles, axis=1)
    value = graph.op("Concat", "offsets", graph.op("Sin", flat), graph.op("Cos", flat), axis=1)
    first, _, second, _, last = net.trunk.layers
    value = graph.silu(graph.layer(value, first))
    value = graph.silu(graph.layer(value, second))
    functions = graph.op("Sub", graph.layer(value, last), at_sample)
    # Exactly 0 at the sample, however that was rounded: samples that are 0 must stay 0.
    length = graph.op("ReduceMax", graph.op("Abs", "offsets"), graph.integers(1), keepdims=1)
    elsewhere = graph.op("Greater", length, graph.constant(np.float32(0)))
    return graph.op("Mul", functions, graph.op("Cast", elsewhere, to=TensorProto.FLOAT))


def interpolation(graph: Graph) -> str:
    """Add the weights (Q, 27) of quadratic interpolation: see network.interpolation_weights."""
    at = graph.op("Mul", "offsets", graph.constant(np.float32(0.5)))
    half = graph.op("Mul", at, graph.constant(np.float32(0.5)))
    square = graph.op("Mul", at, at)
    half_square = graph.op("Mul", square, graph.constant(np.float32(0.5)))
    below = graph.op("Sub", half_square, half)
    middle = graph.op("Sub", graph.constant(np.float32(1)), square)
    above = graph.op("Add", half_square, half)
    axis = graph.integers(2)
    parts = [graph.op("Unsqueeze", part, axis) for part in (below, middle, above)]
    weights = graph.op("Concat", *parts, axis=2)  # (Q, 3, 3)
    x, y, z = (
        graph.op("Gather", weights, graph.constant(np.array(n, np.int64)), axis=1) for n in range(3)
    )
    x = graph.op("Unsqueeze", x, graph.integers(2, 3))
    y = graph.op("Unsqueeze", y, graph.integers(1, 3))
    z = graph.op("Unsqueeze", z, graph.integers(1, 2))
    return graph.op("Flatten", graph.op("Mul", graph.op("Mul", x, y), z), axis=1)
