"""Tensors of PyTorch are taken as they come out of a model."""

import numpy as np
import pytest
import torch

from super_sdf import DistanceFunction, make_grid, reconstruct

H = 0.1
BOX = (-0.9, 0.9)


class Ball(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.radius = torch.nn.Parameter(torch.tensor(0.55))

    def forward(self, points):
        return points.norm(dim=1, keepdim=True) - self.radius


def asked(points):
    """Return distances with gradients, (n, 1) float32."""
    return Ball()(torch.as_tensor(points, dtype=torch.float32))


def test_a_model_makes_a_mesh():
    mesh = reconstruct(function=asked, bounds=BOX, spacing=H)
    off = np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.55) / H
    assert off.mean() < 1e-4 and mesh.is_closed()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_samples_may_be_a_tensor(dtype):
    values = DistanceFunction(asked).sample(BOX, H).values
    tensor = torch.tensor(values, dtype=dtype, requires_grad=True)
    grid = make_grid(tensor, spacing=H, field="exact")
    np.testing.assert_allclose(grid.values, values, atol=4e-3)
