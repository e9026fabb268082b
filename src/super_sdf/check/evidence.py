"""What a mesh is as a surface, and how far the spheres of samples are from touching it.

An exact sample is the radius of an empty ball that touches the surface. Its residual is its
distance to the mesh minus that radius: positive if the mesh does not reach the ball, negative if it
pierces it. All lengths are in voxels unless they are named otherwise.
"""

from __future__ import annotations

import itertools
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import CENTRE, NEIGHBOURHOOD, BoolArray, FloatArray, IntArray
from ..grid.sdf_grid import SdfGrid
from ..refine.band import plane_blocks, rescale
from ..refine.nodes import VoxelIndex
from ..refine.survey import Band
from ..surface.mesh import Mesh
from ..threads import chunks_of
from ..truth.mesh_files import without_unused
from ..truth.solid import Distances, Points, Solid

FACES_IN_SLAB = 1 << 19  # search trees of small meshes are quicker and take less memory
REACH = 2.0  # how far slabs look: the samples near the surface are within 1.4 of it
WIDTH = 4  # 2^17 samples at a time
CLEAR = 0.5  # cosine to the nearest triangle's normal above which that tells the side
NOTICEABLE = 0.1  # a residual that is counted as large
STRAY = 0.5  # within a ball, from which on a vertex is counted
NEAREST_FEET = 8  # foot points that a vertex looks at
SMOOTHING = 0.02  # distance of a foot point that halves its weight
FARTHEST = 1.5  # foot points farther away say nothing of a vertex


@dataclass(frozen=True)
class Surface:
    """What a mesh is as a surface; triangles that have the same vertex twice are left out."""

    open_edges: int  # of an odd number of triangles
    crowded_edges: int  # of more than two triangles: not manifold
    flipped_edges: int  # of two triangles that pass them in the same direction
    vertices: int
    triangles: int
    pinched_vertices: int  # at which several fans of triangles meet: not manifold
    components: int  # that share no vertex
    self_intersections: int | None  # pairs that meet off a common vertex or edge; None: not counted
    volume: float  # in cubic world units, negative if the triangles face inward
    area: float

    @property
    def is_simple(self) -> bool:
        """Whether the mesh is one closed sheet with an inside, known not to meet itself."""
        return not self.faults() and self.components == 1 and self.self_intersections == 0

    def faults(self) -> list[str]:
        """Return what keeps the mesh from being the boundary of a solid, in words."""
        counts = {
            "open edges": self.open_edges,
            "edges of more than two triangles": self.crowded_edges,
            "edges between triangles of opposite orientation": self.flipped_edges,
            "vertices where several fans of triangles meet": self.pinched_vertices,
            "pairs of triangles that intersect": self.self_intersections or 0,
        }
        found = [f"{count:,} {what}" for what, count in counts.items() if count]
        return found + ["triangles that face inward"] * (self.volume <= 0)

    def report(self) -> dict[str, Any]:
        """Return the figures as they stand in JSON."""
        return {
            "closed": self.open_edges == 0,
            "oriented": self.flipped_edges == 0 and self.volume > 0,
            "manifold": self.crowded_edges == 0 and self.pinched_vertices == 0,
            **asdict(self),
        }


def examine_surface(mesh: Mesh, self_intersections: int | None = None) -> Surface:
    """Return what a mesh is as a surface; vertices at the same position must be one vertex."""
    a, b, c = mesh.faces.T
    whole = Mesh(mesh.vertices, mesh.faces[(a != b) & (b != c) & (c != a)])
    opposite, uses, flipped = whole.pair_edges()
    pinched = int(np.count_nonzero(whole.count_fans(opposite) > 1))
    edges = int((uses % 2).sum()), int((uses > 2).sum()), flipped
    counts = len(whole.vertices), len(whole.faces), pinched, whole.components()[0]
    return Surface(*edges, *counts, self_intersections, whole.volume(), whole.area())


