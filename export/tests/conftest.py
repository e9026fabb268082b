"""Samples and networks that several tests share."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from export.augment import CLEAN, DISTANCES, change
from export.dataset import make_sample
from export.network import NetworkConfig, SuperSdfNet
from export.shapes.solid import random_solid

SMALL = NetworkConfig(channels=16, blocks=4, hidden=32, functions=40, trunk=16, frequencies=2)


@pytest.fixture(scope="session")
def samples():
    """Three samples of procedural shapes."""
    rng, found = np.random.default_rng(0), []
    while len(found) < 3:
        sample = make_sample(rng, random_solid(rng, ["csg", "blends"]))
        found += [sample] if sample else []
    return found


@pytest.fixture(scope="session")
def prepared(samples):
    rng = np.random.default_rng(0)
    return [change(rng, sample, DISTANCES, CLEAN) for sample in samples]


@pytest.fixture(params=["plain", "gated"])
def net(request):
    """A network away from the start, where blocks do nothing; half of the voxels pass its gate.

    The blocks of the gated one see 27, 19 or 7 places, the first ones of these 12 channels.
    """
    torch.manual_seed(0)
    gated = replace(SMALL, gated=2, places=(27, 19, 7, 19, 7), seen=12)
    made = SuperSdfNet(gated if request.param == "gated" else SMALL)
    for parameter in made.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return made.eval()
