"""What a page shows of a result: its mesh and coarse marching cubes, neither of them too large."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray
from ..certificate.check import Certificate, CheckOptions, check_mesh
from ..certificate.coloured import vertex_residuals
from ..errors import OutOfMemoryError, SuperSdfError
from ..grid.sdf_grid import SdfGrid
from ..machine.memory import held_memory, in_words, memory_bound
from ..mesh import Mesh
from ..simplification.collapsing import collapse_to
from ..simplification.simplify import check_room

MOST_TRIANGLES = 200_000  # of a mesh in a page: 1 to 2 MB, and fluent without a GPU
BYTES_PER_SAMPLE = 16  # of the coarse marching cubes: a copy of the samples and what is crossed


@dataclass(frozen=True, eq=False)
class Shown:
    """A mesh in a page.

    Attributes
    ----------
    title : str
        What it is.
    mesh : Mesh
        In world units, of at most ``MOST_TRIANGLES`` triangles.
    triangles : int
        Triangles before it was simplified for the page.
    residuals : (n,) float32, optional
        The residual at each vertex, in voxels, NaN where it is unknown; see
        ``coloured.vertex_residuals``.
    """

    title: str
    mesh: Mesh
    triangles: int
    residuals: FloatArray | None = None

    def caption(self) -> str:
        """Return the line above the view; it says if the mesh is not the whole one."""
        counts = f"{self.triangles:,} triangles"
        if len(self.mesh.faces) < self.triangles:
            counts += f", shown simplified to {len(self.mesh.faces):,}"
        return f"{self.title}: {counts}"


def shown_result(
    title: str, mesh: Mesh, certificate: Certificate | None, max_memory: int | None = None
) -> Shown:
    """Return a mesh for the page; with a certificate, with the residuals at its vertices."""
    small, residuals = reduced(mesh, MOST_TRIANGLES, max_memory), None
    if certificate and len(certificate.touching.values):
        touching, voxel_size = certificate.touching, certificate.voxel_size
        residuals = vertex_residuals(small.vertices.astype(np.float64), touching, voxel_size)
    return Shown(title, small, len(mesh.faces), residuals)


def shown_coarse(grid: SdfGrid, options: CheckOptions) -> Shown:
    """Return coarse marching cubes for the page, with residuals if samples are exact."""
    mesh = coarse_surface(grid, options.offset, options.max_memory)
    certificate = None
    with suppress(SuperSdfError):  # then it is shown without residuals
        certificate = check_mesh(mesh, grid, options) if len(mesh.faces) else None
    return shown_result("marching cubes of the samples", mesh, certificate, options.max_memory)


def coarse_surface(grid: SdfGrid, offset: float = 0.0, max_memory: int | None = None) -> Mesh:
    """Return marching cubes of the samples themselves, in world units; empty if none is inside.

    Raises
    ------
    OutOfMemoryError
        If the samples do not fit in memory as a whole.
    """
    need = BYTES_PER_SAMPLE * int(np.prod(grid.shape)) + (held_memory() or 0)
    bound = memory_bound(max_memory)
    if bound is not None and need > bound:
        raise OutOfMemoryError(
            f"marching cubes of the samples needs {in_words(need)} of memory, {in_words(bound)} "
            "may be used"
        )
    mesh = isosurface(np.array(grid.values, np.float32) - np.float32(offset))
    faces = mesh.faces[:, ::-1] if grid.is_mirrored else mesh.faces
    return Mesh(grid.to_world(mesh.vertices), np.ascontiguousarray(faces))


def reduced(mesh: Mesh, triangles: int, max_memory: int | None = None) -> Mesh:
    """Return a mesh of at most about ``triangles`` triangles, to be looked at.

    In one pass and not measured, unlike ``simplify_mesh``: it may be no manifold any more.
    """
    if len(mesh.faces) <= triangles:
        return mesh
    check_room(len(mesh.faces), max_memory)
    return collapse_to(mesh, np.zeros(len(mesh.faces), bool), triangles)


def isosurface(field: FloatArray) -> Mesh:
    """Mesh a dense field by marching cubes; empty if it has one sign only."""
    from skimage.measure import marching_cubes

    field[field == 0] = np.float32(1e-9)  # a vertex on a node can open the surface
    if not field.min() < 0 < field.max():
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    vertices, faces, _, _ = marching_cubes(field, 0.0, method="lorensen")
    return Mesh(vertices.astype(np.float64), faces.astype(np.int32))
