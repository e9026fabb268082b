"""Muon for many matrices at once: those of one shape are updated together.

``torch.optim.Muon`` updates one matrix after the other, some 25 small operations each. On a GPU
that takes a third of a step of the network, since each operation is far too small for it.

References
----------
Jordan et al.: Muon, an optimizer for hidden layers in neural networks, 2024.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn


class StackedMuon(torch.optim.Muon):
    """``torch.optim.Muon``, with one product for all matrices of a shape; all need gradients."""

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:
        for group in self.param_groups:
            by_shape: dict[torch.Size, list[nn.Parameter]] = {}
            for matrix in group["params"]:
                by_shape.setdefault(matrix.shape, []).append(matrix)
            for matrices in by_shape.values():
                self._update(matrices, group)

    def _update(self, matrices: list[nn.Parameter], group: dict[str, Any]) -> None:
        """Update matrices of one shape."""
        for matrix in matrices:
            if "momentum_buffer" not in self.state[matrix]:
                self.state[matrix]["momentum_buffer"] = torch.zeros_like(matrix)
        grads = [matrix.grad for matrix in matrices]
        moments = [self.state[matrix]["momentum_buffer"] for matrix in matrices]
        torch._foreach_lerp_(moments, grads, 1 - group["momentum"])
        ahead = torch._foreach_lerp(grads, moments, group["momentum"])
        updates = orthogonal(torch.stack(ahead), group["ns_coefficients"], group["ns_steps"])
        rate = group["lr"] * 0.2 * max(matrices[0].shape) ** 0.5  # match_rms_adamw
        torch._foreach_mul_(matrices, 1 - group["lr"] * group["weight_decay"])
        torch._foreach_add_(matrices, list(updates.to(matrices[0].dtype)), alpha=-rate)


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
