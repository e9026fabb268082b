"""Meshes as ground truth: read from files, with exact distances and sides, and sampled to grids.

The distance is that to the nearest triangle. The sign comes from the winding number (Barill et al.,
Fast Winding Numbers for Soups and Clouds, 2018), because the pseudonormal of the nearest triangle
gives the wrong sign on meshes that intersect themselves, as real ones do.

A grid has exact samples everywhere, or near the surface. It is made in cubes of 8^3 samples: the
distance at the centre of a cube decides whether any of its samples can lie in the band; only those
cubes are evaluated. It also decides whether the surface can cross the cube: if not, all its samples
are on the same side. Across the holes of an open mesh the side changes without a surface, so it is
evaluated at every sample. Needs the extra ``eval``.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from functools import cached_property
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import FileError, MeshError, OptionError
from .files.formats import check_regular_file
from .grid.sdf_grid import SdfGrid
from .options import LENGTHS
from .surface.mesh import Mesh
from .threads import check_fits, chunks_of

Points = NDArray[np.float64]
Distances = NDArray[np.float64]
Progress = Callable[[int, int], None]
Layout = tuple[tuple[int, int, int], float, NDArray[np.float64]]
"""Samples along the axes, spacing, and the position of sample (0, 0, 0)."""

LARGEST_COORDINATE = 1e30  # products and squares of larger ones overflow
MERGE_DISTANCE = 1e-8  # vertices closer than this are merged
SMALLEST_STEP = 1e-18  # of the largest coordinate, so that multiples of it fit in 64 bits
EDGE = 8  # samples along a cube
EXACT_SAMPLES = 1 << 24  # up to 256^3 every sample is exact unless a band is given
BIG_GRID_BAND = 4.0  # voxels; upsampling uses none beyond 1.5 + sqrt(3)
MOST_ALONG_AXIS = 1e9  # samples; a larger number can only be a mistake
POSITION_ERROR = 1e-4  # largest error of a sample's position, over the spacing
PADDING = 2.37  # voxels; a whole number puts faces of a box on planes of samples
ON_PLANE = 0.1  # voxels between a face of the box and a plane of samples
WORK_BYTES = 500_000_000  # for search trees and chunks, besides the values


def read_mesh(path: str | Path) -> Mesh:
    """Read a mesh file as one mesh, its parts together: see ``read_parts``."""
    parts = list(read_parts(path).values())
    first = np.cumsum([0, *(len(part.vertices) for part in parts)], dtype=np.int32)
    faces = np.concatenate([part.faces + start for part, start in zip(parts, first)])
    return merged(Mesh(np.concatenate([part.vertices for part in parts]), faces))


def read_parts(path: str | Path, unit: str | None = None) -> dict[str, Mesh]:
    """Read the parts of any mesh file that trimesh reads, by name, with merged float64 vertices.

    A ``.glb`` is in metres: its vertices are divided by the ``unit``. FileError if no mesh can be
    read, MeshError if what the file holds is no finite surface.
    """
    path = check_regular_file(path)
    try:
        import trimesh

        logging.getLogger("trimesh").addHandler(logging.NullHandler())  # else Python prints them
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # unprocessed: otherwise faces with non-finite vertices would be dropped silently
            scene: Any = trimesh.load_scene(path, process=False, skip_materials=True)
            order = list(scene.geometry)
            some = [part for part in scene.dump() if len(getattr(part, "faces", ()))]
            some.sort(key=lambda part: order.index(part.metadata["name"]))
            arrays = {}
            for part in some:
                vertices = np.array(part.vertices, np.float64).reshape(-1, 3)
                faces = np.array(part.faces, np.int64).reshape(-1, 3)
                arrays[part.metadata["node"]] = vertices, faces
    except Exception as error:  # the readers of trimesh raise all kinds of errors
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        raise FileError(f"{path} cannot be read as a mesh: {reason}") from error
    if not arrays:
        raise MeshError(f"{path} holds no triangle: give a surface mesh")
    scale, meshes = LENGTHS[unit] if unit and path.suffix.lower() == ".glb" else 1.0, {}
    for name, (vertices, faces) in arrays.items():
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise MeshError(f"{path} has a face of a vertex that it does not hold: repair it")
        used, corners = np.unique(faces, return_inverse=True)
        if not (largest := np.abs(vertices[used]).max()) <= LARGEST_COORDINATE:
            how = "repair it, or scale it to under 1e30"
            raise MeshError(f"{path} reaches to {largest:.3g}: {how}")
        mesh = Mesh(vertices[used] / scale, corners.astype(np.int32).reshape(-1, 3))
        meshes[name] = merged(mesh)
    return meshes


def merged(mesh: Mesh) -> Mesh:
    """Merge vertices within ``MERGE_DISTANCE``, for meshes under 1 that share of their size.

    Unlike in trimesh, normals and textures do not keep vertices separate: a mesh is not open along
    its seams.
    """
    from trimesh.grouping import unique_rows

    step = MERGE_DISTANCE * min(1.0, float(np.ptp(mesh.vertices, axis=0).max()))
    step = max(step, float(np.abs(mesh.vertices).max()) * SMALLEST_STEP) or 1.0
    places = np.round(mesh.vertices / step).astype(np.int64)
    first, place = unique_rows(places, keep_order=True)
    if len(first) == len(mesh.vertices):
        return mesh
    return Mesh(mesh.vertices[first], place.astype(np.int32)[mesh.faces])


class Solid:
    """The solid that a mesh, facing outward, encloses, with search trees for fast queries.

    Where pieces overlap the solid is their union, but distances are to the nearest triangle even if
    that is inside another piece. Points are (n, 3).
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = Mesh(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int32))

    def _tree(self, kind: str, middle: Any = 0.0) -> Any:
        """Return a search tree of igl for the triangles, about a point: one is in float32."""
        import igl

        tree = getattr(igl, kind)()
        tree.init(self.mesh.vertices - middle, self.mesh.faces)
        return tree

    _triangles = cached_property(lambda self: self._tree("AABB"))
    _middle = cached_property(lambda self: self.mesh.vertices.mean(0))
    _winding = cached_property(lambda self: self._tree("FastWindingNumberBVH", self._middle))

    @cached_property
    def unbalanced_edges(self) -> int:
        """How many edges are open, or of two faces in the same direction: 0 if closed.

        An edge of four faces counts as closed: the winding number is an integer on all its sides.
        """
        _, uses, flipped = self.mesh.pair_edges()
        return int((uses % 2).sum()) + flipped

    def nearest(self, points: Points) -> tuple[Distances, NDArray[np.int64], Points]:
        """Return the distance to the nearest triangle, that triangle, and its nearest point."""
        if not len(points):
            return np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 3))
        both = self.mesh.vertices, self.mesh.faces
        squared, face, feet = self._triangles.squared_distance(*both, points)
        return np.sqrt(squared), np.ravel(face), feet

    def distance(self, points: Points) -> Distances:
        """Return the unsigned distance, (n,), to the nearest triangle."""
        return self.nearest(points)[0]

    def is_inside(self, points: Points) -> NDArray[np.bool_]:
        """Return a mask, (n,), of the points inside the solid."""
        found = self._winding.winding_number(points - self._middle) if len(points) else points[:, 0]
        return np.asarray(found > 0.5)

    def signed_distance(self, points: Points) -> Distances:
        """Return the signed distance, (n,), negative inside."""
        found = self.distance(points)
        return np.where(self.is_inside(points), -found, found)

    def intersecting(self) -> NDArray[np.int64]:
        """Return the pairs of triangles, (k, 2), that meet off a common vertex or edge.

        Vertices at the same position must be one vertex.
        """
        import igl.predicates

        vertices, faces = self.mesh.vertices, self.mesh.faces.astype(np.int64)
        whole = np.flatnonzero((faces != np.roll(faces, 1, axis=1)).all(1))
        # not too small for igl, which has absolute tolerances; powers of two round nothing
        _, power = np.frexp(np.ptp(vertices, axis=0).max(initial=1e-300))
        vertices = np.ldexp(vertices, 10 - power)
        return whole[igl.predicates.find_self_intersections(vertices, faces[whole])[1]]


