"""Which samples can be taken as exact distances.

Those that contradict no neighbour, near the surface, and not cut off. If too many contradict
others, the field is noisy, and none is. Lengths are in half voxels, as in ``band``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import BoolArray, FloatArray
from ..machine.threads import map_chunks
from ..neighbourhood import CENTRE
from .band import MAX_DIFFERENCE

MAX_DISTANCE = 2.8  # samples near the band's edge, 3, may have been truncated there
MIN_SLOPE = 0.7  # towards the steepest neighbour; near 1 for a distance
MAX_NOISY_SHARE = 0.02  # of all samples; in a noisier field no sample is taken as exact


@dataclass(frozen=True)
class BandSummary:
    """What the band of a whole grid says of its samples, whichever part of it is worked on.

    Attributes
    ----------
    voxels, noisy : int
        Voxels whose samples tell whether the field is noisy, and those round which samples differ
        by more than distances can.
    low, high : float
        The lowest and the highest sample, in half voxels.
    leaves : bool
        Whether a sample on the border of the grid is inside.
    """

    voxels: int
    noisy: int
    low: float
    high: float
    leaves: bool = False

    @property
    def is_noisy(self) -> bool:
        """Whether no sample can be taken as exact."""
        return not self.voxels or self.noisy / self.voxels > MAX_NOISY_SHARE


def summarise(sample: FloatArray, lipschitz: BoolArray, leaves: bool = False) -> BandSummary:
    """Return the summary of samples (V,), some of which tell by ``lipschitz`` how noisy they are.

    No sample is at infinity.
    """
    noisy = len(lipschitz) - int(np.count_nonzero(lipschitz))
    low, high = float(sample.min(initial=np.inf)), float(sample.max(initial=-np.inf))
    return BandSummary(len(lipschitz), noisy, low, high, leaves)


def exact_samples(
    patches: FloatArray,
    lipschitz: BoolArray,
    threads: int = 1,
    sampled: BoolArray | None = None,
    whole: BandSummary | None = None,
) -> BoolArray:
    """Return which samples of a band can be taken as exact distances.

    Parameters
    ----------
    patches : (V, 27) float32
        The samples round each voxel, in half voxels.
    lipschitz : (V,) bool
        From ``is_lipschitz``. If more than a few are False the field is noisy, and no sample is
        taken as exact.
    threads : int
        Threads to use.
    sampled : (V,) bool, optional
        Which are samples, not interpolated: these tell whether the field is noisy. All by default.
    whole : BandSummary, optional
        Of the band of the whole grid, if these are the voxels of a part of it.

    Returns
    -------
    (V,) bool
    """
    sample = patches[:, CENTRE]
    whole = whole or summarise(sample, lipschitz if sampled is None else lipschitz[sampled])
    if not len(patches) or whole.is_noisy:
        return np.zeros(len(patches), bool)
    limits = np.float32(whole.low), np.float32(whole.high)
    near = np.abs(sample) < MAX_DISTANCE
    cut_off = map_chunks(lambda rows: is_cut_off(patches[rows], limits), len(patches), 27, threads)
    exact: BoolArray = lipschitz & near & ~np.concatenate(cut_off)
    return exact


def is_cut_off(patches: FloatArray, limits: tuple[np.float32, np.float32]) -> BoolArray:
    """Return which samples were truncated, (V,) bool.

    A truncated sample has the largest value of its sign, and no neighbour towards which the field
    is as steep as a distance. ``limits`` are the lowest and the highest sample.
    """
    sample = patches[:, CENTRE]
    at_limit = sample == np.where(sample > 0, limits[1], limits[0])
    slope = np.abs(patches - sample[:, None]) / np.maximum(MAX_DIFFERENCE, 1)
    cut_off: BoolArray = at_limit & (slope.max(1) < MIN_SLOPE)
    return cut_off
