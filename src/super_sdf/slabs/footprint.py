"""The memory model: the peak of the work on a slab, by the voxels that it sees and decodes.

The numbers are measured by ``python -m lab figures --only memory``, as the peaks of processes.
"""

from __future__ import annotations

from ..machine.threads import CHUNK, rows_in_chunk
from ..options import DEFAULT_MESHER, SHARP
from ..steps.marching import LOOKUP_BYTES, lookups_at_once
from ..steps.meshers import BY_NAME
from ..steps.spline import spline_bytes
from ..steps.survey import Band

# Bytes per voxel that the network sees, per decoded voxel and per node of a decoded block: of the
# fit to spheres with what goes before, of the bounds and the meshers, and of a spline.
STAGES = {"fit": (216, 1450, 4.0), "mesh": (216, 450, 8.2), "spline": (216, 300, 4.5)}
# Bytes per thread, for its chunk, and once.
THREAD_BYTES, FIXED_BYTES = 25_000_000, 30_000_000
# Of a network that does not state them: bytes per voxel that it sees, and per value.
NETWORK_BYTES = (680.0, 8.0)
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
    mesher: str = DEFAULT_MESHER,
) -> int:
    """Return the peak memory of the work on a slab, in bytes beyond what the process holds already.

    ``seen`` and ``decoded`` are rows of the band, see ``cutting.Slab``, ``planes`` those of the
    slab alone; ``network_bytes`` is the memory of the network per voxel that it sees and per value.
    """
    voxels, own, nodes = seen.stop - seen.start, band.count_decoded(decoded), (factor + 1) ** 3
    fixed = FIXED_BYTES + THREAD_BYTES * min(threads, own * nodes // CHUNK + 1)
    needs = {
        name: each[0] * voxels + (each[1] + each[2] * nodes) * own + fixed
        for name, each in STAGES.items()
    }
    needs["spline"] += spline_bytes(band.shape) if band.smooth is not None else 0
    if band.smooth is not None and not band.exact.any():
        del needs["fit"]  # there are no spheres
    extra = _sharp_bytes if mesher == SHARP else _lookup_bytes
    needs["mesh"] += extra(band, planes, own, factor, threads)
    if band.smooth is None or band.has_kinks:  # the network decodes no fewer voxels than offsets
        network = network_bytes[0] * voxels + network_bytes[1] * max(own, nodes) * nodes
        needs["network"] = network + BYTES_PER_OFFSET * nodes + NETWORK_FIXED
    return int(max(needs.values()))


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
    from ..steps.sharp.mesher import GROUP_BYTES, groups_at_once, voxel_bytes

    beside = BY_NAME[SHARP].planes_beside(factor)
    before = band.decoded_before[max(planes[0] - beside, 0) : planes[1] + beside + 1]
    width = min(2 * beside + 1, len(before) - 1)
    around = int((before[width:] - before[: len(before) - width]).max())
    most = sum(voxel_bytes(factor))
    return min(threads, groups_at_once(planes, band.shape)) * min(
        GROUP_BYTES + most * around, most * decoded
    )
