"""Neural Dual Contouring by its authors' code and weights, as a peer.

Reference: Chen, Tagliasacchi, Funkhouser and Zhang, "Neural Dual Contouring", 2022. Their
repository, github.com/czq142857/NDC, has weights for signed distances at commit c036901. Nothing of
it is in this one: the option ``--ndc`` names a checkout.
"""

from __future__ import annotations

import os
from argparse import ArgumentParser
from functools import lru_cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from super_sdf.errors import OptionError
from super_sdf.network.decoder import Decoder
from super_sdf.surface.mesh import Mesh

from .shapes import Case
from .surfaces import EMPTY, Surface

FOLDER = "NDC_FOLDER"  # variable of the environment that the processes of a run inherit
PADDING, FAR, CLIPPED = 3, 10.0, 2.0  # samples of the receptive field; voxels, as they are trained


def add_ndc(parser: ArgumentParser) -> None:
    """Add the option that names a checkout of NDC."""
    parser.add_argument("--ndc", type=name_folder, metavar="FOLDER", help="checkout of NDC c036901")


def name_folder(folder: str) -> str:
    """Keep the folder for this process and those that it starts."""
    os.environ[FOLDER] = folder
    return folder


def neural_dual_contouring(case: Case, network: Decoder) -> Surface:
    """Mesh the grid by NDC; a sample lies at whole numbers of its lattice."""
    import torch

    distances = np.asarray(case.grid.values, np.float32) / np.float32(case.spacing)
    far = np.copysign(FAR, distances[0, 0, 0])
    padded = np.pad(distances, PADDING, constant_values=far).clip(-CLIPPED, CLIPPED)
    with torch.no_grad():
        inner = _network()(torch.from_numpy(padded)[None, None])[0].clamp(0, 1)
    places = np.ascontiguousarray(np.moveaxis(inner.numpy(), 0, 3))
    contour = _module("utils").dual_contouring_ndc_test
    vertices, triangles = contour((distances < 0).astype(np.int32), places)
    if not len(triangles):
        return Surface(EMPTY)
    low = case.low + case.spacing / 2
    return Surface(Mesh(low + case.spacing * vertices, np.asarray(triangles, np.int32)))


@lru_cache(maxsize=1)
def _network() -> Any:
    """Return the network for distances, with its weights."""
    import torch

    net = _module("model").CNN_3d_rec7(out_bool=False, out_float=True)
    weights = torch.load(_path("network_float.pth"), map_location="cpu", weights_only=True)
    net.load_state_dict(weights)
    return net.eval()


@lru_cache
def _module(name: str) -> ModuleType:
    spec = spec_from_file_location(f"ndc_{name}", _path(f"{name}.py"))
    assert spec and spec.loader
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _path(name: str) -> Path:
    path = Path(os.environ.get(FOLDER, ""), name)
    if FOLDER not in os.environ or not path.exists():
        raise OptionError(f"{path} is missing: give a checkout of NDC at c036901 (--ndc FOLDER)")
    return path
