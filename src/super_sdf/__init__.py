"""Sparse super-resolution of signed distance grids: a coarse grid in, a fine mesh out.

>>> from super_sdf import make_grid, reconstruct
>>> mesh = reconstruct(make_grid(values, spacing=0.1))            # doctest: +SKIP

Names are imported on first use, so that ``super-sdf --help`` does not load NumPy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = [
    "DistanceFunction",
    "FineField",
    "Mesh",
    "SdfGrid",
    "SuperSdfError",
    "__version__",
    "extract_mesh",
    "fine_grid",
    "grid_from_image",
    "load_network",
    "make_grid",
    "read_field",
    "read_grid",
    "reconstruct",
    "reconstruct_labels",
    "simplify_mesh",
    "upsample",
    "write_field",
    "write_mesh",
]

if TYPE_CHECKING:
    from .public import *


def __getattr__(name: str) -> Any:
    """Import a public name from ``public``."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import public

    return getattr(public, name)


def __dir__() -> list[str]:
    """List the public names, whether imported yet or not."""
    return __all__