@dataclass(frozen=True, eq=False)
class Touching:
    """The exact samples of a grid near the surface, and where their balls meet the mesh.

    Samples that promise nothing are counted and left out: cut off at the limit of truncated values
    or at the band's edge; and noisy ones, which differ from a neighbour by more than distances can,
    together with the rest if they are many.
    """

    cut_off: int
    noisy: int
    voxel_ijk: IntArray  # (n, 3)
    points: Points  # (n, 3), in world units
    values: FloatArray  # (n,), negative inside
    residuals: FloatArray  # (n,): distance to the mesh minus absolute value
    feet: Points  # (n, 3): the nearest points of the mesh, in world units
    wrong_side: BoolArray  # (n,): mesh and sample disagree on it by more than ``NOTICEABLE``

    def report(self) -> dict[str, Any]:
        """Return the figures as they stand in JSON; None where no sample is exact."""
        return {
            "samples": {"exact": len(self.values), "cut_off": self.cut_off, "noisy": self.noisy},
            "residual": self.summary() if len(self.values) else None,
            "wrong_side": int(self.wrong_side.sum()) if len(self.values) else None,
        }

    def summary(self) -> dict[str, Any]:
        """Return mean, 99th percentile and maximum of the absolute residuals, and where it is."""
        size = np.abs(self.residuals)
        worst = int(size.argmax())
        return {
            "mean": float(size.mean(dtype=np.float64)),
            "p99": float(np.quantile(size, 0.99)),
            "largest": float(size[worst]),
            "largest_signed": float(self.residuals[worst]),
            "largest_at": [float(x) for x in self.points[worst]],
            "share_above_tenth": float((size > NOTICEABLE).mean()),
            "share_not_touching": float((self.residuals > NOTICEABLE).mean()),
            "share_pierced": float((self.residuals < -NOTICEABLE).mean()),
        }


@dataclass(frozen=True)
class Strays:
    """Vertices that lie where the nearest sample says that no surface is.

    The samples near the surface see nothing of a piece that lies far from it. But every sample,
    however far away, promises a ball without surface, also if its value was truncated.
    """

    count: int  # vertices more than ``STRAY`` inside the ball of their nearest sample
    beyond: int  # vertices more than half a voxel from the outermost samples
    deepest: float  # of a vertex in the ball of its nearest sample; 0 if there is none


