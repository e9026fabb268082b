"""Sparse super-resolution of signed distance grids: a coarse grid in, a fine mesh out.

>>> from super_sdf import reconstruct
>>> mesh = reconstruct(values, spacing=0.1)                       # doctest: +SKIP

Names are imported on first use, so that a conversion loads only the modules that it needs.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .errors import SuperSdfError as SuperSdfError, SuperSdfWarning as SuperSdfWarning
    from .evaluation import evaluate as evaluate
    from .files.fields import read_field as read_field, write_field as write_field
    from .files.grids import grid_from_image as grid_from_image, read_grid as read_grid
    from .files.meshes import write_mesh as write_mesh
    from .functions.function import DistanceFunction as DistanceFunction
    from .functions.scikit_image import marching_cubes as marching_cubes
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

PUBLIC = {
    "reconstruct": ("pipeline", "an array, a grid or a function in, a fine mesh out"),
    "reconstruct_labels": ("labels.reconstruct", "a label image in, a mesh of each label out"),
    "marching_cubes": ("functions.scikit_image", "the refined surface, called as scikit-image's"),
    "make_grid": ("grid.sdf_grid", "a grid from an array; spacing, sign and kind are inferred"),
    "read_grid": ("files.grids", "a grid from a file of any format"),
    "grid_from_image": ("files.grids", "a grid from VTK image data, such as PyVista's"),
    "SdfGrid": ("grid.sdf_grid", "samples with spacing, origin and direction"),
    "DistanceFunction": ("functions.function", "a function or PyTorch module of points, to sample"),
    "load_network": ("network.network", "a network from its file, once for many grids"),
    "upsample": ("pipeline", "a grid in, the fine field near its surface out"),
    "extract_mesh": ("pipeline", "a fine field in, its mesh out"),
    "FineField": ("refine.field", "refined values near a surface"),
    "fine_grid": ("refine.field", "a grid of the fine lattice of a field, to refine again"),
    "read_field": ("files.fields", "a fine field from a file"),
    "write_field": ("files.fields", "a fine field to a file"),
    "Mesh": ("surface.mesh", "vertices, faces, notes and warnings"),
    "write_mesh": ("files.meshes", "a mesh to a file: .ply, .stl, .obj, .off, .glb, .3mf"),
    "simplify_mesh": ("simplify.simplify", "a mesh of fewer triangles within a measured distance"),
    "evaluate": ("evaluation", "Chamfer distance, F1, normals, edges of meshes and references"),
    "SuperSdfError": ("errors", "every error of this package"),
    "SuperSdfWarning": ("errors", "every warning of this package"),
}
"""The public names: where each is defined, and what it is."""
__all__ = ["__version__", *PUBLIC]
__doc__ = f"{__doc__}\n" + "\n".join(f"{name:19}{what}" for name, (_, what) in PUBLIC.items())


def __getattr__(name: str) -> Any:
    """Import a public name from the module that defines it."""
    if name not in PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{PUBLIC[name][0]}", __name__), name)


def __dir__() -> list[str]:
    """List the public names, whether imported yet or not."""
    return list(__all__)
