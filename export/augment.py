"""Random changes to a sample each time it is shown, so that no network sees the same one twice.

A distance field stays one when its cube is turned or mirrored and, near the surface, when another
level is called zero. Grids of users may also be truncated or noisy: the targets stay clean, so the
network learns to undo that. Or they are masks: then only the side of each sample is left, and the
network gets the distances that the runtime makes of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from export.dataset import Sample, fill_shard
from super_sdf.grid.derived import mask_distances
from super_sdf.network.neighbourhood import cube_symmetries, turn
from super_sdf.refine.band import find_band, gather_patches, neighbour_table


@dataclass(frozen=True)
class Shares:
    """The share of samples that each change is applied to, from 0 to 1."""

    inverted: float = 0.0  # more is worse: solids are mostly convex, and networks learn that
    shifted: float = 1 / 6
    noisy: float = 1 / 4
    truncated: float = 1 / 6


USUAL = Shares()
CLEAN = Shares(0, 0, 0, 0)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A sample as the network's inputs, with the targets."""

    ijk: np.ndarray  # (V, 3) voxels in the window, turned with it
    patches: np.ndarray  # (V, 27) float32
    table: np.ndarray  # (V, 27) int32, -1 where absent
    voxels: np.ndarray  # (D,) rows of the band that have targets
    offsets: np.ndarray  # (Q, 3) float32
    targets: np.ndarray  # (D, Q) float32


def augment(rng: np.random.Generator, sample: Sample, shares: Shares) -> Prepared:
    return turned(rng, change(rng, sample, shares))


def change(rng: np.random.Generator, sample: Sample, shares: Shares) -> Prepared:
    changed = noisy(rng, shifted(rng, inverted(rng, sample, shares), shares), shares)
    return truncated(rng, prepare(changed), shares)


def augment_mask(rng: np.random.Generator, sample: Sample) -> Prepared:
    return turned(rng, prepare(masked(rng, sample)))


def prepare_mask(sample: Sample) -> Prepared:
    """Make a mask of a sample, always the same one, and gather it."""
    return prepare(masked(np.random.default_rng(len(sample.voxel_ijk)), sample))


def prepare(sample: Sample) -> Prepared:
    """Gather a sample with the functions of the runtime; targets outside the band are dropped."""
    band = find_band(sample.window)
    strides = np.array([sample.window.shape[1] * sample.window.shape[2], sample.window.shape[2], 1])
    keys, wanted = band @ strides, sample.voxel_ijk.astype(np.int64) @ strides
    rows = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
    in_band = keys[rows] == wanted if len(keys) else np.zeros(len(wanted), bool)
    return Prepared(
        band,
        gather_patches(sample.window, band),
        neighbour_table(band, sample.window.shape),
        rows[in_band],
        sample.offsets,
        sample.targets[in_band].astype(np.float32),
    )


def inverted(rng: np.random.Generator, sample: Sample, shares: Shares) -> Sample:
    if rng.random() >= shares.inverted:
        return sample
    return replace(sample, window=-sample.window, targets=-sample.targets)


def shifted(rng: np.random.Generator, sample: Sample, shares: Shares) -> Sample:
    """Move the zero level by up to half a voxel (Sec. 5.3)."""
    if rng.random() >= shares.shifted:
        return sample
    level = np.float32(rng.uniform(-1, 1))
    targets = sample.targets.astype(np.float32) - level
    return replace(sample, window=sample.window - level, targets=targets)


def masked(rng: np.random.Generator, sample: Sample) -> Sample:
    """Replace the distances by those of the mask at a level up to half a voxel from zero.

    Without a sample on each side there is nothing to learn: the window is then empty, and so is the
    band.
    """
    level = np.float32(rng.uniform(-1, 1))
    inside = sample.window < level
    targets = sample.targets.astype(np.float32) - level
    return replace(sample, window=2 * mask_distances(inside), targets=targets)


def noisy(rng: np.random.Generator, sample: Sample, shares: Shares) -> Sample:
    """Add uniform noise of up to half a voxel; small amplitudes are more frequent."""
    if rng.random() >= shares.noisy:
        return sample
    noise = rng.uniform(-1, 1, sample.window.shape) * rng.random() ** 1.5
    return replace(sample, window=sample.window + noise.astype(np.float32))


def truncated(rng: np.random.Generator, sample: Prepared, shares: Shares) -> Prepared:
    """Truncate the values at 1.5 to 3 voxels."""
    if rng.random() >= shares.truncated:
        return sample
    limit = rng.uniform(3, 6)
    return replace(sample, patches=np.clip(sample.patches, -limit, limit))


def batch_table(tables: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenate neighbour tables; the index of an absent neighbour becomes the number of rows."""
    starts = np.cumsum([0] + [len(table) for table in tables])
    moved = [np.where(t < 0, starts[-1], t + at) for t, at in zip(tables, starts[:-1])]
    return np.concatenate(moved).astype(np.int32)


def turned(rng: np.random.Generator, sample: Prepared) -> Prepared:
    """Turn and mirror a sample by one of the 48 symmetries of the cube."""
    symmetry = rng.choice(cube_symmetries())
    patches, table, offsets = turn(symmetry, sample.patches, sample.table, sample.offsets)
    ijk = sample.ijk @ symmetry.T
    return replace(sample, ijk=ijk, patches=patches, table=table, offsets=offsets)


THIN = 0.05  # share of thin solids, as in training


def draw_samples(count: int = 200, seed: int = 0, *, masks: bool = False) -> list[Prepared]:
    """Return samples of procedural shapes, some noisy, some truncated; or masks of them."""
    rng = np.random.default_rng(seed)
    samples = fill_shard(rng, [], 1.0, THIN, count)
    if masks:
        shown = [augment_mask(rng, sample) for sample in samples]
        return [sample for sample in shown if len(sample.voxels)]  # thin ones may vanish
    return [augment(rng, sample, USUAL) for sample in samples]
