"""Sparse super-resolution of signed distance grids: a coarse grid in, a fine mesh out.

>>> from super_sdf import make_grid, reconstruct
>>> mesh = reconstruct(make_grid(values, spacing=0.1))            # doctest: +SKIP

Names are imported on first use, so that a conversion does not load what it does without.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .errors import SuperSdfError as SuperSdfError
    from .files.fields import read_field as read_field, write_field as write_field
    from .files.grids import grid_from_image as grid_from_image, read_grid as read_grid
    from .files.meshes import write_mesh as write_mesh
    from .functions.function import DistanceFunction as DistanceFunction
    from .grid.sdf_grid import SdfGrid as SdfGrid, make_grid as make_grid
    from .labels.reconstruct import reconstruct_labels as reconstruct_labels
    from .network.network import load_network as load_network
    from .pipeline import (
        extract_mesh as extract_mesh,
        reconstruct as reconstruct,
        upsample as upsample,
    )
    from .refine.field import FineField as FineField, fine_grid as fine_grid
    from .simplify.simplify import simplify_mesh as simplify_mesh
    from .surface.mesh import Mesh as Mesh

MODULES = {
    "errors": "SuperSdfError",
    "files.fields": "read_field write_field",
    "files.grids": "grid_from_image read_grid",
    "files.meshes": "write_mesh",
    "functions.function": "DistanceFunction",
    "grid.sdf_grid": "SdfGrid make_grid",
    "labels.reconstruct": "reconstruct_labels",
    "network.network": "load_network",
    "pipeline": "extract_mesh reconstruct upsample",
    "refine.field": "FineField fine_grid",
    "simplify.simplify": "simplify_mesh",
    "surface.mesh": "Mesh",
}
HOMES = {name: module for module, names in MODULES.items() for name in names.split()}
__all__ = ["__version__", *HOMES]


def __getattr__(name: str) -> Any:
    """Import a public name from the module that defines it."""
    if name not in HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    """List the public names, whether imported yet or not."""
    return list(__all__)
