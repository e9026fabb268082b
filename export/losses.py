"""Samples side by side as a batch, what the network says of them, and what is lost.

A query on a face, edge or corner of its voxel (an offset of -1 or 1) is a query of the neighbours
there, too, and the isosurface gets the mean (Eq. 7). So the loss is that of the mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from torch import Tensor

from export.augment import USUAL, Prepared, Shares
from export.dataset import CORNERS
from export.network import Encoded, SuperSdfNet
from super_sdf.arrays import CENTRE, STRIDES


@dataclass(frozen=True)
class Recipe:
    """The hyperparameters of a run."""

    hidden_rate: float = 4e-3  # of the blocks; 2e-3 and 1e-2 are worse
    outer_rate: float = 2e-3
    warm_up: float = 0.03  # share of the budget
    batch_voxels: int = 12_000  # small enough for the arrays of a step to stay in cache
    average_decay: float = 0.998  # of the averaged weights, per step
    voxel_power: float = 0.5  # of the number of voxels of a sample, for its weight in a batch
    spread: float = 3.0  # of the chances of windows, by their loss (``store``)
    smooth: float = 0.3  # share of windows of smooth bodies, if there are any, drawn alike
    reach: float = 0.5  # half voxels: decay length of the weight away from the surface ...
    far_weight: float = 0.25  # ... to this
    gradient_weight: float = 0.5
    bias_weight: float = 1.0  # of a window's mean error near the surface, for masks
    first_weight: float = 0.2  # of the loss after the first blocks of a gated network
    gate_weight: float = 0.01  # of the error of what its gate says of that loss
    shares_gated: tuple[float, float] = (0.05, 0.5)  # of the voxels that can hold the surface
    shares: Shares = USUAL


RECIPE = Recipe()


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


def copies_of_queries(offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return query (M,), place (M,) and offset there (M, 3) of all copies of queries (Q, 3).

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


def batch_of(samples: Sequence[Prepared]) -> Batch:
    device = samples[0].patches.device
    band = np.cumsum([0] + [len(sample.patches) for sample in samples])
    some = np.cumsum([0] + [len(sample.voxels) for sample in samples])
    queries = len(samples[0].offsets)
    copies = [copies_of_queries(sample.offsets.cpu().numpy()) for sample in samples]
    room = [max(len(query) for query, *_ in copies) - len(query) for query, *_ in copies]
    query = [np.pad(q, (0, n), constant_values=queries) for (q, *_), n in zip(copies, room)]
    place = [np.pad(p, (0, n)) for (_, p, _), n in zip(copies, room)]
    moved = [np.pad(m, ((0, n), (0, 0))).astype(np.float32) for (*_, m), n in zip(copies, room)]

    def put(arrays: list[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.stack(arrays)).to(device)

    return Batch(
        patches=torch.cat([sample.patches for sample in samples]),
        table=side_by_side([sample.table for sample in samples], band),
        voxels=torch.cat([sample.voxels + int(at) for sample, at in zip(samples, band)]),
        near=side_by_side([near_of(sample) for sample in samples], some),
        window=torch.from_numpy(np.repeat(np.arange(len(samples)), np.diff(some))).to(device),
        counts=np.diff(some).tolist(),
        query=put(query),
        place=put(place),
        moved=put(moved),
        targets=torch.cat([sample.targets for sample in samples]),
    )


def near_of(sample: Prepared) -> Tensor:
    """Return which of the D voxels with targets are at the 27 places round each, -1 for none."""
    rows = sample.table.new_full((len(sample.table) + 1,), -1)
    rows[sample.voxels] = torch.arange(len(sample.voxels), device=rows.device)
    return rows[sample.table[sample.voxels]]


def side_by_side(tables: Sequence[Tensor], starts: np.ndarray) -> Tensor:
    """Join tables of rows; those absent, -1, become the number of all rows."""
    end, pairs = int(starts[-1]), zip(tables, starts.tolist())
    return torch.cat([torch.where(table < 0, end, table + at) for table, at in pairs])


def predict(net: SuperSdfNet, batch: Batch, encoded: Encoded | None = None) -> Tensor:
    """Return the values (D, Q) of a batch, encoded or not; those of shared nodes are averaged."""
    voxels = (encoded or net.encode_all(batch.patches, batch.table)).some(batch.voxels)
    values = net.decode(voxels, batch.counts, batch.moved)
    rows = batch.near.gather(1, batch.place[batch.window])
    query, there = batch.query[batch.window], (rows < len(values)).to(values.dtype)
    seen = torch.cat([values, values.new_zeros(1, values.shape[1])]).gather(0, rows)
    none = values.new_zeros(len(values), batch.targets.shape[1] + 1)
    total = none.scatter_add(1, query, seen) / none.scatter_add(1, query, there).clamp(min=1)
    return total[:, :-1]


def differences(values: Tensor) -> Tensor:
    """Return the gradients, (D, CORNERS, 3), of values (D, Q) at the corners: see ``dataset``."""
    quadruples = values[:, : 4 * CORNERS].view(len(values), CORNERS, 4)
    return 2 * (quadruples[:, :, 1:] - quadruples[:, :, :1])


def weights_near(target: Tensor, recipe: Recipe) -> Tensor:
    """Return the weight of each value: more near the surface, where it moves the mesh."""
    return recipe.far_weight + torch.exp(-target.abs() / recipe.reach)


def voxel_losses(prediction: Tensor, target: Tensor, recipe: Recipe) -> Tensor:
    """Return the loss of each voxel, (D,): the error of values and of their gradient."""
    weight = weights_near(target, recipe)
    loss = (weight * (prediction - target).abs()).mean(1)
    apart = (differences(prediction) - differences(target)).abs().sum(2)
    return loss + recipe.gradient_weight * (weight[:, : 4 * CORNERS : 4] * apart).mean(1)


def window_losses(net: SuperSdfNet, batch: Batch, recipe: Recipe) -> Tensor:
    """Return the loss of each sample of a batch, (B,).

    Of a gated network, at a share of voxels drawn at random, it is also that after the first
    blocks, and the error of what the gate says of this. Of masks it is also the mean error of a
    sample: a mask hardly tells a curved surface from a flat one, which has the least loss a voxel.
    """
    encoded, of_gate = None, batch.targets.new_zeros(())
    if net.config.gated:
        low, high = recipe.shares_gated
        share = low + (high - low) * float(torch.rand(()))
        encoded = net.encode_all(batch.patches, batch.table, share)
        first = predict(net, batch, replace(encoded, features=encoded.early))
        of_first = voxel_losses(first, batch.targets, recipe)
        apart = encoded.doubts[batch.voxels] - of_first.detach().log()
        of_gate = recipe.first_weight * of_first + recipe.gate_weight * apart.abs()
    values = predict(net, batch, encoded)
    losses = window_means(of_gate + voxel_losses(values, batch.targets, recipe), batch)
    if net.config.keeps_samples:
        return losses
    off = weights_near(batch.targets, recipe) * (values - batch.targets)
    return losses + recipe.bias_weight * window_means(off.mean(1), batch).abs()


def window_means(values: Tensor, batch: Batch) -> Tensor:
    """Return the mean of values of voxels, (D,), in each sample, (B,)."""
    sums = values.new_zeros(len(batch.counts)).index_add(0, batch.window, values)
    return sums / torch.tensor(batch.counts, device=values.device)


NEAR = 0.5  # half voxels from the surface: limit for normals; half of it for values


@dataclass(frozen=True)
class Errors:
    """Mean errors of samples, in voxels but for the normals."""

    everywhere: float
    near: float  # within an eighth of a voxel of the surface
    normal: float  # 1 - cosine between the gradients near the surface
    bias: float  # of the values near the surface, over 0 where it is made too flat

    def cells(self) -> list[str]:
        return [f"{self.everywhere:.5f}", f"{self.near:.5f}", f"{self.normal:.4f}"]


def measure(net: SuperSdfNet, samples: Sequence[Prepared]) -> Errors:
    """Return the errors of samples, in float32, as the exported network computes."""
    with torch.no_grad():
        device = net.correction.weight.device
        batches = [batch_of([sample.on(device)]) for sample in samples]
        errors = [errors_of(predict(net, batch), batch) for batch in batches]
    return Errors(*np.nanmean(errors, axis=0).tolist())


def errors_of(prediction: Tensor, batch: Batch) -> list[float]:
    """Return the errors of a batch of one sample; NaN where nothing is near the surface."""
    target, apart = batch.targets, (prediction - batch.targets) / 2
    corners = target[:, : 4 * CORNERS : 4].abs() < NEAR
    got, wanted = differences(prediction)[corners], differences(target)[corners]
    cosine = torch.nn.functional.cosine_similarity(got, wanted, dim=1)
    near = apart[target.abs() < NEAR / 2]
    convex = batch.patches[:, CENTRE].sign().sum().sign()  # fewer samples are on that side
    errors = apart.abs().mean(), near.abs().mean(), 1 - cosine.mean(), near.mean() * convex
    return [float(error) for error in errors]
