"""Tensors of PyTorch are taken as they come out of a model."""

import runpy
import sys
from pathlib import Path

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


def test_the_example_of_a_neural_field(tmp_path, monkeypatch, capsys):
    script = Path(__file__).parents[2] / "examples" / "tools" / "neural_field.py"
    monkeypatch.setattr(sys, "argv", [script.name, str(tmp_path / "ring.ply")])
    found = runpy.run_path(str(script), run_name="__main__")
    assert "closed: True" in capsys.readouterr().out
    assert found["off"] < 2e-3 and 10 * found["field"].evaluations < found["dense"]
