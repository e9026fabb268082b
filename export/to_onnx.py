"""Write a trained network as the ONNX file that the runtime loads, and check that they agree.

    python -m export.to_onnx --run training/run --out models/base.onnx --data "..." --accuracy "..."
    python -m export.to_onnx --from models/base.onnx --out models/base.onnx

The second writes a file's weights and card anew in the graph of today, and keeps it only if it
gives the same values, bit for bit.

The graph is written by hand because of one thing an exporter would not do: each neighbour
convolution runs as a Scan over chunks of the neighbour table. Gathered rows are 27 times as large
as the features; chunk by chunk they stay in cache and need no memory to speak of. Standard
operators only.

A chunk that suits a processor's cache keeps a GPU waiting for the next one. So its size is an
initializer that is an input as well: who runs the file may override it.
"""

from __future__ import annotations

import argparse
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from export.network import NetworkConfig, SuperSdfNet
from super_sdf.band import CENTRE, REACH, find_band, gather_patches, neighbour_table
from super_sdf.device import CHUNK_INPUT
from super_sdf.network import FORMAT_VERSION, load_network
from super_sdf.nodes import block_offsets

OPSET = 18
CHUNK = 512  # rows of the neighbour table at a time; 256 to 2048 differ by a few percent on a CPU
PARITY = 2e-4  # half voxels: 1e-4 of a voxel