def search(
    mesh: Mesh, points: Points, reach: float, *, intersections: bool
) -> tuple[Distances, Points, Distances, int | None]:
    """Return where points are nearest to a mesh, and the number of its self-intersections.

    That is their distances (k,), the nearest points of the mesh (k, 3), and the cosines (k,) of the
    ways from there to the normals of the triangles. The number is None if it is not counted, or if
    libigl has no test. The mesh is cut into slabs along its longest axis, in which about
    equally many triangles begin. In a slab, points are looked up in the triangles within ``reach``
    of it; those that are farther away than that in the whole mesh.
    """
    import igl.predicates  # here, so that pages are made without it

    counts = intersections and hasattr(igl.predicates, "find_self_intersections")
    axis = int(np.ptp(mesh.vertices, axis=0).argmax())
    along = mesh.vertices[:, axis][mesh.faces]
    low, high, place, n = along.min(1), along.max(1), points[:, axis], len(points)
    distances, feet, cosines, total = np.empty(n), np.empty((n, 3)), np.empty(n), 0
    shares = np.linspace(0, 1, len(mesh.faces) // FACES_IN_SLAB + 2)[1:-1]
    inner = np.unique(np.quantile(low, shares, method="lower"))
    for first, last in itertools.pairwise([-np.inf, *inner.tolist(), np.inf]):
        near = (low < last + reach) & (high >= first - reach)
        part = without_unused(mesh.vertices, mesh.faces[near])
        rows = np.flatnonzero((place >= first) & (place < last))
        distances[rows], feet[rows], cosines[rows] = _nearest(part, points[rows])
        if counts:  # those whose common range begins in the slab, of triangles with an area
            begin, faces = low[near], part.faces.astype(np.int64)
            whole = (faces != np.roll(faces, 1, axis=1)).all(1)
            some = np.flatnonzero(whole & (begin < last) & (high[near] >= first))
            vertices = part.vertices.astype(np.float64)
            pairs = igl.predicates.find_self_intersections(vertices, faces[some])[1]
            common = begin[some][pairs].max(1, initial=-np.inf)
            total += int(np.count_nonzero((common >= first) & (common < last)))
    far = np.flatnonzero(distances > reach)
    if len(far):
        distances[far], feet[far], cosines[far] = _nearest(mesh, points[far])
    return distances, feet, cosines, total if counts else None


def _nearest(mesh: Mesh, points: Points) -> tuple[Distances, Points, Distances]:
    """Return distances, feet and cosines: see ``search``; the cosine at distance 0 is 0."""
    distances, faces, feet = Solid(mesh).nearest(points)
    a, b, c = mesh.vertices[mesh.faces[faces].T].astype(np.float64)
    normals, ways = np.cross(b - a, c - a), points - feet
    sizes = np.linalg.norm(normals, axis=1) * distances
    dots = np.einsum("ij,ij->i", ways, normals)
    return distances, feet, np.divide(dots, sizes, out=np.zeros(len(points)), where=sizes > 0)


def self_intersections(mesh: Mesh) -> int | None:
    """Return the number of pairs of a mesh's triangles that intersect; None if libigl has no test.

    Vertices at the same position must be one vertex.
    """
    return search(mesh, np.empty((0, 3)), 0.0, intersections=True)[3]


def touch(
    mesh: Mesh, band: Band, grid: SdfGrid, *, intersections: bool
) -> tuple[Touching, Surface]:
    """Return where the balls of the exact samples of a band meet a mesh, and what this is.

    On which side of the mesh a sample lies is by its winding number; but if the mesh is simple, not
    where the nearest triangle agrees with the sample.
    """
    values = band.patches[:, CENTRE]
    # ``exact`` keeps truncated samples beside the surface, whose neighbours are steep
    trusted = band.exact & (values > values.min()) & (values < values.max())
    sampled = np.ones(len(values), bool) if band.sampled is None else band.sampled
    rows = np.flatnonzero(trusted & sampled)  # what is interpolated promises nothing
    # if none is exact, too many are no distances for any to be taken for one
    noisy = band.count_noisy() if len(rows) else int(np.count_nonzero(sampled))
    cut_off = int(np.count_nonzero(sampled)) - len(rows) - noisy
    ijk, values = band.voxel_ijk[rows], values[rows] * np.float32(0.5)
    points, reach = grid.to_world(ijk), REACH * grid.voxel_size
    found, feet, cosines, crossing = search(mesh, points, reach, intersections=intersections)
    distances, size = found / grid.voxel_size, np.abs(values)
    residuals, wrong = (distances - size).astype(np.float32), np.zeros(len(size), bool)
    surface = examine_surface(mesh, crossing)
    agreed = surface.is_simple & (np.where(values > 0, 1, -1) * cosines > CLEAR)
    apart = np.flatnonzero((distances + size > NOTICEABLE) & ~agreed)  # where the side matters
    solid = Solid(mesh)
    for chunk in chunks_of(len(apart), WIDTH):
        some = apart[chunk]
        wrong[some] = solid.is_inside(points[some]) != (values[some] <= 0)
    return Touching(cut_off, noisy, ijk, points, values, residuals, feet, wrong), surface


def find_strays(
    vertices: NDArray[Any], grid: SdfGrid, offset: float = 0.0, slack: float = 0.0
) -> Strays:
    """Look up the nearest sample of each vertex, (n, 3) in world units.

    A sample's value may be off by ``slack``, as those of masks are.
    """
    position = grid.to_index(vertices)
    nearest = np.rint(position).astype(np.int64)
    inside = ((nearest >= 0) & (nearest < grid.shape)).all(1)
    position, nearest = position[inside], nearest[inside]
    values = np.zeros(len(nearest))
    for first, last in plane_blocks(grid.shape):
        rows = np.flatnonzero((nearest[:, 0] >= first) & (nearest[:, 0] < last))
        if len(rows):
            i, j, k = nearest[rows].T
            values[rows] = rescale(grid, offset, first, last)[i - first, j, k]
    depth = np.abs(values) / 2 - np.linalg.norm(position - nearest, axis=1) - slack
    count, beyond = np.count_nonzero(depth > STRAY), np.count_nonzero(~inside)
    return Strays(int(count), int(beyond), float(depth.max(initial=0)))


def vertex_residuals(vertices: NDArray[Any], touching: Touching, grid: SdfGrid) -> FloatArray:
    """Return the residual at each vertex, (n,); NaN where no foot point is near.

    Its size is the mean of the absolute residuals at the nearest foot points of the samples around,
    each weighted by the inverse of its distance; its sign is that of the mean with signs.
    """
    residuals = np.full(len(vertices), np.nan, np.float32)
    index = VoxelIndex(touching.voxel_ijk, grid.shape)
    for chunk in chunks_of(len(vertices) if len(touching.values) else 0, 8 * len(NEIGHBOURHOOD)):
        some = np.asarray(vertices[chunk], np.float64)
        nearest = np.rint(grid.to_index(some)).astype(np.int64)
        rows = index.find(nearest[:, None] + NEIGHBOURHOOD)
        away = np.linalg.norm(some[:, None] - touching.feet[rows], axis=2) / grid.voxel_size
        away[rows < 0] = np.inf
        limit = np.partition(away, NEAREST_FEET - 1, axis=1)[:, NEAREST_FEET - 1, None]
        weight = np.where(away <= np.minimum(limit, FARTHEST), 1 / (away + SMOOTHING), 0)
        there = touching.residuals[rows]
        with np.errstate(invalid="ignore"):
            size = (weight * np.abs(there)).sum(1) / weight.sum(1)
        residuals[chunk] = np.copysign(size, (weight * there).sum(1))
    return residuals
