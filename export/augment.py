"""Random changes to a sample each time it is shown, so that no network sees the same one twice.

A distance field stays one when its cube is turned or mirrored and, near the surface, when another
level is called zero. Grids of users may also be truncated or noisy: the targets stay clean, so the
network learns to undo that. Or they are masks: then only the side of each sample is left, and the
network gets the distances that the runtime makes of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
import torch
from torch import Tensor

from export.dataset import Sample, fill_shard, parser_of_options
from super_sdf.arrays import NEIGHBOURHOOD, STRIDES, BoolArray, IntArray
from super_sdf.grid import derived
from super_sdf.network import contract
from super_sdf.refine import band

DISTANCES = "distances"  # of which some were noisy: what a card without an entry says
INPUTS = (DISTANCES, contract.MASKS)


@dataclass(frozen=True)
class Shares:
    """The share of samples that each change is applied to, from 0 to 1."""

    shifted: float = 1 / 6
    noisy: float = 1 / 4
    truncated: float = 1 / 6


USUAL = Shares()
CLEAN = Shares(0, 0, 0)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A sample as the network's inputs, with the targets."""

    patches: Tensor  # (V, 27) float32; of masks also the ``wide_distances`` of each voxel
    table: Tensor  # (V, 27) int64 rows of the band, -1 where absent
    voxels: Tensor  # (D,) int64 rows of the band that have targets
    offsets: Tensor  # (Q, 3) float32
    targets: Tensor  # (D, Q) float32

    def on(self, device: str) -> Prepared:
        return Prepared(*(tensor.to(device) for tensor in vars(self).values()))


def prepare(sample: Sample, inside: BoolArray | None = None) -> Prepared:
    """Gather a sample with the functions of the runtime; targets outside the band are dropped.

    ``inside`` is the mask that the sample was made of, with a margin of its own.
    """
    ijk = np.argwhere(band.is_active(sample.window)).astype(np.int32)
    shape = sample.window.shape
    rows = np.full(shape, -1)
    rows[tuple(ijk.T)] = np.arange(len(ijk))
    voxels = rows[tuple(sample.voxel_ijk.T)]
    patches = band.gather_patches(sample.window, ijk)
    if inside is not None:
        wide = derived.wide_distances(inside, ijk + (len(inside) - shape[0]) // 2)
        patches = np.hstack([patches, 2 * wide])
    arrays = (
        patches,
        band.neighbour_table(ijk, shape).astype(np.int64),
        voxels[voxels >= 0],
        sample.offsets,
        sample.targets[voxels >= 0].astype(np.float32),
    )
    return Prepared(*map(torch.from_numpy, arrays))


def cube_symmetries() -> IntArray:
    """Return the 48 rotations and reflections of the cube as matrices, (48, 3, 3) int32."""
    signs = [np.diag(sign) for sign in product((1, -1), repeat=3)]
    orders = [np.eye(3, dtype=np.int32)[list(order)] for order in permutations(range(3))]
    return np.array([sign @ order for order in orders for sign in signs], np.int32)


def turned(sample: Prepared, number: int) -> Prepared:
    """Turn and mirror a sample by one of the 48 symmetries of the cube."""
    symmetry = cube_symmetries()[number]
    places = torch.from_numpy((NEIGHBOURHOOD @ symmetry + 1) @ STRIDES).to(sample.table)
    offsets = sample.offsets @ torch.from_numpy(symmetry.T).to(sample.offsets)
    others = torch.arange(27, sample.patches.shape[1], device=places.device)
    patches, table = sample.patches[:, torch.cat([places, others])], sample.table[:, places]
    return replace(sample, patches=patches, table=table, offsets=offsets)


def change(rng: np.random.Generator, sample: Sample, inputs: str, shares: Shares) -> Prepared:
    """Make a mask of a sample, or shift, roughen and truncate some; then gather it."""
    if inputs == contract.MASKS:
        return masked(rng, sample)
    sample = sample.cropped()
    window, targets = sample.window, sample.targets.astype(np.float32)
    if rng.random() < shares.shifted:  # another zero level, up to half a voxel away (Sec. 5.3)
        level = np.float32(rng.uniform(-1, 1))
        window, targets = window - level, targets - level
    if rng.random() < shares.noisy:  # by up to half a voxel; small amplitudes are more frequent
        noise = rng.uniform(-1, 1, window.shape) * rng.random() ** 1.5
        window = window + noise.astype(np.float32)
    prepared = prepare(replace(sample, window=window, targets=targets))
    if rng.random() < shares.truncated:  # at 1.5 to 3 voxels
        limit = rng.uniform(3, 6)
        return replace(prepared, patches=prepared.patches.clamp(-limit, limit))
    return prepared


def masked(rng: np.random.Generator, sample: Sample) -> Prepared:
    """Gather what is known of the mask of a sample at a level up to half a voxel from zero.

    Without a sample on each side there is nothing to learn: the window is then empty, and so is the
    band.
    """
    level = np.float32(rng.uniform(-1, 1))
    targets = sample.targets.astype(np.float32) - level
    return of_mask(replace(sample, targets=targets), sample.window < level)


def of_mask(sample: Sample, inside: BoolArray) -> Prepared:
    """Gather what is known of a mask, (nx, ny, nz), with the targets of a sample."""
    window = 2 * derived.mask_distances(inside)
    return prepare(replace(sample, window=window).cropped(), inside)


def draw_samples(count: int = 200, inputs: str = DISTANCES) -> list[Prepared]:
    """Return samples of procedural shapes, some noisy, some truncated; or masks of them."""
    rng = np.random.default_rng(0)
    options = parser_of_options().parse_args(["--out", "none"])  # the usual shares and sizes
    samples = fill_shard(rng, [], count, options)
    shown = [change(rng, sample, inputs, USUAL) for sample in samples]
    return [sample for sample in shown if len(sample.voxels)]  # thin ones may vanish in masks
