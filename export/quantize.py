r"""Write the int8 variant of an exported network, and check its error.

    python -m export.quantize src/super_sdf/models/base.onnx \
        --out src/super_sdf/models/base-int8.onnx

Only the blocks change; stem, head and the features between the blocks stay float32. Weights are
integers with one scale per output channel; the inputs of a layer are integers with one step per
input channel. The steps are static, calibrated on procedural shapes, or on masks of them: dynamic
steps would make the values of a voxel depend on all others in the call.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import onnx
from torch import Tensor

from export.augment import Prepared
from export.calibration import (
    Ranges,
    distance_apart,
    draw_samples,
    find_ranges,
)
from export.int8_graph import IntBlock, IntLayer, replace_blocks
from export.network import Block
from export.to_onnx import read_card, read_network, write_model

LEVELS = 255  # of the inputs of a layer: uint8
# Two products must fit into 16 bits, in which processors without VNNI add them with saturation.
MOST = 64  # largest weight; 2 * 255 * 64 < 2^15
MOST_BIAS = 2**30
LEAST_STEP = 1e-3  # over the largest step, for channels that are almost always 0
SOME = 20  # samples on which it is compared with its source
LARGEST_ERROR = 0.01  # voxels, mean difference from float32 at which a file is still kept
Array = np.ndarray


def quantize(
    source: Path, target: Path, samples: list[Prepared], accuracy: str = "not measured"
) -> None:
    """Write the int8 variant of a file, with its metadata."""
    net = read_network(source)
    changed = {"name": target.stem, "precision": "int8", "accuracy": accuracy}
    write_model(net, target, {**read_card(source), **changed})
    model = onnx.load(target)
    blocks = [whole_block(*pair) for pair in zip(net.all_blocks(), find_ranges(net, samples))]
    replace_blocks(model.graph, blocks)
    onnx.checker.check_model(model)
    onnx.save(model, target)


def whole_block(block: Block, ranges: Ranges) -> IntBlock:
    """Quantize the three layers of a block."""
    steps = steps_of(ranges.high - ranges.low)
    zeros = np.rint(-ranges.low.numpy() / steps).clip(0, LEVELS)
    mixed, expanded = steps_of(ranges.mixed), steps_of(ranges.expanded)
    plain = np.ones(len(steps))
    return IntBlock(
        steps,
        zeros.astype(np.uint8),
        whole_layer(block.conv.weight, block.conv.bias, np.tile(steps, 27), mixed, zeros),
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
    """Quantize a layer.

    Parameters
    ----------
    weight, bias : (K, n), (n,)
        The layer, ``values @ weight + bias``.
    steps, out : (K,), (n,)
        Quantization steps of its inputs and of its outputs.
    zeros : (C,), optional
        Zero points of the inputs, repeated if K > C. Default: 0.
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
    parser.add_argument("--out", type=Path, required=True, help="the int8 .onnx file")
    parser.add_argument("--accuracy", default="not measured", help="measured figures, in words")
    options = parser.parse_args()
    samples = draw_samples(masks=not read_network(options.source).config.keeps_samples)
    quantize(options.source, options.out, samples, options.accuracy)
    apart = distance_apart(options.source, options.out, samples[:SOME]).mean()
    if apart > LARGEST_ERROR:
        options.out.unlink()
        raise SystemExit(f"{apart:.4f} voxels from {options.source} on average: not kept")
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.1f} MB, {apart:.5f} voxels away")


if __name__ == "__main__":
    main()