def load_solid(path: str | Path, *, allow_open: bool = False) -> tuple[Solid, list[str]]:
    """Read a mesh file as a solid; return it with notes on its faults.

    An inverted mesh is reversed. FileError or MeshError if it cannot be read, is flat, or is open
    and ``allow_open`` is not set. With ``allow_open`` the sign comes from the generalised winding
    number, a guess near the holes.
    """
    solid, notes = Solid(read_mesh(path)), []
    mesh, open_edges, volume = solid.mesh, solid.unbalanced_edges, solid.mesh.volume()
    if open_edges and not allow_open:
        said = f"{path} is open: {open_edges:,} edges have no partner, so it has no inside"
        raise MeshError(f"{said}; close it, or use --allow-open to guess its inside")
    if not np.ptp(mesh.vertices, axis=0).all() or volume == 0:
        raise MeshError(f"{path} is flat: it encloses no volume")
    if open_edges:
        notes.append(f"open at {open_edges:,} edges: inside is guessed across the holes")
    if volume < 0:
        notes.append("inverted: its faces point inward; they were reversed")
        solid = Solid(Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1])))
    return solid, notes


def fitted_layout(
    mesh: Mesh, *, n: int | None = None, spacing: float | None = None, padding: float = PADDING
) -> Layout:
    """Return the layout of a grid around a mesh, in the units of the mesh.

    Give the samples ``n`` along the longest axis of its bounding box, or the ``spacing``.
    ``padding`` is the least number of voxels between the box and the outermost samples. Faces of
    the box lie on no plane of samples, unless n and the padding put them there.
    """
    if n is not None and not n - 1 - 2 * padding >= 1:
        raise OptionError(f"{n} samples leave no room within a padding of {padding:g} voxels")
    low, high = mesh.vertices.min(0).astype(np.float64), mesh.vertices.max(0).astype(np.float64)
    size, is_free = high - low, np.ones(3, bool)
    if spacing is None:
        spacing, is_free = float(size.max() / ((n or 0) - 1 - 2 * padding)), size < size.max()
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.ceil(size / spacing + 2 * padding - 1e-6)
        room = (steps - size / spacing) / 2
        steps += is_free & (np.abs(room - np.rint(room)) < ON_PLANE)
        origin = (low + high - steps * spacing) / 2  # not finite: refused by the grid
    if not steps.max() < MOST_ALONG_AXIS:
        raise OptionError(f"--spacing is {spacing:g}: it makes {steps.max():.3g} samples an axis")
    nx, ny, nz = (int(count) + 1 for count in steps)
    return (nx, ny, nz), spacing, origin


