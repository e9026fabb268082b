"""Cutting a grid into slabs so that the work fits in memory, planned before it begins.

The result is the same for every cut, because each slab is worked on with as many planes to either
side as its values depend on:

    planes of the slab                   vertices and triangles are made here
    + the mesher's planes_beside         values are final: vertices depend on them
    + REACH_IN_VOXELS                    blocks are decoded: of the fit to spheres, bounds, debris
    + the network's receptive field      voxels are given to the network

The memory model, ``slab_bytes``, is measured by ``python -m lab figures --only memory``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, pairwise

import numpy as np
from numpy.typing import NDArray

from ..errors import OutOfMemoryError
from ..grid.sdf_grid import SdfGrid
from .. import threads as limits
from ..machine.memory import ROOM_SHARE, advised, give_back, held_memory, in_words
from ..threads import CHUNK, Resources, rows_in_chunk
from ..network.decoder import NETWORK_BYTES
from ..options import MARCHING, SHARP, MesherName
from ..refine import bounds, debris, spheres
from ..surface.extract import reach_in_voxels
from ..refine.spline import spline_bytes
from ..refine.survey import (Band, band_bytes, count_crossings, look_at_band, outline, plan_reading)

DEFAULT: MesherName = MARCHING
SURFACE_SHARE, DOUBT = 0.25, "is this a distance field?"  # of which few samples are
SEEN_AGAIN = 1.15  # voxels that slabs see in all, over those of one slab, if they take no more time
LARGE = 250_000  # voxels of a slab below which smaller slabs save little memory
REACH_IN_VOXELS = spheres.REACH_IN_VOXELS + bounds.REACH_IN_VOXELS + debris.REACH_IN_VOXELS


@dataclass(frozen=True)
class Slab:
    """A slab: planes and rows of the band."""

    planes: tuple[int, int]  # its own, from the first to before the second
    decoded: slice  # rows of which those that can hold the surface are decoded
    seen: slice  # rows that the network sees


def whole(band: Band) -> Slab:
    """Return the whole band as one slab."""
    return Slab((0, band.shape[0]), band.all_rows, band.all_rows)


def planes_needed(receptive_field: int, mesher: MesherName, factor: int) -> int:
    """Return how many planes to either side of a slab its mesh depends on."""
    seen = max(receptive_field, bounds.REACH_OF_SAMPLES)
    return reach_in_voxels(mesher, factor) + REACH_IN_VOXELS + seen


def plan_slabs(
    band: Band,
    factor: int,
    receptive_field: int | None,
    resources: Resources,
    network_bytes: tuple[float, float] = NETWORK_BYTES,
    mesher: MesherName = DEFAULT,
    planes: tuple[int, int] | None = None,
) -> list[Slab]:
    """Return the fewest slabs that fit in memory, in order; more where they take no more time."""
    check_vertices(band, factor)
    bound, need = resources.memory, 0
    beside = reach_in_voxels(mesher, factor)
    for nth, slabs in enumerate(_ways(band, receptive_field, beside, planes)):
        if nth == 1:
            give_back()  # otherwise freed memory counts as held
        need = peak_bytes(band, slabs, factor, network_bytes, resources.threads, mesher)
        if bound is None or need <= bound:
            return slabs
    given = band, factor, receptive_field
    plain = need
    if mesher is not DEFAULT:
        plain = least_bytes(*given, resources, network_bytes, DEFAULT, planes)
    raise _does_not_fit(*given, need, bound or 0, plain)


def refuse_band(
    grid: SdfGrid,
    offset: float,
    factor: int,
    receptive_field: int | None,
    resources: Resources,
    network_bytes: tuple[float, float] = NETWORK_BYTES,
    mesher: MesherName = DEFAULT,
) -> OutOfMemoryError:
    """Return the error for a grid whose band does not fit in memory: the grid is read once more."""
    give_back()
    planes, _ = plan_reading(grid.samples, held_memory() or 0, resources)
    seen = look_at_band(grid, offset, planes)
    band = outline(grid, offset, resources.threads, seen.voxels, seen.decoded)
    given, held = (band, factor, receptive_field), band_bytes(seen.summary.voxels, seen.beyond)
    need = plain = held + least_bytes(*given, resources, network_bytes, mesher)
    if mesher is not DEFAULT:
        plain = held + least_bytes(*given, resources, network_bytes, DEFAULT)
    share = seen.summary.voxels / np.prod(grid.shape, dtype=float)
    error = _does_not_fit(*given, need, resources.memory or 0, plain)
    if share < SURFACE_SHARE:
        return error
    return OutOfMemoryError(f"{error}; {share:.0%} of the samples are near the surface: {DOUBT}")


def _ways(
    band: Band, receptive_field: int | None, beside: int, planes: tuple[int, int] | None = None
) -> Iterator[list[Slab]]:
    """Yield the whole band, and, if the receptive field is known, more and more slabs of planes.

    The first are as many as take no more time than one.
    """
    if receptive_field is None:
        yield [whole(band)]
        return
    least = count_free(band, receptive_field, beside, planes)
    if planes is None and least == 1:
        yield [whole(band)]
    first, last = planes or (0, band.shape[0])
    for pieces in range(least, max(last - first, 2)):
        yield cut(band, pieces, receptive_field, beside, planes)
    decoding = np.flatnonzero(np.diff(band.decoded_before[first : last + 1])) + first
    bounds = [first, *decoding.tolist()[1:], last]  # each slab decodes something
    yield [slab_of(band, low, high, receptive_field, beside) for low, high in pairwise(bounds)]


def check_vertices(band: Band, factor: int) -> None:
    """Raise OptionError if the mesh will certainly have more vertices than 32-bit numbers."""
    if int(band.decoded_before[-1]) * 3 * factor**3 > limits.MAX_INDEX:
        check_crossings(count_crossings(band.patches), factor)


def check_crossings(crossings: int, factor: int) -> None:
    """Raise OptionError if this number of crossed coarse edges makes too many vertices for sure.

    The surface crosses about K^2 times as many edges of the fine lattice; half of them certainly.
    """
    limits.check_count(crossings * factor**2 // 2, "vertices or more")


def peak_bytes(
    band: Band,
    slabs: list[Slab],
    factor: int,
    network_bytes: tuple[float, float] = NETWORK_BYTES,
    threads: int = 1,
    mesher: MesherName = DEFAULT,
) -> int:
    """Return the peak memory of the process in bytes: what it holds now plus the largest slab."""
    held, rest = held_memory() or band.patches.nbytes, (factor, network_bytes, threads, mesher)
    needs = (slab_bytes(band, slab.seen, slab.decoded, slab.planes, *rest) for slab in slabs)
    return max(held + max(needs), band.peak)


def least_bytes(
    band: Band,
    factor: int,
    receptive_field: int | None,
    resources: Resources,
    network_bytes: tuple[float, float],
    mesher: MesherName,
    planes: tuple[int, int] | None = None,
) -> int:
    """Return the peak memory in the smallest slabs."""
    *_, slabs = _ways(band, receptive_field, reach_in_voxels(mesher, factor), planes)
    return peak_bytes(band, slabs, factor, network_bytes, resources.threads, mesher)


def cut(
    band: Band,
    pieces: int,
    receptive_field: int,
    beside: int,
    planes: tuple[int, int] | None = None,
) -> list[Slab]:
    """Cut planes of a band into at most ``pieces`` slabs with about equally many decoded voxels."""
    first, last = planes or (0, band.shape[0])
    before = band.decoded_before[first : last + 1] - band.decoded_before[first]
    return [
        slab_of(band, first + low, first + high, receptive_field, beside)
        for low, high in equal_parts(before, pieces)
    ]


def equal_parts(before: NDArray[np.int64], pieces: int) -> list[tuple[int, int]]:
    """Cut planes into at most some pieces with about equally many of what is ``before`` each."""
    share = before / max(int(before[-1]), 1)
    inner = np.searchsorted(share, np.arange(1, pieces) / pieces)
    last = len(before) - 1
    return list(pairwise(sorted(set(np.clip([0, *inner, last], 0, last).tolist()))))


def count_free(
    band: Band, receptive_field: int, beside: int, planes: tuple[int, int] | None = None
) -> int:
    """Return into how many slabs planes are cut in no more time: few voxels are seen twice."""

    def seen(pieces: int) -> int:
        slabs = cut(band, pieces, receptive_field, beside, planes)
        return sum(slab.seen.stop - slab.seen.start for slab in slabs)

    once = seen(1)
    return next(
        pieces
        for pieces in count(1)
        if once < LARGE * (pieces + 1) or seen(pieces + 1) > SEEN_AGAIN * once
    )


def slab_of(band: Band, first: int, last: int, receptive_field: int, beside: int) -> Slab:
    """Return the slab of planes ``first`` to before ``last``, with the rows it depends on."""
    beside += REACH_IN_VOXELS
    more = beside + receptive_field
    decoded = band.rows(first - beside, last + beside)
    return Slab((first, last), decoded, band.rows(first - more, last + more))


def _does_not_fit(
    band: Band, factor: int, receptive_field: int | None, need: int, bound: int, plain: int
) -> OutOfMemoryError:
    """Return the error for work that does not fit in memory; what it says to allow is enough.

    Marching cubes need ``plain``.
    """
    how = "at once" if receptive_field is None else "even plane by plane"
    ways = "a smaller factor"
    if plain < need and plain <= bound:
        ways = f"--mesher marching, which leaves edges alone, or {ways}"
    if band.unpacked <= ROOM_SHARE * need:  # it would be unpacked into memory then
        need += band.unpacked
    return OutOfMemoryError(
        f"factor {factor} on {int(band.decoded_before[-1]):,} voxels needs {advised(need)} of "
        f"memory {how}, {in_words(bound)} may be used; use {ways}, or allow more "
        "(--max-memory)"
    )


# Bytes per voxel that the network sees, per decoded voxel and per node of a decoded block: of the
# fit to spheres with what goes before, of the bounds and the meshers, and of a spline.
STAGES = {"fit": (216, 1450, 4.0), "mesh": (216, 450, 8.2), "spline": (216, 300, 4.5)}
# Bytes per thread, for its chunk, and once.
THREAD_BYTES, FIXED_BYTES = 25_000_000, 30_000_000
# The head of a network works on a chunk of voxels at all offsets at once.
BYTES_PER_OFFSET, NETWORK_FIXED = 27_000, 5_000_000

Range = tuple[int, int]


def slab_bytes(
    band: Band,
    seen: slice,
    decoded: slice,
    planes: Range,
    factor: int,
    network_bytes: tuple[float, float] = NETWORK_BYTES,
    threads: int = 1,
    mesher: MesherName = MARCHING,
) -> int:
    """Return the peak memory of the work on a ``Slab``, in bytes beyond what is held already.

    ``network_bytes`` is the memory of the network per voxel that it sees and per value.
    """
    voxels, own, nodes = seen.stop - seen.start, band.count_decoded(decoded), (factor + 1) ** 3
    fixed = FIXED_BYTES + THREAD_BYTES * min(threads, own * nodes // CHUNK + 1)
    needs = {
        name: each[0] * voxels + (each[1] + each[2] * nodes) * own + fixed
        for name, each in STAGES.items()
    }
    is_smooth = band.field.smooth is not None
    needs["spline"] += spline_bytes(band.shape) if is_smooth else 0
    if is_smooth and not band.exact.any():
        del needs["fit"]  # there are no spheres
    extra = _sharp_bytes if mesher == SHARP else _lookup_bytes
    needs["mesh"] += extra(band, planes, own, factor, threads)
    if not is_smooth or band.field.has_kinks:  # the network decodes no fewer voxels than offsets
        network = network_bytes[0] * voxels + network_bytes[1] * max(own, nodes) * nodes
        needs["network"] = network + BYTES_PER_OFFSET * nodes + NETWORK_FIXED
    return int(max(needs.values()))


def _lookup_bytes(band: Band, planes: Range, decoded: int, factor: int, threads: int) -> int:
    """Return the bytes of the vertex lookup tables of whole planes, see ``marching.connect``."""
    return 12 * (factor + 1) ** 3 * decoded


def _sharp_bytes(band: Band, planes: Range, decoded: int, factor: int, threads: int) -> int:
    """Return the bytes of the sharp mesher: every voxel may be near an edge."""
    return 432 * factor**2 * decoded
