"""Write the int8 variant of an exported network, and check its error.

    python -m export.quantize base.onnx --out base-int8.onnx
    python -m export.quantize base-int8.onnx   # optimises its graph again

Only the blocks change; stem, head and the features between the blocks stay float32. Weights are
integers with one scale per output channel. The features, turned at random so that their channels
are alike, have one step, and the other inputs of a layer one per channel. The steps are static,
calibrated on procedural shapes, or on masks of them: dynamic steps would make the values of a voxel
depend on all others in the call.

Layers are written in the sequence that onnxruntime fuses: dequantize, multiply, quantize, which
rectifies, too. With a Relu between, onnxruntime 1.21 to 1.30 make two nodes of one name in a Scan
and refuse them. The gathered features are bytes, a quarter of the memory. Integer sums are exact in
any order, so the values of a voxel depend only on its neighbours.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, numpy_helper
from torch import Tensor, nn

from export.arguments import Parser
from export.augment import DISTANCES, Prepared, draw_samples
from export.losses import batch_of
from export.network import Block, SuperSdfNet, in_basis
from export.onnx_graph import EARLY, Writer, declared, first_channels, rows_of
from export.to_onnx import read_card, read_network, write_model
from super_sdf import load_network
from super_sdf.network import contract, onnx as sessions

LEVELS = 255  # of the inputs of a layer: uint8
# Two products must fit into 16 bits, in which processors without VNNI add them with saturation.
MOST = 64  # largest weight; 2 * 255 * 64 < 2^15
MOST_BIAS = 2**30
LEAST_STEP = 1e-3  # over the largest step, for channels that are almost always 0
SOME = 20  # samples on which it is compared with its source
LARGEST_ERROR = 0.01  # voxels, mean difference from float32 at which a file is still kept
ONE, NONE = "int8_one", "int8_none"
Array = np.ndarray


@dataclass
class Ranges:
    """Extremes of each channel at the inputs of the three layers of a block."""

    low: Tensor  # (C,) features
    high: Tensor  # (C,)
    mixed: Tensor  # (C,) maximum; after a rectifier the minimum is 0
    expanded: Tensor  # (hidden,) likewise

    def see_conv(self, module: nn.Module, given: tuple[Tensor, ...], made: Tensor) -> None:
        for features in (given[0], *given[2:]) if len(made) else ():  # its voxels, those around
            self.low = torch.minimum(self.low, features.amin(0))
            self.high = torch.maximum(self.high, features.amax(0))
        if len(made):
            self.mixed = torch.maximum(self.mixed, made.amax(0))

    def see_expand(self, module: nn.Module, given: tuple[Tensor, ...], made: Tensor) -> None:
        if len(made):
            self.expanded = torch.maximum(self.expanded, made.amax(0))


@torch.no_grad()
def find_ranges(net: SuperSdfNet, samples: list[Prepared]) -> list[Ranges]:
    """Return the ranges of each block on these samples.

    Blocks beside and behind a gate read the same features: they have the same ranges of these.
    """
    watched, found = copy.deepcopy(net), []
    for block in watched.all_blocks():
        zeros = torch.zeros(block.expand.in_features)
        ranges = Ranges(zeros, zeros, zeros, torch.zeros(block.expand.out_features))
        block.conv.register_forward_hook(ranges.see_conv)
        block.expand.register_forward_hook(ranges.see_expand)
        found.append(ranges)
    for sample in samples:
        batch = batch_of([sample])
        watched.encode_all(batch.patches, batch.table)
    last = found[net.config.blocks - net.config.gated :]
    if last:
        low = torch.stack([each.low for each in last]).amin(0)
        high = torch.stack([each.high for each in last]).amax(0)
        last = [replace(each, low=low, high=high) for each in last]
    return found[: net.config.blocks - net.config.gated] + last


def turned(net: SuperSdfNet) -> SuperSdfNet:
    """Return a network with the same values, its features turned at random.

    Then all channels have nearly the same range, and one step fits all (QuaRot, Ashkboos et al.
    2024). Channels that some blocks do not see are turned among themselves.
    """
    seen, random = net.config.seen or net.config.channels, torch.Generator().manual_seed(0)
    parts = [n for n in (seen, net.config.channels - seen) if n]
    turns = (torch.linalg.qr(torch.randn(n, n, generator=random))[0] for n in parts)
    basis = torch.block_diag(*turns)
    return in_basis(net, basis, basis.T)


@dataclass(frozen=True, eq=False)
class IntLayer:
    """A linear layer: ``(values @ weight + bias) * scales``, with integer values from 0 to 255."""

    weight: Array  # (K, n) int8
    scales: Array  # (n,) float32
    bias: Array  # (n,) int32


@dataclass(frozen=True, eq=False)
class IntBlock:
    """A residual block. The features f it sees are ``f / step + zero``, from 0 to 255."""

    step: np.float32
    zero: np.uint8
    seen: int  # channels, the first ones
    layers: dict[str, IntLayer]


def whole_block(block: Block, ranges: Ranges) -> IntBlock:
    seen = block.conv.seen
    low, high = float(ranges.low[:seen].min()), float(ranges.high[:seen].max())
    step = np.float32((high - low) / LEVELS or 1)
    zero = np.uint8(np.rint(-low / step).clip(0, LEVELS))
    mixed, expanded = steps_of(ranges.mixed), steps_of(ranges.expanded)
    plain, steps = np.ones(len(ranges.low)), np.full(len(block.conv.weight), step)
    conv = whole_layer(block.conv.weight, block.conv.bias, steps, mixed, float(zero))
    expand = whole_layer(block.expand.weight.T, block.expand.bias, mixed, expanded)
    reduce = whole_layer(block.reduce.weight.T, block.reduce.bias, expanded, plain)
    return IntBlock(step, zero, seen, {"conv": conv, "expand": expand, "reduce": reduce})


def steps_of(width: Tensor) -> Array:
    """Return the quantization step of each channel, (n,)."""
    steps = width.numpy() / LEVELS
    return np.maximum(steps, LEAST_STEP * (steps.max() or 1)).astype(np.float32)


def whole_layer(
    weight: Tensor, bias: Tensor, steps: Array, out: Array, zero: float = 0
) -> IntLayer:
    """Quantize a layer, ``values @ weight + bias``, (K, n) and (n,).

    ``steps`` (K,) and ``out`` (n,) are those of its inputs and outputs, ``zero`` the zero point of
    the inputs.
    """
    scaled = weight.detach().double().numpy() * steps[:, None] / out
    start = bias.detach().double().numpy() / out
    scales = np.maximum(np.abs(scaled).max(0) / MOST, np.abs(start) / MOST_BIAS) + 1e-30
    whole = np.rint(scaled / scales)
    start = np.rint(start / scales) - zero * whole.sum(0)
    return IntLayer(whole.astype(np.int8), scales.astype(np.float32), start.astype(np.int32))


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
        if made_by[source].op_type == "Slice":  # of channels, which are sliced when rounded
            graph.node.remove(made_by[source])
            source = made_by[source].input[0]
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
    writer = Writer(f"{body.name}_rounded_")
    step, zero = writer.constant(block.step, "step"), writer.constant(block.zero, "zero")
    channels = len(block.layers["reduce"].scales)
    seen = first_channels(writer, body.output[0].name, block.seen, channels)
    rounded = writer.op("QuantizeLinear", seen, step, zero)
    body.node.extend(writer.nodes)
    body.initializer.extend(writer.constants)
    body.output.append(rows_of(rounded, TensorProto.UINT8, block.seen))
    return f"{rounded}_chunks"


def keep_absent(graph: onnx.GraphProto, read: onnx.NodeProto, block: IntBlock) -> None:
    """Set the last row that a block reads, which index -1 refers to, to the zero point."""
    name, width = read.output[0], block.seen
    writer = Writer(f"{read.name}_absent_")
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
    writer, value = Writer(f"{body.name}_int8_"), reshape.output[0]
    for label, layer in block.layers.items():
        if label != "conv":
            value = writer.op("QuantizeLinear", value, ONE, NONE)  # what is negative becomes 0
        scales = writer.constant(layer.scales, f"{label}.scales")
        operands = [writer.op("DequantizeLinear", value, ONE, NONE)]
        # onnxruntime fuses the operators only if the zero points, all 0, are explicit
        for name, array, axis in (("weight", layer.weight, 1), ("bias", layer.bias, 0)):
            zeros = np.zeros(len(layer.scales), array.dtype)
            given = writer.constant(array, f"{label}.{name}"), scales
            zeros_of = writer.constant(zeros, f"{label}.{name}_zeros")
            operands.append(writer.op("DequantizeLinear", *given, zeros_of, axis=axis))
        value = writer.op("Gemm", *operands)
    writer.nodes[-1].output[0] = kept.output[0]
    nodes, constants = [table, gather, reshape, *writer.nodes, added], [shape, *writer.constants]
    del body.node[:], body.initializer[:]
    body.node.extend(nodes)
    body.initializer.extend(constants)
    del scan.input[2], body.input[2]
    next(a for a in scan.attribute if a.name == "num_scan_inputs").i = 2


def quantize(
    source: Path, target: Path, samples: list[Prepared], accuracy: str = "not measured"
) -> None:
    net = turned(read_network(source))
    ranges = find_ranges(net, samples)
    changed = {"name": target.stem, "precision": "int8", "accuracy": accuracy}
    write_model(net, target, {**read_card(source), **changed})
    model = onnx.load(target)
    replace_blocks(model.graph, [whole_block(*pair) for pair in zip(net.all_blocks(), ranges)])
    onnx.checker.check_model(model)
    onnx.save(model, target)
    optimise(target)


def optimise(path: Path) -> None:
    """Write the graph of an int8 file as onnxruntime would fuse it each time it is opened.

    The operators are those of the source but for onnxruntime's own, which every version since 1.18
    has: the values are the same, bit for bit.
    """
    ort, fused = sessions.ort, path.with_suffix(".fused.onnx")
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_EXTENDED
    options.optimized_model_filepath = str(fused)
    options.log_severity_level = 3
    ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    source, model = onnx.load(path), onnx.load(fused)
    fused.unlink()
    model.producer_name, model.producer_version = source.producer_name, ""
    used = [one for one in model.opset_import if one.domain in ("", "com.microsoft")]
    card: dict[str, Any] = {entry.key: entry.value for entry in source.metadata_props}
    card[sessions.OPTIMISED] = f"onnxruntime {ort.__version__}"
    del model.opset_import[:]
    model.opset_import.extend(used)
    onnx.helper.set_model_props(model, card)
    onnx.save(model, path)


def distance_apart(
    one: Path, other: Path, samples: Sequence[Prepared], near: float = np.inf
) -> Array:
    """Return the differences of the values of a file from those of another, in voxels.

    They are those on samples where the values of the first file are up to ``near`` half voxels.
    """
    pair, apart = [load_network(path, device="cpu") for path in (one, other)], []
    for sample in samples:
        table, voxels = sample.table.int().numpy(), sample.voxels.int().numpy()
        arrays = sample.patches.numpy(), table, voxels, sample.offsets.numpy()
        first, second = (network(*arrays) for network in pair)
        apart.append((second - first)[np.abs(first) < near].ravel() / 2)
    return np.concatenate(apart)


def take_shift_out(path: Path, shift: float) -> None:
    """Subtract a shift, in voxels, from the correction that all voxels of a mask have."""
    model = onnx.load(path)
    bodies = [a.g for node in model.graph.node for a in node.attribute if a.name == "body"]
    bias = next(i for body in bodies for i in body.initializer if i.name == "correction.bias")
    shifted = numpy_helper.to_array(bias) - np.float32(2 * shift)
    bias.CopyFrom(numpy_helper.from_array(shifted, bias.name))
    onnx.save(model, path)


def main(words: Sequence[str] | None = None) -> None:
    """Write the file; keep it only if it is close to its source."""
    parser = Parser(description=__doc__.split("\n")[0])
    parser.add_argument("source", type=Path, help="an .onnx file of export.to_onnx")
    parser.add_argument("--out", type=Path, help="the int8 .onnx file")
    parser.add_argument("--accuracy", default="not measured", help="measured figures, in words")
    options = parser.parse_args(words)
    with parser.one_line_errors():
        if options.out is None:
            optimise(options.source)
        else:
            write_int8(options)


def write_int8(options: argparse.Namespace) -> None:
    """Write the int8 variant of a file; of masks without the shift that rounding gives them."""
    of_distances = read_network(options.source).config.keeps_samples
    samples = draw_samples(inputs=DISTANCES if of_distances else contract.MASKS)
    quantize(options.source, options.out, samples, options.accuracy)
    pair = options.source, options.out
    if not of_distances:
        take_shift_out(options.out, float(distance_apart(*pair, samples[:SOME], near=0.5).mean()))
    apart = np.abs(distance_apart(*pair, samples[:SOME])).mean()
    if apart > LARGEST_ERROR:
        options.out.unlink()
        raise SystemExit(f"{apart:.4f} voxels from {options.source} on average: not kept")
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.1f} MB, {apart:.5f} voxels away")


if __name__ == "__main__":
    main()
