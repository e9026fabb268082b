"""The ranges of the inputs of a network's layers, on samples as in training.

``quantize`` derives quantization steps from them.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from export.augment import USUAL, Prepared, augment, augment_mask
from export.batches import batch_of, encode
from export.dataset import fill_shard
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
