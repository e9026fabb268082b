"""Open3D's ``VoxelBlockGrid``, saved as ``.npz``: cubes of voxels at the keys of a hash map.

Voxel (x, y, z) of the block with key k is at ``voxel_size * (k * resolution + (x, y, z))``; voxels
without weight, and blocks that are missing, are unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import GridError
from ..volume import ZYX, Volume


def volume_of_blocks(array: Callable[[str], NDArray[Any]]) -> Volume:
    """Return the truncated distances in a file; ``array`` returns one of its arrays.

    Raises
    ------
    GridError
        If it has no distances with their weights, or arrays that do not fit together.
    """
    keys = array("key").astype(np.int64)
    resolution, step = (array(name).item() for name in ("block_resolution", "voxel_size"))
    values, weights = (
        array(f"value_{array(f'attr_name_{name}').item():03d}") for name in ("tsdf", "weight")
    )
    blocks = (len(keys), *(resolution,) * 3, 1)
    if keys.shape != (len(keys), 3) or not len(keys) or not values.shape == weights.shape == blocks:
        raise GridError(f"its keys have shape {keys.shape}, its values {values.shape}")
    samples = np.where(weights > 0, values, np.nan)[..., 0]  # (block, z, y, x)
    low = keys.min(0)
    starts = (keys - low)[:, ::-1] * resolution
    shape = starts.max(0) + resolution

    def read(first: int, last: int) -> NDArray[Any]:
        planes = np.full((last - first, *shape[1:]), np.nan, samples.dtype)
        met = (starts[:, 0] < last) & (starts[:, 0] + resolution > first)
        for (z, y, x), block in zip(starts[met], samples[met]):
            cut = block[max(first - z, 0) : last - z]
            a = max(z - first, 0)
            planes[a : a + len(cut), y : y + resolution, x : x + resolution] = cut
        return planes

    x, y, z = (float(step * resolution * corner) for corner in low)
    sizes = tuple(shape.tolist())
    return Volume(sizes, samples.dtype, read, (step,) * 3, (x, y, z), ZYX, packed=values.nbytes)
