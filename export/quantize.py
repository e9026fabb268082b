r"""Write the int8 variant of an exported network, and check its error.

    python -m export.quantize src/super_sdf/models/base.onnx \
        --out src/super_sdf/models/base-int8.onnx
    python -m export.quantize src/super_sdf/models/base-int8.onnx   # optimises its graph again

Only the blocks change; stem, head and the features between the blocks stay float32. Weights are
integers with one scale per output channel; the inputs of a layer are integers with one step per
input channel. The steps are static, calibrated on procedural shapes, or on masks of them: dynamic
steps would make the values of a voxel depend on all others in the call.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnx
import torch
from torch import Tensor, nn

from export.augment import Prepared, draw_samples
from export.batches import batch_of, encode
from export.int8_graph import IntBlock, IntLayer, replace_blocks
from export.network import Block, SuperSdfNet
from export.to_onnx import read_card, read_network, write_model
from super_sdf.network.device import OPTIMISED
from super_sdf.network.network import load_network
from super_sdf.network.onnx import ort

LEVELS = 255  # of the inputs of a layer: uint8
# Two products must fit into 16 bits, in which processors without VNNI add them with saturation.
MOST = 64  # largest weight; 2 * 255 * 64 < 2^15
MOST_BIAS = 2**30
LEAST_STEP = 1e-3  # over the largest step, for channels that are almost always 0
SOME = 20  # samples on which it is compared with its source
LARGEST_ERROR = 0.01  # voxels, mean difference from float32 at which a file is still kept
Array = np.ndarray


@dataclass
class Ranges:
    """Minimum and maximum of each channel at the inputs of the three layers of a block."""

    low: Tensor  # (C,) features
    high: Tensor  # (C,)
    mixed: Tensor  # (C,) maximum; after a rectifier the minimum is 0
    expanded: Tensor  # (hidden,) likewise

    @classmethod
    def watching(cls, block: Block) -> Ranges:
        """Return ranges that contain only 0, and are extended whenever the block runs."""
        zeros = torch.zeros(block.expand.in_features)
        self = cls(zeros, zeros, zeros, torch.zeros(block.expand.out_features))

        def see_conv(module: nn.Module, given: tuple[Tensor, ...], made: Tensor) -> None:
            if not len(made):
                return
            for features in (given[0], *given[2:]):  # of its voxels, and of those around
                self.low = torch.minimum(self.low, features.amin(0))
                self.high = torch.maximum(self.high, features.amax(0))
            self.mixed = torch.maximum(self.mixed, made.amax(0))

        def see_expand(module: nn.Module, given: tuple[Tensor, ...], made: Tensor) -> None:
            if len(made):
                self.expanded = torch.maximum(self.expanded, made.amax(0))

        block.conv.register_forward_hook(see_conv)
        block.expand.register_forward_hook(see_expand)
        return self

    def join(self, others: Sequence[Ranges]) -> Ranges:
        """Return the ranges with those of the features widened to contain others'."""
        low = torch.stack([other.low for other in others]).amin(0)
        high = torch.stack([other.high for other in others]).amax(0)
        return replace(self, low=low, high=high)

    def in_units(self, units: Tensor) -> Ranges:
        """Return the ranges of features in these units."""
        return replace(self, low=self.low / units, high=self.high / units)


@torch.no_grad()
def find_ranges(net: SuperSdfNet, samples: list[Prepared]) -> list[Ranges]:
    """Return the ranges of each block on these samples.

    Blocks beside and behind a gate read the same features: they have the same ranges.
    """
    watched = copy.deepcopy(net)
    ranges = [Ranges.watching(block) for block in watched.all_blocks()]
    for sample in samples:
        encode(watched, batch_of([sample]))
    first = net.config.blocks - net.config.gated
    return ranges[:first] + [each.join(ranges[first:]) for each in ranges[first:]]


def distance_apart(one: Path, other: Path, samples: Sequence[Prepared]) -> np.ndarray:
    """Return the differences between the values of two files on samples, in voxels."""
    pair = [load_network(path, device="cpu") for path in (one, other)]
    apart = []
    for sample in samples:
        rows = (array.astype(np.int32) for array in (sample.table, sample.voxels))
        arrays = (sample.patches, *rows, sample.offsets)
        first, second = (network(*arrays) for network in pair)
        apart.append(np.abs(first - second).ravel() / 2)
    return np.concatenate(apart)


def quantize(
    source: Path, target: Path, samples: list[Prepared], accuracy: str = "not measured"
) -> None:
    net = read_network(source)
    ranges = find_ranges(net, samples)
    units = units_of(ranges)
    net, ranges = in_units(net, units), [each.in_units(units) for each in ranges]
    changed = {"name": target.stem, "precision": "int8", "accuracy": accuracy}
    write_model(net, target, {**read_card(source), **changed})
    model = onnx.load(target)
    blocks = [whole_block(*pair) for pair in zip(net.all_blocks(), ranges)]
    replace_blocks(model.graph, blocks)
    onnx.checker.check_model(model)
    onnx.save(model, target)
    optimise(target)


