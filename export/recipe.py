"""How a network is trained and measured: loss, optimisers, rates, errors on held-out samples."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from export.augment import USUAL, Prepared, Shares
from export.batches import Batch, encode, means, predict, singly
from export.dataset import CORNERS
from export.muon import StackedMuon
from export.network import Encoded, SuperSdfNet


@dataclass(frozen=True)
class Recipe:
    """The hyperparameters of a run."""

    hidden_rate: float = 4e-3  # of the blocks; 2e-3 and 1e-2 are worse
    outer_rate: float = 2e-3
    warm_up: float = 0.03  # share of the budget
    batch_voxels: int = 12_000  # small enough for the arrays of a step to stay in cache
    average_decay: float = 0.998  # of the averaged weights, per step
    voxel_power: float = 0.5  # of the number of voxels of a sample, for its weight in a batch
    spread: float = 3.0  # of the chances of windows, by their loss; 1: equal (``store``)
    reach: float = 0.5  # half voxels: decay length of the weight away from the surface ...
    far_weight: float = 0.25  # ... to this
    gradient_weight: float = 0.5
    first_weight: float = 0.2  # of the loss after the first blocks of a gated network
    gate_weight: float = 0.01  # of the error of what its gate says of that loss
    shares_gated: tuple[float, float] = (0.05, 0.5)  # of a batch's voxels, drawn between these
    revive_steps: int = 300  # between restarts of dormant units; 0 for never
    revive_until: float = 0.8  # share of the budget: restarted units need time to learn
    shares: Shares = USUAL


RECIPE = Recipe()


def differences(values: Tensor) -> Tensor:
    """Return the gradients, (D, CORNERS, 3), of values (D, Q) at the corners: see ``dataset``."""
    quadruples = values[:, : 4 * CORNERS].view(len(values), CORNERS, 4)
    return 2 * (quadruples[:, :, 1:] - quadruples[:, :, :1])


def nearness(target: Tensor, recipe: Recipe) -> Tensor:
    """Return the weight of an error: larger near the surface, where it moves the mesh."""
    return recipe.far_weight + torch.exp(-target.abs() / recipe.reach)


def voxel_losses(prediction: Tensor, target: Tensor, recipe: Recipe) -> Tensor:
    """Return the loss of each voxel, (D,): the weighted error of values and of their gradient."""
    error = (prediction - target).abs()
    loss = (nearness(target, recipe) * error).mean(1)
    corners = nearness(target[:, : 4 * CORNERS : 4], recipe)
    apart = (differences(prediction) - differences(target)).abs().sum(2)
    return loss + recipe.gradient_weight * (corners * apart).mean(1)


def window_losses(net: SuperSdfNet, batch: Batch, recipe: Recipe) -> Tensor:
    """Return the loss of each sample of a batch, (B,).

    Of a gated network, at a share of voxels drawn at random, it is also that after the first
    blocks, and the error of what the gate says of this.
    """
    if not net.config.gated:
        return means(batch_losses(net, batch, encode(net, batch), recipe), batch)
    low, high = recipe.shares_gated
    encoded = encode(net, batch, low + (high - low) * float(torch.rand(())))
    of_first = batch_losses(net, batch, replace(encoded, features=encoded.early), recipe)
    apart = encoded.doubts[batch.voxels] - of_first.detach().log()
    loss = recipe.first_weight * of_first + recipe.gate_weight * apart.abs()
    if high:
        loss = loss + batch_losses(net, batch, encoded, recipe)
    return means(loss, batch)


def batch_losses(net: SuperSdfNet, batch: Batch, encoded: Encoded, recipe: Recipe) -> Tensor:
    """Return the loss of each voxel with targets of a batch, (D,)."""
    return voxel_losses(predict(net, batch, encoded), batch.targets, recipe)


def relative_weights(voxels: list[int], recipe: Recipe) -> Tensor:
    """Return the weights of the losses of samples by their numbers of voxels, (B,); the sum is 1.

    Small shapes have few voxels and large errors. With equal weights they make up more than half of
    the loss, and of its noise; weighted by voxels they would hardly count.
    """
    weights = torch.tensor(voxels, dtype=torch.float32) ** recipe.voxel_power
    return weights / weights.sum()


def make_optimisers(net: SuperSdfNet, recipe: Recipe) -> list[torch.optim.Optimizer]:
    """Return Muon for the matrices of the blocks, AdamW for all other parameters."""
    blocks = {id(p) for p in net.all_blocks().parameters() if p.ndim == 2}
    hidden = [p for p in net.trained() if id(p) in blocks]
    others = [p for p in net.trained() if id(p) not in blocks]
    rate = {"lr": recipe.hidden_rate, "adjust_lr_fn": "match_rms_adamw"}
    return [
        torch.optim.AdamW(others, lr=recipe.outer_rate, weight_decay=1e-3),
        *([StackedMuon(hidden, weight_decay=1e-3, **rate)] if hidden else []),
    ]


def rate_factor(spent: float, recipe: Recipe) -> float:
    """Return the rate over its peak after this share of the budget: warm-up, then half a cosine."""
    cosine = 0.5 * (1 + np.cos(np.pi * min(spent, 1.0)))
    return float(min(spent / recipe.warm_up, cosine) + 1e-3)


NEAR = 0.5  # half voxels from the surface: limit for normals; half of it for values


@dataclass(frozen=True)
class Errors:
    """Mean errors on held-out samples; the first two in voxels."""

    everywhere: float
    near: float  # within an eighth of a voxel of the surface
    normal: float  # 1 - cosine between the gradients near the surface

    def cells(self) -> list[str]:
        return [f"{self.everywhere:.5f}", f"{self.near:.5f}", f"{self.normal:.4f}"]


def measure(net: SuperSdfNet, samples: list[Prepared]) -> Errors:
    """Return the errors on held-out samples, in float32, as the exported network computes."""
    with torch.no_grad():
        errors = [
            sample_errors(predict(net, batch, encode(net, batch)), batch.targets)
            for batch in singly(net, samples)
        ]
    return Errors(*np.nanmean(errors, axis=0).tolist())


def sample_errors(prediction: Tensor, target: Tensor) -> list[float]:
    """Return the errors of one sample; NaN where nothing is near the surface."""
    error = (prediction - target).abs() / 2
    corners = target[:, : 4 * CORNERS : 4].abs() < NEAR
    got, wanted = differences(prediction)[corners], differences(target)[corners]
    cosine = torch.nn.functional.cosine_similarity(got, wanted, dim=1)
    near = error[target.abs() < NEAR / 2]
    return [float(error.mean()), float(near.mean()), float(1 - cosine.mean())]
