"""How a grid is cut into slabs so that the work fits in memory: decided before it begins.

The result is the same for every cut. What a block's values depend on ends some planes away:

    planes of the slab                   its vertices and triangles are made
    + FINAL_BESIDE                       values must be final: which vertices are whose
    + spheres.REACH_IN_VOXELS            blocks are decoded
    + the network's receptive field      voxels are shown to the network
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .compiling import is_loaded
from .errors import OutOfMemoryError
from .memory import held_memory, hold_less, in_words
from .spheres import REACH_IN_VOXELS
from .survey import Band

FINAL_BESIDE = 1
DECODED_BESIDE = FINAL_BESIDE + REACH_IN_VOXELS
# What a process takes at the most in each stage, measured (``benchmarks.large``), in bytes: for
# each voxel that the network sees, for each that is decoded, for each node of a decoded block, and
# for chunks in work, whatever the grid.
STAGES = {
    "network": (680, 0, 8.0, 5e6),
    "average": (108, 375, 7.2, 2e7),
    "fit": (108, 850, 3.3, 2e7),
    "isosurface": (108, 140, 5.7, 2e7),
}
# Compiled functions, which come from the disk as they are called.
CODE_BYTES = 60_000_000


@dataclass(frozen=True)
class Slab:
    """Planes of voxels to be meshed, from the first to before the last, and rows of the band.

    Attributes
    ----------
    planes : two ints
        The slab's own planes.
    decoded : slice
        Voxels among which are those to decode.
    seen : slice
        Voxels that the network sees.
    """

    planes: tuple[int, int]
    decoded: slice
    seen: slice


def whole(band: Band) -> Slab:
    """Return the whole band as one slab."""
    return Slab((0, band.shape[0]), band.all_rows, band.all_rows)


def plan_slabs(
    band: Band, factor: int, receptive_field: int | None, bound: int | None
) -> list[Slab]:
    """Return the fewest slabs that fit, in order.

    Parameters
    ----------
    band : Band
        Of the whole grid.
    factor : int
        K.
    receptive_field : int, optional
        Voxels to each side that the network's answer depends on; if it is not known, the network
        must see the whole band at once.
    bound : int, optional
        Bytes that the process may hold in all: see ``memory.memory_bound``.

    Raises
    ------
    OutOfMemoryError
        If the thinnest slabs do not fit.
    """
    if receptive_field is None:
        need = peak_bytes(band, [whole(band)], factor)
        if bound is not None and need > bound:
            raise _does_not_fit(band, factor, "at once", need, bound)
        return [whole(band)]
    if bound is None or peak_bytes(band, [whole(band)], factor) <= bound:
        return [whole(band)]
    hold_less()  # else what was freed counts as held
    for slabs in ways_to_cut(band, receptive_field):
        need = peak_bytes(band, slabs, factor)
        if need <= bound:
            return slabs
    raise _does_not_fit(band, factor, "even plane by plane", need, bound)


def peak_bytes(band: Band, slabs: list[Slab], factor: int) -> int:
    """Return what the process will hold at the most: now, and for the largest slab."""
    held = held_memory() or band.patches.nbytes
    return held + max(slab_bytes(band, slab, factor) for slab in slabs)


def cut(band: Band, pieces: int, receptive_field: int) -> list[Slab]:
    """Cut a band into slabs with about the same number of decoded voxels, at most so many."""
    share = band.decoded_before / max(int(band.decoded_before[-1]), 1)
    inner = np.searchsorted(share, np.arange(1, pieces) / pieces)
    bounds = np.unique(np.clip([0, *inner, band.shape[0]], 0, band.shape[0])).tolist()
    return [_slab(band, first, last, receptive_field) for first, last in pairwise(bounds)]


def ways_to_cut(band: Band, receptive_field: int) -> Iterator[list[Slab]]:
    """Yield cuts into more and more slabs, down to slabs of one plane."""
    for pieces in range(1, band.shape[0]):
        yield cut(band, pieces, receptive_field)
    planes = np.flatnonzero(np.diff(band.decoded_before)).tolist()  # each slab decodes something
    bounds = [0, *planes[1:], band.shape[0]]
    yield [_slab(band, first, last, receptive_field) for first, last in pairwise(bounds)]


def _slab(band: Band, first: int, last: int, receptive_field: int) -> Slab:
    """Return a slab with what it depends on."""
    decoded = band.rows(first - DECODED_BESIDE, last + DECODED_BESIDE)
    beside = DECODED_BESIDE + receptive_field
    return Slab((first, last), decoded, band.rows(first - beside, last + beside))


def slab_bytes(band: Band, slab: Slab, factor: int) -> int:
    """Return what a process takes for a slab beside what it holds already, at the most."""
    seen = slab.seen.stop - slab.seen.start
    decoded = band.count_decoded(slab.decoded)
    sizes = np.array([seen, decoded, decoded * (factor + 1) ** 3, 1])
    return CODE_BYTES * is_loaded() + int((np.array(list(STAGES.values())) @ sizes).max())


def _does_not_fit(band: Band, factor: int, how: str, need: int, bound: int) -> OutOfMemoryError:
    """Return the error for work that is too large."""
    return OutOfMemoryError(
        f"factor {factor} on {int(band.decoded_before[-1]):,} voxels needs {in_words(need)} of "
        f"memory {how}, {in_words(bound)} may be taken; use a smaller factor, or allow more "
        "(--max-memory)"
    )
