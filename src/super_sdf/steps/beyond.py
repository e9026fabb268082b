"""The samples beyond the band, a few voxels from the surface, and boxes of the samples of both.

The network does not see these samples, but their spheres reach the surface (``bounds``). They are
kept as a list, since the grid is read once and most of it is far from the surface. Lengths are in
half voxels, as in ``band``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from .band import HALF_BAND

FARTHEST = 8.0  # four voxels


@dataclass(frozen=True, eq=False)
class SamplesBeyond:
    """Samples between the band and ``FARTHEST`` that can be exact.

    Attributes
    ----------
    number : (n,) int64
        The number of each sample in C order of the grid, ascending.
    value : (n,) float32
        Their values.
    """

    number: NDArray[np.int64]
    value: FloatArray


NONE_BEYOND = SamplesBeyond(np.zeros(0, np.int64), np.zeros(0, np.float32))


def samples_beyond(rescaled: FloatArray, first: int, limits: tuple[float, float]) -> SamplesBeyond:
    """Return those beyond the band among samples that follow each other, from number ``first`` on.

    They are those that can be exact: between ``limits``. Where a field is cut off, as most are that
    were truncated, all of the rest of the grid is not.
    """
    if not reach_beyond(limits):
        return NONE_BEYOND
    low, high = np.asarray(limits, np.float32).clip(-FARTHEST, FARTHEST)
    found = (rescaled > low) & (rescaled < high)
    found &= ~((rescaled > -HALF_BAND) & (rescaled < HALF_BAND))
    at = np.flatnonzero(found)
    return SamplesBeyond(at + first, rescaled[found])


def reach_beyond(limits: tuple[float, float]) -> bool:
    """Return whether samples beyond the band can be exact: the same for all parts of a grid."""
    return limits[0] < -HALF_BAND or limits[1] > HALF_BAND


@dataclass(frozen=True, eq=False)
class TrustedSamples:
    """All samples whose spheres can be trusted: exact ones of the band, and some beyond it.

    Attributes
    ----------
    shape : three ints
        Samples of the grid along each axis.
    voxel_ijk : (V, 3) int32
        The samples of the band, in C order.
    value : (V,) float32
        Their values.
    exact : (V,) bool
        Which of them are exact.
    beyond : SamplesBeyond
    limits : two floats
        Between these, samples beyond the band can be exact.
    """

    shape: tuple[int, int, int]
    voxel_ijk: IntArray
    value: FloatArray
    exact: BoolArray
    beyond: SamplesBeyond
    limits: tuple[float, float]

    @property
    def reach_beyond(self) -> bool:
        """Whether samples beyond the band can be exact."""
        return reach_beyond(self.limits)

    def box(self, low: IntArray, high: IntArray) -> FloatArray:
        """Return the samples from index ``low`` (3,) to before ``high``, NaN where there is none.

        The box may exceed the grid.
        """
        box = np.full(high - low, np.nan, np.float32)
        planes = slice(*np.searchsorted(self.voxel_ijk[:, 0], [low[0], high[0]]))
        rows = np.flatnonzero(self.exact[planes]) + planes.start
        self._put(box, self.voxel_ijk[rows] - low, self.value[rows])
        plane = self.shape[1] * self.shape[2]
        ends = np.array([low[0], high[0]], np.int64) * plane
        rows = slice(*np.searchsorted(self.beyond.number, ends))
        ijk = np.stack(np.unravel_index(self.beyond.number[rows], self.shape), 1)
        self._put(box, ijk - low, self.beyond.value[rows])
        return box

    @staticmethod
    def _put(box: FloatArray, at: NDArray[np.integer], value: FloatArray) -> None:
        """Write values at indices (n, 3), leaving out those outside the box."""
        within = np.asarray(((at >= 0) & (at < box.shape)).all(1))
        box[tuple(at[within].T)] = value[within]
