"""Simplifying a mesh within a measured distance, or to a number of triangles.

>>> from super_sdf import simplify_mesh
>>> simplify_mesh(mesh, error=0.02 * grid.voxel_size)                    # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import OptionError, check_modules, tell
from ..options import ABOVE_0, OPTIONS
from ..surface.mesh import Mesh, check_mesh
from ..threads import check_fits, give_back, memory_bound
from ..truth import Solid
from .collapsing import Unsimplified, down_to, within
from .measuring import Deviation
from .walls import Walls

# Peak of memory beside the mesh, measured on meshes of 120,000 to 760,000 triangles: 680 to 1,230,
# with the libraries that it loads.
BYTES_PER_TRIANGLE = 1300
NONE_SPARED = "the mesh was not simplified: none of its triangles can be spared within the error"
SAME = Deviation(0.0, 0.0, 0.0, 0.0)
UNREACHED = "{:,} triangles cannot be reached while the mesh stays a manifold of the same topology"


@dataclass(frozen=True, eq=False, repr=False)
class SimplifiedMesh(Mesh):
    """A mesh of fewer triangles; closed, oriented and manifold if the unsimplified mesh was.

    Attributes
    ----------
    triangles_before : int
        How many triangles the unsimplified mesh has.
    deviation : Deviation
        The distances between the two meshes, in world units.
    """

    triangles_before: int
    deviation: Deviation

    def report(self, voxel_size: float) -> dict[str, Any]:
        """Return the figures as they stand in JSON; distances are in voxels of this size."""
        return {
            "voxel_size": voxel_size,
            "triangles_before": self.triangles_before,
            "triangles": len(self.faces),
            "deviation": {name: x / voxel_size for name, x in self.deviation._asdict().items()},
            "warnings": list(self.warnings),
        }


def simplify_mesh(
    mesh: Mesh,
    *,
    error: float | None = None,
    triangles: int | None = None,
    max_memory: int | None = None,
) -> SimplifiedMesh:
    """Simplify a mesh within a distance, or to a number of triangles.

    Parameters
    ----------
    mesh : Mesh
        Vertices at the same position must be one vertex.
    error : float, optional
        Largest distance, in world units, between the two surfaces, measured both ways at the
        vertices and at points less than an edge of ``mesh`` apart.
    triangles : int, optional
        Largest number of triangles. If the number cannot be reached, a warning says so.
    max_memory : int, optional
        Memory limit of the process in bytes; by default a share of the free memory.

    Returns
    -------
    SimplifiedMesh
        A ``Mesh`` with vertices of the same type, and its distance from ``mesh``. Open edges do not
        move. If the goal is not reached, ``warnings`` of the result say so.

    Raises
    ------
    SuperSdfError
        If not exactly one of ``error`` and ``triangles`` is given, the arrays are invalid, the
        extra ``simplify`` is not installed, or simplifying would not fit in memory.
    """
    found = simplified(mesh, error, triangles, max_memory)
    return replace(found, notes=mesh.notes, warnings=mesh.warnings + tell((), found.warnings)[1])


def simplified(
    mesh: Mesh, error: float | None, triangles: int | None, max_memory: int | None
) -> SimplifiedMesh:
    """Return a simplified mesh with warnings of its own only, which are not issued."""
    check_mesh(mesh)
    if (error is None) == (triangles is None):
        raise OptionError("give error or triangles, and only one of them")
    error = None if error is None else ABOVE_0.check(error, "error")
    triangles = OPTIONS["triangles"].check(triangles)
    check_modules("simplifying", "simplify")
    give_back()  # otherwise freed memory counts as held
    count, most = len(mesh.faces), memory_bound(OPTIONS["max_memory"].check(max_memory))
    way_out = "use a smaller factor, do not simplify, or allow more (--max-memory)"
    check_fits(count * BYTES_PER_TRIANGLE, f"simplifying {count:,} triangles", way_out, most)
    if not count:
        return SimplifiedMesh(mesh.vertices, mesh.faces, 0, SAME)
    of, warnings = Unsimplified(Walls.of(mesh)), tuple[str, ...]()
    found = (within(of, error or 0.0) if triangles is None else down_to(of, triangles)) or of.walls
    if triangles is None and len(found.faces) == count:
        warnings = (NONE_SPARED,)
    elif triangles is not None and len(found.faces) > triangles:
        warnings = (f"{UNREACHED.format(triangles)}: it has {len(found.faces):,}",)
    deviation = SAME
    if len(found.faces) < count:
        deviation = of.originals[0].compare(Solid(found), error or np.inf)[1]
    return SimplifiedMesh(found.vertices, found.faces, count, deviation, warnings=warnings)
