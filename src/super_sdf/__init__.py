"""Sparse super-resolution of signed distance grids: a coarse grid in, a fine mesh out.

>>> from super_sdf import make_grid, reconstruct
>>> mesh = reconstruct(make_grid(values, spacing=0.1))            # doctest: +SKIP

Names are imported when they are first used, so that ``super-sdf --help`` need not load NumPy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .errors import SuperSdfError as SuperSdfError
    from .field import FineField as FineField
    from .files.grids import read_grid as read_grid
    from .files.meshes import write_mesh as write_mesh
    from .grid import SdfGrid as SdfGrid
    from .grid import make_grid as make_grid
    from .isosurface import extract_mesh as extract_mesh
    from .mesh import Mesh as Mesh
    from .network import load_network as load_network
    from .pipeline import reconstruct as reconstruct
    from .pipeline import upsample as upsample

_HOME = {
    "FineField": "field",
    "Mesh": "mesh",
    "SdfGrid": "grid",
    "SuperSdfError": "errors",
    "extract_mesh": "isosurface",
    "load_network": "network",
    "make_grid": "grid",
    "read_grid": "files.grids",
    "reconstruct": "pipeline",
    "upsample": "pipeline",
    "write_mesh": "files.meshes",
}
__all__ = sorted([*_HOME, "__version__"])


def __getattr__(name: str) -> Any:
    """Import a public name from the module where it lives."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    """List the public names, imported already or not."""
    return __all__
