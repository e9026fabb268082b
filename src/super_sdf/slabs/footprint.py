"""The peak memory of each stage of the work on a slab."""

from __future__ import annotations

import numpy as np

from ..machine.threads import CHUNK, rows_in_chunk
from ..network.decoder import NETWORK_BYTES
from ..steps.bounds import LEAST_FACTOR
from ..steps.marching import LOOKUP_BYTES, lookups_at_once
from ..steps.mesher_names import DEFAULT_MESHER, MARCHING, SHARP
from ..steps.meshers import BY_NAME
from ..steps.spline import spline_bytes
from ..steps.survey import Band

# Peak memory of the stages after the network in bytes, measured (``benchmarks.large``,
# ``benchmarks.bounds``): per voxel that the network sees, per decoded voxel, per node of a decoded
# block, per thread (its chunk), and a constant.
STAGES = {
    "average": (216, 300, 5.0, 1e7, 2e7),
    "fit": (216, 1450, 4.0, 1e7, 3e7),
    "bounds": (216, 450, 8.2, 2.5e7, 2e7),
    MARCHING: (216, 350, 7.5, 1e7, 3e7),
    SHARP: (216, 350, 7.5, 1e7, 3e7),
}
SPLINE = (216, 300, 4.5, 0, 2e7)


# The head of a network works on a chunk of voxels at all offsets at once.
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
    mesher: str = DEFAULT_MESHER,
) -> int:
    """Return the peak memory of the work on a slab, in bytes beyond what the process holds already.

    Parameters
    ----------
    band : Band
        The band of the whole grid.
    seen, decoded : slice
        Rows of the band, see ``cutting.Slab``.
    planes : two ints
        The slab's own planes.
    factor : int
        K.
    network_bytes : two floats
        Memory of the network in bytes, per voxel that it sees and per value.
    threads : int
        Threads that work at the same time.
    mesher : str
        The name of what makes triangles of the slab.
    """
    voxels, own = seen.stop - seen.start, band.count_decoded(decoded)
    values = own * (factor + 1) ** 3
    sizes = np.array([voxels, own, values, min(threads, values // CHUNK + 1), 1])
    stages = *_stages_before_mesher(band, factor), mesher
    needs = {stage: float(np.dot(STAGES[stage], sizes)) for stage in stages}
    extra = _sharp_bytes if mesher == SHARP else _lookup_bytes
    needs[mesher] += extra(band, planes, own, factor, threads)
    if band.smooth is not None:
        needs["spline"] = float(np.dot(SPLINE, sizes)) + spline_bytes(band.shape)
    if band.smooth is None or band.has_kinks:
        needs["network"] = _bytes_for_network(voxels, own, factor, network_bytes)
    return int(max(needs.values()))


def _stages_before_mesher(band: Band, factor: int) -> list[str]:
    """Return the stages between the network and the mesher."""
    if band.smooth is not None and not band.exact.any():
        return ["average"]  # there are no spheres
    return ["average", "fit", "bounds"] if factor >= LEAST_FACTOR else ["average", "fit"]


def _bytes_for_network(
    voxels: int, decoded: int, factor: int, network_bytes: tuple[float, float]
) -> float:
    """Return the bytes of the network, which decodes at least as many voxels as offsets."""
    offsets = (factor + 1) ** 3
    fixed = BYTES_PER_OFFSET * offsets + NETWORK_FIXED
    return float(np.dot(network_bytes, [voxels, max(decoded, offsets) * offsets])) + fixed


def _lookup_bytes(band: Band, planes: Range, decoded: int, factor: int, threads: int) -> int:
    """Return the bytes of the vertex lookup tables of whole planes, see ``marching.connect``."""
    nodes = (factor + 1) ** 3
    before = band.decoded_before[max(planes[0] - 1, 0) : planes[1] + 1]
    two_planes = int((before[2:] - before[:-2]).max()) if len(before) > 2 else decoded
    widest = min(two_planes + rows_in_chunk(nodes), decoded)
    return LOOKUP_BYTES * nodes * widest * lookups_at_once(decoded, widest, threads)


def _sharp_bytes(band: Band, planes: Range, decoded: int, factor: int, threads: int) -> int:
    """Return the bytes of the sharp mesher on as many groups as it works on at once.

    Where edges are is not known yet: every voxel of the planes beside a group may be near one.
    """
    from ..steps.sharp_groups import GROUP_BYTES, groups_at_once, voxel_bytes

    beside = BY_NAME[SHARP].planes_beside(factor)
    before = band.decoded_before[max(planes[0] - beside, 0) : planes[1] + beside + 1]
    width = min(2 * beside + 1, len(before) - 1)
    around = int((before[width:] - before[: len(before) - width]).max())
    most = sum(voxel_bytes(factor))
    return min(threads, groups_at_once(planes, band.shape)) * min(
        GROUP_BYTES + most * around, most * decoded
    )