def optimise(path: Path) -> None:
    """Write the graph of an int8 file as onnxruntime would fuse it each time it is opened.

    The operators are those of the source but for onnxruntime's own, which every version since 1.18
    has: the values are the same, bit for bit.
    """
    options, fused = ort.SessionOptions(), path.with_suffix(".fused.onnx")
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_EXTENDED
    options.optimized_model_filepath = str(fused)
    options.log_severity_level = 3
    ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    source, model = onnx.load(path), onnx.load(fused)
    fused.unlink()
    model.producer_name, model.producer_version = source.producer_name, ""
    used = [one for one in model.opset_import if one.domain in ("", "com.microsoft")]
    del model.opset_import[:], model.metadata_props[:]
    model.opset_import.extend(used)
    model.metadata_props.extend(source.metadata_props)
    model.metadata_props.add(key=OPTIMISED, value=f"onnxruntime {ort.__version__}")
    onnx.save(model, path)


def units_of(ranges: Sequence[Ranges]) -> Tensor:
    """Return a unit for each channel of the features, (C,), in which their ranges are alike."""
    most = torch.stack([torch.maximum(-each.low, each.high) for each in ranges])
    units = (most / most.square().mean(1, keepdim=True).sqrt().clamp(min=1e-30)).amax(0)
    return units.clamp(min=LEAST_STEP * units.max())


@torch.no_grad()
def in_units(net: SuperSdfNet, units: Tensor) -> SuperSdfNet:
    """Return a network with the same values whose features are in these units."""
    net, count = copy.deepcopy(net), len(units)
    for block in net.all_blocks():
        block.conv.weight *= units.repeat(27)[:, None]
    for layer in (net.stem[2], *(block.reduce for block in net.all_blocks())):
        layer.weight /= units[:, None]
        layer.bias /= units
    gates = [net.gate.layers[0]] if net.config.gated else []
    for layer in (net.branch, net.correction, *gates):
        layer.weight *= units
    last = net.trunk.layers[-1]
    last.weight[:count] *= units[:, None]
    last.bias[:count] *= units
    return net


def whole_block(block: Block, ranges: Ranges) -> IntBlock:
    low, high = float(ranges.low.min()), float(ranges.high.max())
    step = np.float32((high - low) / LEVELS or 1)
    zero = np.uint8(np.rint(-low / step).clip(0, LEVELS))
    mixed, expanded = steps_of(ranges.mixed), steps_of(ranges.expanded)
    plain, steps = np.ones(len(ranges.low)), np.full(len(block.conv.weight), step)
    zeros = np.full(len(plain), float(zero))
    return IntBlock(
        step,
        zero,
        whole_layer(block.conv.weight, block.conv.bias, steps, mixed, zeros),
        whole_layer(block.expand.weight.T, block.expand.bias, mixed, expanded),
        whole_layer(block.reduce.weight.T, block.reduce.bias, expanded, plain),
    )


def steps_of(width: Tensor) -> Array:
    """Return the quantization step of each channel, (n,)."""
    steps = width.numpy() / LEVELS
    return np.maximum(steps, LEAST_STEP * (steps.max() or 1)).astype(np.float32)


def whole_layer(
    weight: Tensor, bias: Tensor, steps: Array, out: Array, zeros: Array | None = None
) -> IntLayer:
    """Quantize a layer, ``values @ weight + bias``, (K, n) and (n,).

    ``steps`` (K,) and ``out`` (n,) are those of its inputs and outputs, ``zeros`` (C,) the zero
    points of the inputs, repeated if K > C.
    """
    scaled = weight.detach().double().numpy() * steps[:, None] / out
    start = bias.detach().double().numpy() / out
    scales = np.maximum(np.abs(scaled).max(0) / MOST, np.abs(start) / MOST_BIAS) + 1e-30
    whole = np.rint(scaled / scales)
    start = np.rint(start / scales)
    if zeros is not None:
        start -= np.tile(zeros, len(whole) // len(zeros)) @ whole
    return IntLayer(whole.astype(np.int8), scales.astype(np.float32), start.astype(np.int32))


def main() -> None:
    """Write the file; keep it only if it is close to its source."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("source", type=Path, help="an .onnx file of export.to_onnx")
    parser.add_argument("--out", type=Path, help="the int8 .onnx file")
    parser.add_argument("--accuracy", default="not measured", help="measured figures, in words")
    options = parser.parse_args()
    if options.out is None:
        optimise(options.source)
        return
    samples = draw_samples(masks=not read_network(options.source).config.keeps_samples)
    quantize(options.source, options.out, samples, options.accuracy)
    apart = distance_apart(options.source, options.out, samples[:SOME]).mean()
    if apart > LARGEST_ERROR:
        options.out.unlink()
        raise SystemExit(f"{apart:.4f} voxels from {options.source} on average: not kept")
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.1f} MB, {apart:.5f} voxels away")


if __name__ == "__main__":
    main()
