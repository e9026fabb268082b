"""The certificate of a mesh: its faults as a surface, and how well it fits its grid's samples.

An exact sample is the radius of an empty ball that touches the surface. Its residual is its
distance to the mesh minus that radius: positive if the mesh does not reach the ball, negative if it
pierces it. All lengths are in voxels unless they are named otherwise.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from trimesh.triangles import angles

from .arrays import CENTRE, BoolArray, FloatArray, length, sums_at
from .grid.derived import ON_SAMPLE
from .grid.sdf_grid import SdfGrid, cubic_grid, volume_of_samples
from .options import LENGTHS, Options
from .refine.band import Band, no_surface, survey
from .refine.nodes import VoxelIndex
from .surface.mesh import Mesh
from .threads import check_fits, give_back, memory_bound, useful_threads
from .truth import Points, Solid

# Bytes for each triangle and each voxel of the band, beside mesh and band: search trees.
BYTES_PER_TRIANGLE, BYTES_PER_SAMPLE = 650, 150
NOTICEABLE = 0.1  # a residual that is counted as large
NEAREST_FEET, SMOOTHING = 8, 0.02  # foot points of a vertex; distance that halves the weight of one
FARTHEST = 1.5  # foot points farther away say nothing of a vertex
SLIVER = 0.5  # degrees: a triangle with a smaller angle
NEEDLE = 0.94  # length of the mean direction of the edges of a vertex; 0.97 in a cone of 15 degrees
FULL = 0.1  # residual at which the colour of a page is saturated
AS_GIVEN = Options()


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
    cavities: int  # components that bound one
    self_intersections: int  # pairs of triangles that meet off a common vertex or edge
    volume: float  # in cubic world units, negative if the triangles face inward
    volume_ml: float | None  # in millilitres, if the unit is stated
    area: float
    slivers: int  # triangles with an angle under half a degree
    needles: int  # vertices at the tip of a spike: all their edges are in a narrow cone

    def faults(self) -> list[str]:
        """Return what keeps the mesh from being the boundary of a solid, in words."""
        counts = {
            "open edges": self.open_edges,
            "edges of more than two triangles": self.crowded_edges,
            "edges between triangles of opposite orientation": self.flipped_edges,
            "vertices where several fans of triangles meet": self.pinched_vertices,
            "pairs of triangles that intersect": self.self_intersections,
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

    def counts(self) -> str:
        """Return counts and volume, as a part of a line."""
        ml = "" if self.volume_ml is None else f" ({self.volume_ml:.6g} ml)"
        pieces = f"{(solids := self.components - self.cavities):,} piece{'s' * (solids != 1)}"
        pieces += f" (cavities: {self.cavities:,})" * bool(self.cavities)
        text = f"{self.vertices:,} vertices, {self.triangles:,} triangles, {pieces}, "
        return f"{text}volume {self.volume:.6g}{ml}, area {self.area:.6g}"

    def summary(self) -> str:
        """Return the faults in one line."""
        return f"faults: {'; '.join(self.faults() or ['none'])}"


@dataclass(frozen=True, eq=False)
class Certificate:
    """What is certain of a mesh without the true surface: its surface, samples, and strays.

    Samples without a promise are left out: truncated, or noisy: steeper than distances can be.
    """

    grid: SdfGrid  # on its cubic lattice
    surface: Surface
    samples: dict[str, int]  # exact (n), cut_off, noisy; all 0 where samples are no distances
    points: Points  # (n, 3), the exact samples, in world units
    values: FloatArray  # (n,), negative inside
    residuals: FloatArray  # (n,): distance to the mesh minus absolute value
    feet: Points  # (n, 3): the nearest points of the mesh, in world units
    wrong_side: BoolArray  # (n,): mesh and sample disagree on it by more than ``NOTICEABLE``
    strays: int | None  # vertices where the grid has no surface; None if no sample is exact
    beyond: int  # vertices outside the grid
    sample_volume: float | None  # of a mask: of its samples inside, each of which is a box

    def figures(self) -> dict[str, Any]:
        """Return mean, quantile and maximum of the absolute residuals; nothing without samples."""
        if not len(size := np.abs(self.residuals)):
            return {}
        worst = int(size.argmax())
        return {
            "mean": float(size.mean(dtype=np.float64)),
            "p99": float(np.quantile(size, 0.99)),
            "largest": float(size[worst]),
            "largest_signed": float(self.residuals[worst]),
            "largest_at": [float(x) for x in self.points[worst]],
            "share_above_tenth": float((size > NOTICEABLE).mean()),
        }

    def report(self) -> dict[str, Any]:
        """Return the certificate as it stands in JSON; residuals are in voxels."""
        return {
            "voxel_size": self.grid.voxel_size,
            "surface": self.surface.report(),
            "samples": self.samples,
            "residual": self.figures() or None,
            "wrong_side": int(self.wrong_side.sum()) if len(self.values) else None,
            "strays": self.strays,
            "beyond": self.beyond,
            "sample_volume": self.sample_volume,
            "faults": self.faults(),
            "inferred": list(self.grid.flagged),
        }

    def faults(self) -> list[str]:
        """Return what is wrong with the mesh whatever the limits, in words."""
        wrong, strays = int(self.wrong_side.sum()), self.strays or 0
        found = [f"{wrong:,} samples on the wrong side"] * (wrong > 0)
        found += [f"{strays:,} vertices where the grid has no surface"] * (strays > 0)
        found += ["no vertex within the grid"] * (0 < self.surface.vertices == self.beyond)
        return self.surface.faults() + found

    def lines(self) -> list[str]:
        """Return the certificate as lines for users."""
        of, samples = self.surface, self.samples
        lines = [
            f"mesh: {of.counts()}",
            f"shape: {of.slivers:,} slivers (triangles with an angle under {SLIVER:g} degrees), "
            f"{of.needles:,} needles (vertices at the tip of a spike)",
        ]
        if any(samples.values()):
            text = "samples: {exact:,} exact near the surface; left out: {cut_off:,} that may be "
            lines.append((text + "truncated, {noisy:,} noisy").format(**samples))
        if figures := self.figures():
            at = ", ".join(f"{x:.6g}" for x in figures["largest_at"])
            largest = figures["largest"] * self.grid.voxel_size
            lines.append(f"largest residual: {largest:.4g} in world units, at ({at})")
        lines += [f"{self.beyond:,} vertices off the voxels (a cap): unchecked"] * (self.beyond > 0)
        return [*lines, self.summary()]

    def summary(self) -> str:
        """Return the certificate in one line."""
        said = "residual unknown, since no sample is exact"
        if figures := self.figures():
            said = "residual {mean:.4f} voxels in the mean, {largest_signed:+.4f} at most, "
            said += f"{{share_above_tenth:.2%}} of {len(self.values):,} samples above "
            said = said.format(**figures) + f"{NOTICEABLE:g}"
        elif self.sample_volume:
            share = self.surface.volume / self.sample_volume - 1
            said = f"volume {share:+.2%} off that of the samples, {self.sample_volume:.6g}"
        return f"{said}; faults: {'; '.join(self.faults() or ['none'])}"

    def exceeded(self, tolerance: float | None, max_mean: float | None) -> list[str]:
        """Return a sentence for each limit that is exceeded.

        ``tolerance`` is for the largest residual, in world units, ``max_mean`` for the mean.
        """
        if tolerance is None and max_mean is None:
            return []
        if not (figures := self.figures()):
            return ["no sample is exact, so no limit on residuals can be shown to be kept"]
        largest, mean, found = figures["largest"] * self.grid.voxel_size, figures["mean"], []
        if tolerance is not None and not largest <= tolerance:
            said = f"the largest residual is {largest:.4g} in world units"
            found.append(f"{said}, --tolerance is {tolerance:g}")
        if max_mean is not None and not mean <= max_mean:
            found.append(f"the mean residual is {mean:.4g} voxels, --max-mean is {max_mean:g}")
        return found

    def residuals_at(self, vertices: NDArray[Any]) -> FloatArray:
        """Return the residual at positions on the mesh, (n,); NaN where no foot point is near.

        Its size is the mean of the absolute residuals at the nearest foot points of the samples,
        each weighted by the inverse of its distance; its sign is that of the mean with signs.
        """
        from scipy.spatial import cKDTree  # igl needs SciPy, too

        reach = FARTHEST * self.grid.voxel_size
        away, at = cKDTree(self.feet).query(vertices, NEAREST_FEET, distance_upper_bound=reach)
        there = np.append(self.residuals, 0)[at]
        weight = 1 / (away / self.grid.voxel_size + SMOOTHING)
        with np.errstate(invalid="ignore"):
            size = (weight * np.abs(there)).sum(1) / weight.sum(1)
        return np.copysign(size, (weight * there).sum(1)).astype(np.float32)


def check_mesh(mesh: Mesh, grid: SdfGrid, options: Options = AS_GIVEN) -> Certificate:
    """Check a mesh against the grid that it was made from.

    Vertices at the same position must be one vertex, as of ``merged``. Of the options the offset,
    the unit and the memory bound count. GridError if the grid has no surface at the offset;
    OutOfMemoryError if the search trees would not fit in memory.
    """
    offset, lattice = options.offset, cubic_grid(grid, options.offset)
    band = survey(lattice, offset, threads=useful_threads(0))
    if not len(band.voxel_ijk):
        raise no_surface(grid, offset)
    need = len(mesh.faces) * BYTES_PER_TRIANGLE + len(band.voxel_ijk) * BYTES_PER_SAMPLE
    what, most = f"checking {len(mesh.faces):,} triangles", memory_bound(options.max_memory)
    check_fits(need, what, "allow more (--max-memory)", most)
    surface, touched = examine_surface(mesh, options.unit), touch(Solid(mesh), band, grid)
    is_mask, nearest = lattice.field.sides_only, np.rint(lattice.to_index(mesh.vertices))
    beyond = ((nearest < 0) | (nearest >= lattice.shape)).any(1)
    away = VoxelIndex(band.voxel_ijk, lattice.shape).find(nearest.astype(np.int64)) < 0
    give_back()
    return Certificate(
        lattice,
        surface,
        *touched,
        strays=int((away & ~beyond).sum()) if is_mask or touched[0]["exact"] else None,
        beyond=int(beyond.sum()),
        sample_volume=volume_of_samples(grid, offset) if is_mask else None,
    )


def examine_surface(mesh: Mesh, unit: str | None = None) -> Surface:
    """Return what a mesh is as a surface; vertices at the same position must be one vertex."""
    whole = Mesh(mesh.vertices, mesh.faces[(mesh.faces != np.roll(mesh.faces, 1, 1)).all(1)])
    opposite, uses, flipped = whole.pair_edges()
    fans = whole.count_fans(opposite)
    corners, at = whole.vertices.astype(np.float64)[whole.faces], whole.faces.ravel()
    sides = (np.roll(corners, -1, axis=1) - corners).reshape(-1, 3)
    sides /= np.maximum(length(sides), 1e-300)[:, None]
    directions = length(sums_at(at.astype(np.int64), sides, len(fans)))
    degrees, volume = np.bincount(at, minlength=len(fans)), whole.volume()
    tips = (directions > NEEDLE * degrees) & (degrees > 2)
    return Surface(
        open_edges=int((uses % 2).sum()),
        crowded_edges=int((uses > 2).sum()),
        flipped_edges=flipped,
        vertices=len(whole.vertices),
        triangles=len(whole.faces),
        pinched_vertices=int(np.count_nonzero(fans > 1)),
        components=whole.components()[0],
        cavities=whole.cavities(),
        self_intersections=len(Solid(mesh).intersecting()),
        volume=volume,
        volume_ml=volume * (100 * LENGTHS[unit]) ** 3 if unit else None,
        area=whole.area(),
        slivers=int(np.count_nonzero(np.degrees(angles(corners).min(1)) < SLIVER)),
        needles=int(np.count_nonzero(tips)),
    )


def touch(
    solid: Solid, band: Band, grid: SdfGrid
) -> tuple[dict[str, int], Points, FloatArray, FloatArray, Points, BoolArray]:
    """Return what ``Certificate`` says of samples: where their balls meet a mesh."""
    values = band.patches[:, CENTRE]
    # ``exact`` keeps truncated samples beside the surface, whose neighbours are steep
    trusted = band.exact & (values > values.min()) & (values < values.max())
    places = grid.to_index(points := band.grid.to_world(band.voxel_ijk))
    is_sample = (np.abs(places - np.rint(places)) <= ON_SAMPLE).all(1)
    rows = np.flatnonzero(trusted & is_sample)  # what is interpolated promises nothing
    sampled = int(np.count_nonzero(is_sample))
    # if none is exact, too many are no distances for any to be taken for one
    noisy = int(np.count_nonzero(is_sample & ~band.lipschitz)) if len(rows) else sampled
    points, values = points[rows], values[rows] * np.float32(0.5)
    found, _, feet = solid.nearest(points)
    distances, size = found / grid.voxel_size, np.abs(values)
    apart = np.flatnonzero(distances + size > NOTICEABLE)  # where the side matters
    wrong = np.zeros(len(size), bool)
    wrong[apart] = solid.is_inside(points[apart]) != (values[apart] <= 0)
    are_distances = grid.field.network is not None and not grid.field.sides_only
    counts = {"exact": len(rows), "cut_off": sampled - len(rows) - noisy, "noisy": noisy}
    samples = {name: count * are_distances for name, count in counts.items()}
    return samples, points, values, (distances - size).astype(np.float32), feet, wrong