class Graph:
    """Nodes and constants of an ONNX graph in the making; every method returns a value's name."""

    def __init__(self, net: SuperSdfNet, prefix: str = "") -> None:
        self.prefix = prefix
        self.names = {id(tensor): name for name, tensor in net.named_parameters()}
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def op(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """Add a node with one output."""
        name = f"{self.prefix}{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [name], name=name, **attributes))
        return name

    def constant(self, array: Any) -> str:
        """Add a constant."""
        name = f"{self.prefix}constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(array), name))
        return name

    def integers(self, *numbers: int) -> str:
        """Add a constant of int64."""
        return self.constant(np.array(numbers, np.int64))

    def parameter(self, tensor: torch.Tensor, *, transposed: bool = False) -> str:
        """Add a parameter of the network, under its name there: ``read_weights`` finds it so."""
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
    """Write the network as a graph."""
    graph = Graph(net)
    features = graph.layer(graph.relu(graph.layer("patches", net.stem[0])), net.stem[2])
    rows = graph.op("Shape", "patches", start=0, end=1)
    chunks = chunked_table(graph, rows)
    for number in range(len(net.blocks)):
        change = scan_block(graph, net, number, features, chunks, rows)
        features = graph.op("Add", features, change)
    per_offset = graph.op("Concat", trunk(graph, net), interpolation(graph), axis=1)
    transposed = graph.op("Transpose", per_offset, perm=[1, 0])
    scan_head(graph, net, features, transposed)
    graph.constants.append(numpy_helper.from_array(np.array([CHUNK], np.int64), CHUNK_INPUT))
    return helper.make_graph(graph.nodes, "super_sdf", inputs(), [output()], graph.constants)


def inputs() -> list[onnx.ValueInfoProto]:
    """Return the declared inputs; the last has a default."""
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


def chunked_table(graph: Graph, rows: str) -> str:
    """Fill the neighbour table up with absent rows and cut it into (n, chunk, 27)."""
    partial = graph.op("Mod", rows, CHUNK_INPUT)
    missing = graph.op("Sub", CHUNK_INPUT, partial)  # 1 to a chunk: one row is spare
    pads = graph.op("Concat", graph.integers(0, 0), missing, graph.integers(0), axis=0)
    absent = graph.constant(np.array(-1, np.int32))
    filled = graph.op("Pad", "neighbours", pads, absent)
    shape = graph.op("Concat", graph.integers(-1), CHUNK_INPUT, graph.integers(27), axis=0)
    return graph.op("Reshape", filled, shape)


def scan_block(
    graph: Graph, net: SuperSdfNet, number: int, features: str, chunks: str, rows: str
) -> str:
    """Add a residual block without its sum, chunk by chunk; return (V, C)."""
    block, channels = net.blocks[number], net.config.channels
    zeros = graph.constant(np.zeros((1, channels), np.float32))
    padded = graph.op("Concat", features, zeros, axis=0)  # index -1 is the row of zeros
    body = Graph(net, f"block{number}_")
    gathered = body.op("Gather", padded, "chunk", axis=0)
    columns = body.op("Reshape", gathered, body.integers(-1, 27 * channels))
    product = body.op("MatMul", columns, body.parameter(block.conv.weight))
    mixed = body.relu(body.op("Add", product, body.parameter(block.conv.bias)))
    reduced = body.layer(body.relu(body.layer(mixed, block.expand)), block.reduce)
    subgraph = helper.make_graph(
        body.nodes,
        f"block{number}",
        [helper.make_tensor_value_info("chunk", TensorProto.INT32, ["rows", 27])],
        [helper.make_tensor_value_info(reduced, TensorProto.FLOAT, ["rows", channels])],
        body.constants,
    )
    stacked = graph.op("Scan", chunks, body=subgraph, num_scan_inputs=1)
    flat = graph.op("Reshape", stacked, graph.integers(-1, channels))
    return graph.op("Slice", flat, graph.integers(0), rows, graph.integers(0))


def scan_head(graph: Graph, net: SuperSdfNet, features: str, per_offset: str) -> None:
    """Add the head, chunk by chunk of the voxels; its result is the output.

    What it makes for each voxel is five times as large as the features. A chunk has at least as
    many rows as there are offsets: of fewer, sums would depend on the number of threads.
    """
    count, offsets = (graph.op("Shape", name, start=0, end=1) for name in ("voxels", "offsets"))
    size = graph.op("Max", CHUNK_INPUT, offsets)
    missing = graph.op("Sub", size, graph.op("Mod", count, size))
    first = graph.constant(np.array(0, np.int32))
    filled = graph.op(
        "Pad", "voxels", graph.op("Concat", graph.integers(0), missing, axis=0), first
    )
    chunks = graph.op("Reshape", filled, graph.op("Concat", graph.integers(-1), size, axis=0))
    subgraph = head_body(net, features, per_offset, noisy_voxels(graph))
    stacked = graph.op("Scan", chunks, body=subgraph, num_scan_inputs=1)
    flat = graph.op("Reshape", stacked, graph.op("Concat", graph.integers(-1), offsets, axis=0))
    ends = [flat, graph.integers(0), count, graph.integers(0)]
    graph.nodes.append(helper.make_node("Slice", ends, ["values"]))


def head_body(net: SuperSdfNet, features: str, per_offset: str, noisy: str) -> onnx.GraphProto:
    """Return the head of some voxels: coefficients times functions, and the correction."""
    body = Graph(net, "head_")
    chosen = body.op("Gather", features, "some", axis=0)
    branch = body.relu(body.layer(chosen, net.branch))
    patches = body.op("Gather", "patches", "some", axis=0)
    per_voxel = body.op("Concat", chosen, branch, patches, axis=1)
    kept = body.op("MatMul", per_voxel, per_offset)
    where = body.op("Gather", noisy, "some", axis=0)
    correction = body.op("Mul", body.layer(chosen, net.correction), where)
    values = body.op("Add", kept, correction)
    given = helper.make_tensor_value_info("some", TensorProto.INT32, ["chunk"])
    made = helper.make_tensor_value_info(values, TensorProto.FLOAT, ["chunk", "Q"])
    return helper.make_graph(body.nodes, "head", [given], [made], body.constants)


def noisy_voxels(graph: Graph) -> str:
    """Add which voxels are noisy, (V, 1) of 0 and 1: see network.is_noisy."""
    centre = graph.op("Gather", "patches", graph.integers(CENTRE), axis=1)
    apart = graph.op("Abs", graph.op("Sub", "patches", centre))
    excess = graph.op("Sub", apart, graph.constant(REACH))
    most = graph.op("ReduceMax", excess, graph.integers(1), keepdims=0)
    ended = graph.op("Concat", most, graph.constant(np.zeros(1, np.float32)), axis=0)
    around = graph.op("Gather", ended, "neighbours", axis=0)
    worst = graph.op("ReduceMax", around, graph.integers(1), keepdims=1)
    above = graph.op("Greater", worst, graph.constant(np.float32(0)))
    return graph.op("Cast", above, to=TensorProto.FLOAT)


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


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """Return the parameters and buffers in an exported file, to train on from there."""
    graphs = [onnx.load(path).graph]
    graphs += [a.g for node in graphs[0].node for a in node.attribute if a.name == "body"]
    arrays = {i.name: numpy_helper.to_array(i).copy() for g in graphs for i in g.initializer}
    linear = {name for name, array in arrays.items() if array.ndim == 2 and "conv" not in name}
    return {
        name: torch.from_numpy(array.T.copy() if name in linear else array)
        for name, array in arrays.items()
        if "." in name
    }


def write_model(net: SuperSdfNet, path: Path, card: dict[str, Any]) -> None:
    """Write graph and metadata."""
    imports = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(build_graph(net), opset_imports=imports, ir_version=9)
    model.producer_name = "super-sdf"
    helper.set_model_props(model, {key: str(value) for key, value in card.items()})
    onnx.checker.check_model(model)
    onnx.save(model, path)


def noisy_ball(seed: int = 0) -> tuple[np.ndarray, ...]:
    """Return inputs to compare networks on, with noise and some voxels that are not decoded."""
    rng = np.random.default_rng(seed)
    ijk = np.indices((24, 20, 22))
    radius = np.linalg.norm(ijk - np.array([11, 9, 10])[:, None, None, None], axis=0)
    rescaled = (2 * (radius - 7) + rng.normal(0, 0.3, radius.shape)).astype(np.float32)
    band = find_band(rescaled)
    patches, table = gather_patches(rescaled, band), neighbour_table(band, rescaled.shape)
    voxels = np.flatnonzero(rng.random(len(band)) < 0.7).astype(np.int32)
    return patches, table, voxels, block_offsets(4)


def parity(net: SuperSdfNet, path: Path, seed: int = 0) -> float:
    """Return the largest difference (half voxels) between torch and onnxruntime on a noisy ball."""
    arrays = noisy_ball(seed)
    got = load_network(path, device="cpu")(*arrays)
    with torch.no_grad():
        want = net(*(torch.from_numpy(array) for array in arrays))
    return float(np.abs(got - want.numpy()).max())


def load_run(folder: Path) -> SuperSdfNet:
    """Return the averaged network of a run."""
    state = torch.load(folder / "checkpoint.pt", weights_only=True)
    net = SuperSdfNet(NetworkConfig(**state["config"]))
    net.load_state_dict(state["average"])
    return net.eval()


def rewrite(source: Path, target: Path) -> None:
    """Write the weights and the card of an exported file in the graph of today.

    Raises
    ------
    SystemExit
        If the values are not the same, bit for bit.
    """
    card = {prop.key: prop.value for prop in onnx.load(source).metadata_props}
    net = read_network(source)
    want = load_network(source, device="cpu")(*noisy_ball())
    fresh = target.with_suffix(".new.onnx")  # the target may be the source
    write_model(net, fresh, card)
    same = np.array_equal(load_network(fresh, device="cpu")(*noisy_ball()), want)
    if not same:
        fresh.unlink()
        raise SystemExit(f"{source}: the new graph gives other values; {target} was not written")
    fresh.replace(target)
    print(f"{target}: the same values as {source} had, bit for bit")


def read_network(path: Path) -> SuperSdfNet:
    """Return the network in an exported file."""
    weights = read_weights(path)
    trunk, inputs = weights["trunk.layers.0.weight"].shape
    channels = len(weights["correction.weight"][0])
    config = NetworkConfig(
        channels=channels,
        blocks=sum(name.endswith("conv.bias") for name in weights),
        hidden=len(weights["stem.0.bias"]),
        functions=channels + len(weights["branch.bias"]),
        trunk=trunk,
        frequencies=(inputs - 3) // 6,
    )
    net = SuperSdfNet(config)
    net.load_state_dict(weights)
    return net.eval()


def make_card(net: SuperSdfNet, name: str, data: str, accuracy: str) -> dict[str, Any]:
    """Return the metadata that the runtime shows."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    return {
        "format_version": FORMAT_VERSION,
        "name": name,
        "band": "abs(value) < 1.5 h",
        "receptive_field": net.config.receptive_field,
        "value_scaling": "2 / h",
        "training_factors": [2, 4, 8, 16],
        "parameters": sum(p.numel() for p in net.parameters()),
        "trained_on": data,
        "trained_from_commit": commit,
        "accuracy": accuracy,
        "licence": "MIT",
    }


def main() -> None:
    """Export a run, or a file anew, and refuse to keep a file that does not agree with it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--run", type=Path, help="folder of the run")
    source.add_argument("--from", type=Path, dest="source", help="an .onnx file to write anew")
    parser.add_argument("--out", type=Path, required=True, help="the .onnx file")
    parser.add_argument("--data", default="not said", help="what it was trained on")
    parser.add_argument("--accuracy", default="not measured", help="measured figures, in words")
    options = parser.parse_args()
    if options.source:
        rewrite(options.source, options.out)
        return
    net = load_run(options.run)
    write_model(net, options.out, make_card(net, options.out.stem, options.data, options.accuracy))
    difference = parity(net, options.out)
    if difference > PARITY:
        options.out.unlink()
        raise SystemExit(f"torch and onnxruntime differ by {difference / 2:.2e} voxels: not kept")
    size = options.out.stat().st_size / 1e6
    print(f"{options.out}: {size:.1f} MB, differs from torch by {difference / 2:.1e} voxels")


if __name__ == "__main__":
    main()
