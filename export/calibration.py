"""The ranges of the inputs of a network's layers, on samples as in training.

``quantize`` derives quantization steps from them, and ``prune`` finds blocks that never react.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from export.augment import USUAL, Prepared, augment, augment_mask, batch_table
from export.dataset import fill_shard
from export.latency import ball
from export.network import Block, SuperSdfNet
from super_sdf.network.network import load_network

THIN = 0.05  # share of thin solids, as in training
SAMPLES = 200


@dataclass
class Ranges:
    """Minimum and maximum of each channel at the inputs of the three layers of a block."""

    low: Tensor  # (C,) features
    high: Tensor  # (C,)
    mixed: Tensor  # (C,) maximum; after a rectifier the minimum is 0
    expanded: Tensor  # (hidden,) likewise

    @classmethod
    def of_zeros(cls, block: Block) -> Ranges:
        """Return ranges that contain only 0."""
        zeros = torch.zeros(block.expand.in_features)
        return cls(zeros, zeros, zeros, torch.zeros(block.expand.out_features))

    def widen(self, features: Tensor, mixed: Tensor, expanded: Tensor) -> None:
        """Extend the ranges by the inputs of one sample."""
        self.low = torch.minimum(self.low, features.amin(0))
        self.high = torch.maximum(self.high, features.amax(0))
        self.mixed = torch.maximum(self.mixed, mixed.amax(0))
        self.expanded = torch.maximum(self.expanded, expanded.amax(0))


def draw_samples(count: int = SAMPLES, seed: int = 0, *, masks: bool = False) -> list[Prepared]:
    """Return samples of procedural shapes, some noisy, some truncated; or masks of them."""
    rng = np.random.default_rng(seed)
    samples = fill_shard(rng, [], 1.0, THIN, count)
    if masks:
        shown = [augment_mask(rng, sample) for sample in samples]
        return [sample for sample in shown if len(sample.voxels)]  # thin ones may vanish
    return [augment(rng, sample, USUAL) for sample in samples]


@torch.no_grad()
def find_ranges(net: SuperSdfNet, samples: list[Prepared]) -> list[Ranges]:
    """Return the ranges of each block on these samples."""
    ranges = [Ranges.of_zeros(block) for block in net.blocks]
    for sample in samples:
        table = torch.from_numpy(batch_table([sample.table]))
        features = net.stem(torch.from_numpy(sample.patches))
        for block, block_ranges in zip(net.blocks, ranges):
            mixed = block.mix(features, table)
            expanded = torch.relu(block.expand(mixed))
            block_ranges.widen(features, mixed, expanded)
            features = features + block.reduce(expanded)
    return ranges


def distance_apart(one: Path, other: Path, samples: Sequence[Prepared] = ()) -> np.ndarray:
    """Return the differences between the values of two files on samples or a ball, in voxels."""
    pair = [load_network(path, device="cpu") for path in (one, other)]
    apart = []
    for sample in samples or [ball(15.0)]:
        rows = (array.astype(np.int32) for array in (sample.table, sample.voxels))
        arrays = (sample.patches, *rows, sample.offsets)
        first, second = (network(*arrays) for network in pair)
        apart.append(np.abs(first - second).ravel() / 2)
    return np.concatenate(apart)
