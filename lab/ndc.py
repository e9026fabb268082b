"""Neural Dual Contouring by its authors' code and weights, as a peer.

Reference: Chen, Tagliasacchi, Funkhouser and Zhang, "Neural Dual Contouring", 2022. Their
repository, github.com/czq142857/NDC, has weights for signed distances at commit c036901. Nothing of
it is in this one: the option ``--ndc`` names a checkout.
"""

from __future__ import annotations

import os
import sys
from argparse import ArgumentParser
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from super_sdf.errors import OptionError
from super_sdf.network.contract import Decoder
from super_sdf.surface.mesh import Mesh

from .shapes import Case
from .surfaces import EMPTY, Surface

FOLDER = "NDC_FOLDER"  # variable of the environment that the processes of a run inherit
PADDING, FAR, CLIPPED = 3, 10.0, 2.0  # samples of the receptive field; voxels, as they are trained


def add_ndc(parser: ArgumentParser) -> None:
    parser.add_argument("--ndc", type=name_folder, metavar="FOLDER", help="checkout of NDC c036901")


def name_folder(folder: str) -> str:
    """Keep the folder for this process and those that it starts."""
    os.environ[FOLDER] = folder
    return folder


def neural_dual_contouring(case: Case, network: Decoder) -> Surface:
    """Mesh the grid by NDC; a sample lies at whole numbers of its lattice."""
    import torch

    net, contour = peer()
    distances = np.asarray(case.grid.values, np.float32) / np.float32(case.spacing)
    far = np.copysign(FAR, distances[0, 0, 0])
    padded = np.pad(distances, PADDING, constant_values=far).clip(-CLIPPED, CLIPPED)
    with torch.no_grad():
        inner = net(torch.from_numpy(padded)[None, None])[0].clamp(0, 1)
    places = np.ascontiguousarray(np.moveaxis(inner.numpy(), 0, 3))
    vertices, triangles = contour((distances < 0).astype(np.int32), places)
    if not len(triangles):
        return Surface(EMPTY)
    low = case.low + case.spacing / 2
    return Surface(Mesh(low + case.spacing * vertices, np.asarray(triangles, np.int32)))


@lru_cache(maxsize=1)
def peer() -> tuple[Any, Any]:
    """Return the network for distances, with its weights, and the function that meshes."""
    import torch

    folder = Path(os.environ.get(FOLDER, ""))
    weights = folder / "network_float.pth"
    if not weights.exists():
        raise OptionError(f"{weights} is missing: give a checkout of NDC at c036901 (--ndc FOLDER)")
    sys.path.insert(0, str(folder))
    model, utils = import_module("model"), import_module("utils")
    net = model.CNN_3d_rec7(out_bool=False, out_float=True)
    net.load_state_dict(torch.load(weights, map_location="cpu", weights_only=True))
    return net.eval(), utils.dual_contouring_ndc_test
