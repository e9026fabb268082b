"""Two small neural fields, trained on the spot: a SIREN with the eikonal loss, an occupancy net.

Each is measured against its own zero set: whether the network learned the shape is not the
question. Needs PyTorch.

References
----------
Sitzmann et al., "Implicit Neural Representations with Periodic Activation Functions", 2020.
Mescheder et al., "Occupancy Networks", 2019.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.field_forms import Form, ball, box, smooth_difference

STEPS, POINTS = 400, 2000
OMEGA = 20.0
WIDTH = 64
CHUNK = 1 << 16


def shape(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the field of the solid that both learn: a box with a hollow."""
    return smooth_difference(box(x, y, z, 0.32, 0.24, 0.2), ball(x, y, z, 0.25, 0.2), 0.05)


class Siren(nn.Module):
    """Three hidden layers with sines."""

    def __init__(self) -> None:
        super().__init__()
        sizes = (3, WIDTH, WIDTH, WIDTH)
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.last = nn.Linear(WIDTH, 1)
        for number, layer in enumerate(self.hidden):
            bound = 1 / 3 if number == 0 else (6 / WIDTH) ** 0.5 / OMEGA
            nn.init.uniform_(layer.weight, -bound, bound)

    def forward(self, points: Tensor) -> Tensor:
        """Map points (n, 3) to values (n,)."""
        for layer in self.hidden:
            points = torch.sin(OMEGA * layer(points))
        return self.last(points)[:, 0]


def occupancy_net() -> nn.Module:
    """Return a net with softplus layers, whose values are logits of being outside."""
    layers: list[nn.Module] = []
    for before in (3, 128, 128, 128):
        layers += [nn.Linear(before, 128), nn.Softplus(beta=20)]
    return nn.Sequential(*layers, nn.Linear(128, 1), nn.Flatten(0))


def train_siren() -> nn.Module:
    """Train a SIREN on distances, with unit gradients."""
    net, random = Siren(), np.random.default_rng(0)
    optimiser = torch.optim.Adam(net.parameters(), 1e-3)
    for _ in range(STEPS):
        points = random.uniform(-0.5, 0.5, (POINTS, 3))
        target = torch.tensor(shape(*points.T), dtype=torch.float32)
        at = torch.tensor(points, dtype=torch.float32, requires_grad=True)
        value = net(at)
        slope = torch.autograd.grad(value.sum(), at, create_graph=True)[0].norm(dim=1)
        loss = (value - target).abs().mean() + 0.01 * (slope - 1).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return net


def train_occupancy() -> nn.Module:
    """Train a net to tell inside from outside."""
    net, random = occupancy_net(), np.random.default_rng(0)
    optimiser = torch.optim.Adam(net.parameters(), 2e-3)
    loss_of = nn.BCEWithLogitsLoss()
    for _ in range(STEPS):
        points = random.uniform(-0.5, 0.5, (POINTS, 3))
        outside = torch.tensor(shape(*points.T) > 0, dtype=torch.float32)
        loss = loss_of(net(torch.tensor(points, dtype=torch.float32)), outside)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return net


def as_form(net: nn.Module) -> Form:
    """Return a network as a function of coordinates."""

    def form(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        points = torch.tensor(np.stack([x, y, z], -1).reshape(-1, 3), dtype=torch.float32)
        with torch.no_grad():
            parts = [net(chunk).numpy() for chunk in points.split(CHUNK)]
        return np.concatenate(parts).reshape(x.shape)

    return form


def neural_forms() -> dict[str, Form]:
    """Train both networks, in about a minute; return them by name."""
    torch.manual_seed(0)
    return {"SIREN": as_form(train_siren()), "occupancy net": as_form(train_occupancy())}