def sample_solid(
    solid: Solid, layout: Layout, *, band: float | None = None, progress: Progress | None = None
) -> SdfGrid:
    """Sample the signed distance to a solid.

    ``band`` is the distance in voxels up to which values are exact (to float32); they are clamped
    there, as the grid's notes say. Default: ``BIG_GRID_BAND`` in grids of over 256^3
    samples, else none. ``progress`` is called with (cubes done, all cubes). MeshError if floating
    point cannot hold the distances or the positions; OutOfMemoryError.
    """
    shape, spacing, origin = layout
    if band is None:
        band = BIG_GRID_BAND if prod(shape) > EXACT_SAMPLES else np.inf
    reach = float(np.abs(origin).max()) + spacing * max(shape)
    if not (spacing > 1e-30 and reach < 1e30 and np.spacing(reach) <= POSITION_ERROR * spacing):
        said = f"a spacing of {spacing:g} in a grid that reaches to {reach:g} is too fine for "
        raise MeshError(f"{said}floating point: scale the mesh, or move it to the origin")
    size = " x ".join(map(str, shape))
    check_fits(prod(shape) * 8 + WORK_BYTES, f"a grid of {size}", "take fewer samples")
    counts, limit = [-(-n // EDGE) for n in shape], band * spacing
    cubes, within_cube = np.argwhere(np.ones(counts, bool)) * EDGE, np.argwhere(np.ones([EDGE] * 3))
    values = np.empty((len(cubes), EDGE**3), np.float32)
    half = 3**0.5 * (EDGE - 1) / 2 * spacing  # from the centre of a cube to its corners
    for some in chunks_of(len(cubes), EDGE**3):
        centres = (cubes[some] + (EDGE - 1) / 2) * spacing + origin
        away, side = solid.distance(centres), np.where(solid.is_inside(centres), -1.0, 1.0)
        crossed = (away <= half * (1 + 1e-9)) | (solid.unbalanced_edges > 0)
        found = np.repeat(side[:, None] * limit, EDGE**3, axis=1)
        near = ~crossed & (away <= limit + half)
        for chosen, measure in ((near, solid.distance), (crossed, solid.signed_distance)):
            points = ((cubes[some][chosen, None] + within_cube) * spacing + origin).reshape(-1, 3)
            found[chosen] = measure(points).reshape(-1, EDGE**3)
        found[near] *= side[near, None]
        values[some] = found.clip(-limit, limit)
        if progress:
            progress(min(some.stop, len(cubes)), len(cubes))
    cut = values.reshape(*counts, EDGE, EDGE, EDGE).transpose(0, 3, 1, 4, 2, 5)
    whole = cut.reshape([n * EDGE for n in counts])[tuple(map(slice, shape))]
    notes = [f"distances are exact up to {band:g} voxels and clamped there"] * (band < np.inf)
    return SdfGrid.trusted(whole, spacing, origin, tuple(notes))
