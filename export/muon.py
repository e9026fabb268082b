"""Muon for many matrices at once: those of one shape are updated together.

``torch.optim.Muon`` updates one matrix after the other, some 25 small operations each. On a GPU
that takes a third of a step of the network, since each operation is far too small for it.

References
----------
Jordan et al.: Muon, an optimizer for hidden layers in neural networks, 2024.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn


class StackedMuon(torch.optim.Muon):
    """``torch.optim.Muon``, with one product for all matrices of a shape; all need gradients."""

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:
        """Update all matrices."""
        for group in self.param_groups:
            for matrices in by_shape(group["params"]):
                self._update(matrices, group)

    def _update(self, matrices: list[nn.Parameter], group: dict[str, Any]) -> None:
        """Update matrices of one shape."""
        grads = [matrix.grad for matrix in matrices]
        moments = [self._moment(matrix) for matrix in matrices]
        torch._foreach_lerp_(moments, grads, 1 - group["momentum"])
        ahead = torch._foreach_lerp(grads, moments, group["momentum"])
        updates = orthogonal(torch.stack(ahead), group["ns_coefficients"], group["ns_steps"])
        rate = group["lr"] * 0.2 * max(matrices[0].shape) ** 0.5  # match_rms_adamw
        torch._foreach_mul_(matrices, 1 - group["lr"] * group["weight_decay"])
        torch._foreach_add_(matrices, list(updates.to(matrices[0].dtype)), alpha=-rate)

    def _moment(self, matrix: nn.Parameter) -> Tensor:
        """Return the running mean of a matrix's gradient."""
        state = self.state[matrix]
        if "momentum_buffer" not in state:
            state["momentum_buffer"] = torch.zeros_like(matrix)
        moment: Tensor = state["momentum_buffer"]
        return moment


def by_shape(matrices: Iterable[nn.Parameter]) -> list[list[nn.Parameter]]:
    """Return the matrices in lists of one shape each."""
    lists: dict[torch.Size, list[nn.Parameter]] = {}
    for matrix in matrices:
        lists.setdefault(matrix.shape, []).append(matrix)
    return list(lists.values())


def orthogonal(matrices: Tensor, coefficients: tuple[float, float, float], steps: int) -> Tensor:
    """Return the nearest matrices of equal singular values, nearly, (n, r, c) bfloat16.

    Newton-Schulz iterations, as in ``torch.optim.Muon``.
    """
    a, b, c = coefficients
    tall = matrices.shape[1] > matrices.shape[2]
    wide = (matrices.mT if tall else matrices).bfloat16()
    wide = wide / wide.norm(dim=(1, 2), keepdim=True).clamp(min=1e-7)
    for _ in range(steps):
        gram = wide @ wide.mT
        wide = a * wide + (b * gram + c * gram @ gram) @ wide
    return wide.mT if tall else wide
