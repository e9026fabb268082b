"""Samples that several tests share."""

import numpy as np
import pytest

from export.dataset import make_sample
from export.shapes.solid import random_solid
from export.tests.small_net import small_net
from export.to_onnx import make_card, write_model


@pytest.fixture(scope="session")
def samples():
    """Three samples of procedural shapes."""
    rng, found = np.random.default_rng(0), []
    while len(found) < 3:
        sample = make_sample(rng, random_solid(rng, ["csg", "blobs"]))
        found += [sample] if sample else []
    return found


@pytest.fixture
def small_file(tmp_path):
    """The file of ``small_net``."""
    net, path = small_net(), tmp_path / "small.onnx"
    write_model(net, path, make_card(net, "small", "nothing", "none"))
    return path
