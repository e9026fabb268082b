"""Samples side by side as one batch, and what the network says of it as the runtime takes it.

A query on a face, edge or corner of its voxel (an offset of -1 or 1) is a query of the neighbours
there, too, and the isosurface gets the mean (Eq. 7). So the loss is that of the mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from torch import Tensor

from export.augment import Prepared, batch_table
from export.network import Encoded, SuperSdfNet
from super_sdf.network.neighbourhood import CENTRE, STRIDES
from super_sdf.refine.nodes import rows_among


@dataclass(frozen=True, eq=False)
class Batch:
    """Samples side by side on a device.

    A query has copies in the voxels that share it; each sample has M of them, of which the last
    ones may belong to no query.
    """

    patches: Tensor  # (V, 27) float32
    table: Tensor  # (V, 27) rows of the band, V where absent
    voxels: Tensor  # (D,) rows of the band that have targets
    near: Tensor  # (D, 27) which of the D voxels are around each, D where none
    window: Tensor  # (D,) sample that each belongs to
    counts: list[int]  # voxels with targets of each sample, (B,)
    query: Tensor  # (B, M) query of a copy, Q for none
    place: Tensor  # (B, M) of the 27
    moved: Tensor  # (B, M, 3) float32, its offset there
    targets: Tensor  # (D, Q) float32


@dataclass(frozen=True, eq=False)
class Copies:
    """The copies of a sample's queries in all voxels that share them, (M, ...)."""

    query: np.ndarray
    place: np.ndarray
    moved: np.ndarray  # (M, 3) offset there

    def padded(self, count: int, queries: int) -> Copies:
        """Return ``count`` copies; those added belong to query ``queries``, which is none."""
        room = count - len(self.query)
        return Copies(
            np.pad(self.query, (0, room), constant_values=queries),
            np.pad(self.place, (0, room)),
            np.pad(self.moved, ((0, room), (0, 0))).astype(np.float32),
        )


def copies_of_queries(offsets: np.ndarray) -> Copies:
    """Return all copies of the queries at offsets (Q, 3).

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
    return Copies(np.concatenate(queries), np.concatenate(places), np.concatenate(moved))


def neighbours_with_targets(sample: Prepared) -> np.ndarray:
    """Return which of the D voxels with targets are at the 27 places round each, (D, 27) int64.

    It is -1 where there is none.
    """
    return rows_among(sample.voxels, len(sample.table))[sample.table[sample.voxels]]


def batch_of(samples: Sequence[Prepared], device: torch.device | str = "cpu") -> Batch:
    counts = [len(sample.voxels) for sample in samples]
    starts = np.cumsum([0] + [len(sample.patches) for sample in samples])
    copies = [copies_of_queries(sample.offsets) for sample in samples]
    most = max(len(each.query) for each in copies)
    copies = [each.padded(most, len(s.offsets)) for each, s in zip(copies, samples)]

    def put(array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(device)

    return Batch(
        patches=put(np.concatenate([sample.patches for sample in samples])),
        table=put(batch_table([sample.table for sample in samples])),
        voxels=put(np.concatenate([s.voxels + at for s, at in zip(samples, starts)])),
        near=put(batch_table([neighbours_with_targets(s) for s in samples]).astype(np.int64)),
        window=put(np.repeat(np.arange(len(samples)), counts)),
        counts=counts,
        query=put(np.stack([each.query for each in copies])),
        place=put(np.stack([each.place for each in copies])),
        moved=put(np.stack([each.moved for each in copies])),
        targets=put(np.concatenate([sample.targets for sample in samples])),
    )


def singly(net: SuperSdfNet, samples: Sequence[Prepared]) -> list[Batch]:
    """Return each sample as a batch of its own, on the device of a network."""
    device = next(net.parameters()).device
    return [batch_of([sample], device) for sample in samples]


def encode(net: SuperSdfNet, batch: Batch, share: float | None = None) -> Encoded:
    """Return the inputs of the head for all voxels of the band; for ``share`` see ``Gate.rows``."""
    return net.encode_all(batch.patches, batch.table, share)


def predict(net: SuperSdfNet, batch: Batch, encoded: Encoded) -> Tensor:
    """Return the values (D, Q) of a batch that was encoded; those of shared nodes are averaged."""
    voxels = encoded.some(batch.voxels)
    values = net.decode_parts(voxels, batch.counts, batch.moved)
    rows = batch.near.gather(1, batch.place[batch.window])
    query, there = batch.query[batch.window], (rows < len(values)).to(values.dtype)
    seen = torch.cat([values, values.new_zeros(1, values.shape[1])]).gather(0, rows)
    none = values.new_zeros(len(values), batch.targets.shape[1] + 1)
    total = none.scatter_add(1, query, seen) / none.scatter_add(1, query, there).clamp(min=1)
    return total[:, :-1]


def means(values: Tensor, batch: Batch) -> Tensor:
    """Return the mean of values (D,) of each sample of a batch, (B,)."""
    counts = torch.tensor(batch.counts, device=values.device)
    sums = values.new_zeros(len(batch.counts)).index_add(0, batch.window, values)
    return sums / counts
