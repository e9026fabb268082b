"""Values as the runtime takes them: those of shared nodes averaged over the voxels that share them.

A query on a face, edge or corner of its voxel (an offset of -1 or 1) is a query of the neighbours
there, too, and the isosurface gets the mean (Eq. 7). So the loss is that of the mean.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import torch
from torch import Tensor

from export.augment import Prepared
from export.network import Encoded, SuperSdfNet
from super_sdf.neighbourhood import CENTRE, STRIDES
from super_sdf.pipeline import rows_among


def neighbours_with_targets(sample: Prepared) -> np.ndarray:
    """Return which of the D voxels with targets are at the 27 places round each of them.

    The result is (D, 27) int64, with D where there is none.
    """
    near = rows_among(sample.voxels, len(sample.table))[sample.table[sample.voxels]]
    return np.where(near < 0, len(near), near).astype(np.int64)


def copies_of_queries(offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return all copies of the queries: query, place and offset there, of offsets (Q, 3).

    A query inside the voxel has one copy, at the voxel itself; one on a face has two, one on a
    corner eight. The copies at the voxel itself come first, in order.
    """
    ends = np.where(np.abs(offsets) == 1, offsets, 0).astype(int)
    queries, places, moved = [], [], []
    for chosen in product((0, 1), repeat=3):
        some = np.flatnonzero((np.abs(ends) >= chosen).all(1))
        step = ends[some] * chosen
        queries.append(some)
        places.append(CENTRE + step @ STRIDES)
        moved.append(offsets[some] - 2 * step)
    return np.concatenate(queries), np.concatenate(places), np.concatenate(moved)


def decode_shared(net: SuperSdfNet, voxels: Encoded, near: Tensor, offsets: np.ndarray) -> Tensor:
    """Return the averaged values (D, Q) of D voxels, with neighbours (D, 27), at offsets (Q, 3)."""
    query, place, moved = copies_of_queries(offsets)
    device, count = near.device, len(near)
    values = net.decode(voxels, torch.from_numpy(moved.astype(np.float32)).to(device))
    rows = near[:, torch.from_numpy(place).to(device)]
    there = (rows < count).to(values.dtype)
    padded = torch.cat([values, values.new_zeros(1, values.shape[1])])
    seen = torch.gather(padded, 0, rows)
    of_query = torch.from_numpy(query).to(device)
    total = values.new_zeros(count, len(offsets)).index_add(1, of_query, seen)
    return total / values.new_zeros(count, len(offsets)).index_add(1, of_query, there)
