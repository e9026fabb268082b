"""What a slab takes in memory, stage by stage, at the most."""

from __future__ import annotations

import numpy as np

from ..machine.threads import CHUNK, rows_in_chunk
from ..steps.marching import LOOKUP_BYTES, lookups_at_once
from ..steps.survey import Band

# What a process takes at the most in each stage after the network, measured (``benchmarks.large``,
# ``benchmarks.bounds``), in bytes: for each voxel that the network sees, for each that is decoded,
# for each node of a decoded block, for each thread's chunk, and whatever the grid.
STAGES = {
    "average": (216, 300, 5.0, 1e7, 2e7),
    "fit": (216, 1150, 4.0, 1e7, 2.5e7),
    "isosurface": (216, 200, 7.0, 1e7, 2.5e7),
}
# A network's own, unless it says otherwise: bytes for each voxel that it sees, its neighbours among
# them, and for each value.
NETWORK_BYTES = (680.0, 8.0)
# The head of a network works on a chunk of voxels at all offsets at a time.
BYTES_PER_OFFSET = 27_000
NETWORK_FIXED = 5_000_000

Range = tuple[int, int]


def slab_bytes(
    band: Band,
    seen: slice,
    decoded: slice,
    planes: Range,
    factor: int,
    network_bytes: tuple[float, float] = NETWORK_BYTES,
    threads: int = 1,
) -> int:
    """Return what a process takes for a slab beside what it holds already, at the most.

    ``network_bytes`` is for each voxel that the network sees, and for each value.
    """
    voxels, own = seen.stop - seen.start, band.count_decoded(decoded)
    values = own * (factor + 1) ** 3
    sizes = np.array([voxels, own, values, min(threads, values // CHUNK + 1), 1])
    needs = dict(zip(STAGES, np.array(list(STAGES.values())) @ sizes))
    needs["isosurface"] += _lookup_bytes(band, planes, own, factor, threads)
    needs["network"] = _bytes_for_network(voxels, own, factor, network_bytes)
    return int(max(needs.values()))


def _bytes_for_network(
    voxels: int, decoded: int, factor: int, network_bytes: tuple[float, float]
) -> float:
    """Return what the network takes: it is asked for as many voxels as offsets, at least."""
    offsets = (factor + 1) ** 3
    fixed = BYTES_PER_OFFSET * offsets + NETWORK_FIXED
    return float(np.dot(network_bytes, [voxels, max(decoded, offsets) * offsets])) + fixed


def _lookup_bytes(band: Band, planes: Range, decoded: int, factor: int, threads: int) -> int:
    """Return what the tables take in which the vertices of whole planes are looked up."""
    nodes = (factor + 1) ** 3
    before = band.decoded_before[max(planes[0] - 1, 0) : planes[1] + 1]
    two_planes = int((before[2:] - before[:-2]).max()) if len(before) > 2 else decoded
    widest = min(two_planes + rows_in_chunk(nodes), decoded)
    return LOOKUP_BYTES * nodes * widest * lookups_at_once(decoded, widest, threads)
