"""The certificate of a mesh: its faults as a surface, and how well it fits its grid's samples.

An exact sample is the radius of an empty ball that touches the surface. Its residual is its
distance to the mesh minus that radius: positive if the mesh does not reach the ball, negative if it
pierces it. All lengths are in voxels unless they are named otherwise.

>>> from super_sdf.check import check_mesh
>>> check_mesh(mesh, grid).report()                                      # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .arrays import CENTRE, NEIGHBOURHOOD, BoolArray, FloatArray, IntArray
from .errors import OptionError
from .files.grids import read_grid
from .files.meshes import write_coloured_ply
from .files.output import check_free
from .grid.sdf_grid import SdfGrid, cubic_grid, volume_of_samples
from .options import LENGTHS, Options
from .refine.band import Band, no_surface, rescale, survey
from .refine.nodes import VoxelIndex
from .surface.mesh import Mesh
from .threads import check_bound, chunks_of, give_back, useful_threads
from .truth.solid import Points, Solid, merged, read_mesh, smallest_angles

# Bytes for each triangle and each voxel of the band, beside mesh and band: search trees.
BYTES_PER_TRIANGLE, BYTES_PER_SAMPLE = 650, 150
OFF_OF_MASKS = 0.5  # by which the distances that are made of a mask may be off
CLEAR = 0.5  # cosine to the nearest triangle's normal above which that tells the side
NOTICEABLE = 0.1  # a residual that is counted as large
STRAY = 0.5  # within a ball, from which on a vertex is counted
NEAREST_FEET, SMOOTHING = 8, 0.02  # foot points of a vertex; distance that halves the weight of one
FARTHEST = 1.5  # foot points farther away say nothing of a vertex
SLIVER = 0.5  # degrees: a triangle with a smaller angle
NEEDLE = 0.94  # length of the mean direction of the edges of a vertex; 0.97 in a cone of 15 degrees
FULL = 0.1  # residual at which a colour is saturated
TOUCHING, PIERCED = (240, 240, 240), (190, 20, 30)
NOT_TOUCHING, UNKNOWN = (20, 70, 190), (120, 120, 60)
WORLD, FROM_ZERO, AS_GIVEN = "in world units", "number from 0 on", Options()
LIMITS = {
    "max_residual": ("largest", "the largest residual is", "voxels"),
    "tolerance": ("largest", "the largest residual is", WORLD),
    "max_mean": ("mean", "the mean residual is", "voxels"),
    "max_share": ("share_above_tenth", "above 0.1 voxel is", ""),
}
"""Options, the figures that they limit, and how these are named, with their unit."""


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
    slivers: int  # triangles with an angle under half a degree
    needles: int  # vertices at the tip of a spike: all their edges are in a narrow cone

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


@dataclass(frozen=True, eq=False)
class Certificate:
    """What is certain of a mesh without the true surface: its surface, samples, and strays.

    Samples that promise nothing are counted and left out: cut off at the limit of truncated values
    or at the band's edge, or noisy, which differ from a neighbour by more than distances can. Every
    sample, also if its value was truncated, promises a ball without surface; a stray is a vertex in
    the ball of its nearest sample.
    """

    mesh: Mesh  # vertices at the same position are one
    grid: SdfGrid  # on its cubic lattice
    surface: Surface
    samples: dict[str, int]  # exact (n), cut_off, noisy; all 0 where samples are no distances
    voxel_ijk: IntArray  # (n, 3), of the exact samples
    points: Points  # (n, 3), in world units
    values: FloatArray  # (n,), negative inside
    residuals: FloatArray  # (n,): distance to the mesh minus absolute value
    feet: Points  # (n, 3): the nearest points of the mesh, in world units
    wrong_side: BoolArray  # (n,): mesh and sample disagree on it by more than ``NOTICEABLE``
    # vertices more than ``STRAY`` deep, those beyond the grid, and how deep the deepest is; None if
    # no sample is exact, and it is no mask
    strays: dict[str, Any] | None = None
    sample_volume: float | None = None  # of a mask: of its samples inside, each of which is a box
    volume_ml: float | None = None  # of the mesh, in millilitres, if its unit is stated

    @property
    def has_evidence(self) -> bool:
        """Whether any sample is exact."""
        return len(self.values) > 0

    def figures(self) -> dict[str, Any]:
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

    def report(self) -> dict[str, Any]:
        """Return the certificate as it stands in JSON; residuals and depths are in voxels."""
        return {
            "voxel_size": self.grid.voxel_size,
            "surface": self.surface.report(),
            "samples": self.samples,
            "residual": self.figures() if self.has_evidence else None,
            "wrong_side": int(self.wrong_side.sum()) if self.has_evidence else None,
            "strays": self.strays,
            "sample_volume": self.sample_volume,
            "volume_ml": self.volume_ml,
            "faults": self.faults(),
            "inferred": list(self.grid.notes),
        }

    def faults(self) -> list[str]:
        """Return what is wrong with the mesh whatever the limits, in words."""
        wrong, strays = int(self.wrong_side.sum()), self.strays["count"] if self.strays else 0
        found = [f"{wrong:,} samples on the wrong side"] * (wrong > 0)
        found += [f"{strays:,} vertices where the grid has no surface"] * (strays > 0)
        return self.surface.faults() + found

    def lines(self) -> list[str]:
        """Return the certificate as lines for users."""
        of, samples, h = self.surface, self.samples, self.grid.voxel_size
        ml = "" if self.volume_ml is None else f" ({self.volume_ml:.6g} ml)"
        lines = [
            f"mesh: {of.vertices:,} vertices, {of.triangles:,} triangles, {of.components:,} "
            f"piece{'s' * (of.components != 1)}, volume {of.volume:.6g}{ml}, area {of.area:.6g}",
            f"shape: {of.slivers:,} slivers (triangles with an angle under {SLIVER:g} degrees), "
            f"{of.needles:,} needles (vertices at the tip of a spike)",
        ]
        if any(samples.values()):
            text = "samples: {exact:,} exact near the surface, {cut_off:,} cut off and {noisy:,} "
            lines.append(text.format(**samples) + "noisy left out")
        if self.has_evidence:
            figures = self.figures()
            at = ", ".join(f"{x:.6g}" for x in figures["largest_at"])
            text = "residual in voxels: mean {mean:.4f}, 99th percentile {p99:.4f}, largest "
            text += f"{{largest_signed:+.4f}} at ({at}), {figures['largest'] * h:.4g} {WORLD}"
            lines.append(text.format(**figures))
            text = "{share_above_tenth:.2%} of the samples ({share_not_touching:.2%} not touching, "
            text += "{share_pierced:.2%} pierced)"
            lines.append(f"above {NOTICEABLE:g} voxel: {text.format(**figures)}")
        else:
            why = "no sample is exact" if any(samples.values()) else "the samples are no distances"
            lines.append(f"residual: unknown, since {why}")
        if self.sample_volume:
            lines.append(f"volume of the samples inside: {self.sample_volume:.6g}; {self._off()}")
        counted = of.self_intersections is not None
        sound = "closed, oriented, manifold" + ", no self-intersections" * counted
        lines.append("faults: " + "; ".join(self.faults() or [f"none ({sound})"]))
        lines += ["self-intersections: not counted"] * (not counted)
        if self.strays and self.strays["beyond"]:
            lines.append(f"{self.strays['beyond']:,} vertices lie beyond the grid, unchecked")
        return lines

    def _off(self) -> str:
        share = self.surface.volume / (self.sample_volume or 1) - 1
        return f"the mesh's volume is {share:+.2%} off that of the samples"

    def summary(self) -> str:
        """Return the certificate in one line."""
        if not self.has_evidence:
            said = ["no sample is exact, so the residual is unknown"]
            return "; ".join(said + [self._off()] * bool(self.sample_volume) + self.faults())
        text = "residual {mean:.4f} voxels in the mean, {largest:.4f} at most, "
        text += f"{{share_above_tenth:.2%}} of {len(self.values):,} samples above {NOTICEABLE:g}"
        return "; ".join([text.format(**self.figures()), *(self.faults() or ["no faults"])])

    def residuals_at(self, vertices: NDArray[Any]) -> FloatArray:
        """Return the residual at positions on the mesh, (n,); NaN where no foot point is near.

        Its size is the mean of the absolute residuals at the nearest foot points of the samples
        around, each weighted by the inverse of its distance; its sign is that of the mean with
        signs.
        """
        grid, index = self.grid, VoxelIndex(self.voxel_ijk, self.grid.shape)
        residuals = np.full(len(vertices), np.nan, np.float32)
        for chunk in chunks_of(len(vertices) * self.has_evidence, 8 * len(NEIGHBOURHOOD)):
            some = np.asarray(vertices[chunk], np.float64)
            nearest = np.rint(grid.to_index(some)).astype(np.int64)
            rows = index.find(nearest[:, None] + NEIGHBOURHOOD)
            away = np.linalg.norm(some[:, None] - self.feet[rows], axis=2) / grid.voxel_size
            away[rows < 0] = np.inf
            limit = np.partition(away, NEAREST_FEET - 1, axis=1)[:, NEAREST_FEET - 1, None]
            weight = np.where(away <= np.minimum(limit, FARTHEST), 1 / (away + SMOOTHING), 0)
            there = self.residuals[rows]
            with np.errstate(invalid="ignore"):
                size = (weight * np.abs(there)).sum(1) / weight.sum(1)
            residuals[chunk] = np.copysign(size, (weight * there).sum(1))
        return residuals


def check_limits(limits: Mapping[str, float | None]) -> None:
    """Raise OptionError if one of ``LIMITS``, None for those not asked for, is out of range."""
    for name, limit in limits.items():
        most, words = (1, "share from 0 to 1") if name == "max_share" else (1e300, FROM_ZERO)
        if limit is not None and not 0 <= limit <= most:
            raise OptionError(f"--{name.replace('_', '-')} is {limit:g}: give a {words}")


def exceeded(certificate: Certificate, limits: Mapping[str, float | None]) -> list[str]:
    """Return a sentence for each of ``LIMITS`` that a certificate exceeds."""
    asked = {name: limit for name in LIMITS if (limit := limits[name]) is not None}
    if asked and not certificate.has_evidence:
        return ["no sample is exact, so no limit on residuals can be shown to be kept"]
    figures, found = certificate.figures() if asked else {}, []
    for name, limit in asked.items():
        key, words, unit = LIMITS[name]
        figure = figures[key] * (certificate.grid.voxel_size if unit == WORLD else 1)
        if figure > limit:
            value = f"{figure:.4g} {unit}".rstrip()
            found.append(f"{words} {value}, --{name.replace('_', '-')} is {limit:g}")
    return found


def read_for_check(
    mesh: str | Path, grid: str | Path, options: Options, made: Any = None
) -> tuple[Mesh, SdfGrid]:
    """Return a mesh and its grid: those that were ``made``, else read from their files.

    ``options`` are those that the mesh was made with: how the grid is read, the unit.
    """
    if made is not None:
        return merged(made.mesh), made.grid
    samples, read = read_grid(grid, **options.reading()), read_mesh(mesh, options.max_memory)
    if options.unit and Path(mesh).suffix.lower() == ".glb":  # it is in metres
        read = Mesh(read.vertices / LENGTHS[options.unit], read.faces)
    return read, samples


def check_mesh(
    mesh: Mesh, grid: SdfGrid, options: Options = AS_GIVEN, *, intersections: bool = True
) -> Certificate:
    """Check a mesh against the grid that it was made from.

    Vertices at the same position must be one vertex, as ``read_mesh`` returns them. Of the options
    the offset and the memory bound count. To count self-intersections takes up to half of the time.
    GridError if the grid has no surface at the offset; OutOfMemoryError if the search trees would
    not fit in memory.
    """
    offset, lattice = options.offset, cubic_grid(grid, options.offset)
    band = survey(lattice, offset, threads=useful_threads(0))
    if not len(band.voxel_ijk):
        raise no_surface(grid, offset)
    need = len(mesh.faces) * BYTES_PER_TRIANGLE + len(band.voxel_ijk) * BYTES_PER_SAMPLE
    check_bound(need, f"checking {len(mesh.faces):,} triangles", options.max_memory)
    surface = examine_surface(mesh, len(Solid(mesh).intersecting()) if intersections else None)
    found = touch(mesh, band, lattice, surface)
    give_back()
    is_mask, strays = lattice.field.sides_only, None
    if is_mask or found.has_evidence:
        strays = find_strays(mesh.vertices, lattice, offset, OFF_OF_MASKS * is_mask)
    volume = volume_of_samples(grid, offset) if is_mask else None
    ml = surface.volume * (100 * LENGTHS[options.unit]) ** 3 if options.unit else None
    return replace(found, strays=strays, sample_volume=volume, volume_ml=ml)


def examine_surface(mesh: Mesh, crossing: int | None = None) -> Surface:
    """Return what a mesh is as a surface; vertices at the same position must be one vertex."""
    whole = Mesh(mesh.vertices, mesh.faces[(mesh.faces != np.roll(mesh.faces, 1, 1)).all(1)])
    opposite, uses, flipped = whole.pair_edges()
    fans = whole.count_fans(opposite)
    corners, at = whole.vertices[whole.faces].astype(np.float64), whole.faces.ravel()
    sides = (np.roll(corners, -1, axis=1) - corners).reshape(-1, 3)
    lengths = np.maximum(np.linalg.norm(sides, axis=1), 1e-300)
    degrees = np.bincount(at, minlength=len(fans))
    sums = np.stack([np.bincount(at, side / lengths, len(fans)) for side in sides.T], axis=1)
    tips = (np.linalg.norm(sums, axis=1) > NEEDLE * degrees) & (degrees > 2)
    return Surface(
        open_edges=int((uses % 2).sum()),
        crowded_edges=int((uses > 2).sum()),
        flipped_edges=flipped,
        vertices=len(whole.vertices),
        triangles=len(whole.faces),
        pinched_vertices=int(np.count_nonzero(fans > 1)),
        components=whole.components()[0],
        self_intersections=crossing,
        volume=whole.volume(),
        area=whole.area(),
        slivers=int(np.count_nonzero(smallest_angles(corners) < SLIVER)),
        needles=int(np.count_nonzero(tips)),
    )


def touch(mesh: Mesh, band: Band, grid: SdfGrid, surface: Surface) -> Certificate:
    """Return where the balls of the exact samples of a band meet a mesh.

    On which side of the mesh a sample lies is by its winding number; but if the mesh is one closed
    sheet that does not meet itself, not where the nearest triangle agrees with the sample.
    """
    values = band.patches[:, CENTRE]
    # ``exact`` keeps truncated samples beside the surface, whose neighbours are steep
    trusted = band.exact & (values > values.min()) & (values < values.max())
    rows = np.flatnonzero(trusted & band.sampled)  # what is interpolated promises nothing
    sampled = int(np.count_nonzero(band.sampled))
    # if none is exact, too many are no distances for any to be taken for one
    noisy = int(np.count_nonzero(band.sampled & ~band.lipschitz)) if len(rows) else sampled
    ijk, values = band.voxel_ijk[rows], values[rows] * np.float32(0.5)
    points, solid = grid.to_world(ijk), Solid(mesh)
    found, faces, feet = solid.nearest(points)
    normals = solid.normals()[faces]  # and the cosines to them of the ways from the feet
    sizes, dots = np.linalg.norm(normals, axis=1) * found, ((points - feet) * normals).sum(1)
    cosines = np.divide(dots, sizes, out=np.zeros(len(points)), where=sizes > 0)
    distances, size = found / grid.voxel_size, np.abs(values)
    residuals, wrong = (distances - size).astype(np.float32), np.zeros(len(size), bool)
    is_sheet = surface.components == 1 and surface.self_intersections == 0 and not surface.faults()
    agreed = is_sheet & (np.where(values > 0, 1, -1) * cosines > CLEAR)
    apart = np.flatnonzero((distances + size > NOTICEABLE) & ~agreed)  # where the side matters
    wrong[apart] = solid.is_inside(points[apart]) != (values[apart] <= 0)
    are_distances = grid.field.network is not None and not grid.field.sides_only
    counts = {"exact": len(rows), "cut_off": sampled - len(rows) - noisy, "noisy": noisy}
    samples = {name: count * are_distances for name, count in counts.items()}
    found_there = ijk, points, values, residuals, feet, wrong
    return Certificate(mesh, grid, surface, samples, *found_there)


def find_strays(
    vertices: NDArray[Any], grid: SdfGrid, offset: float, slack: float
) -> dict[str, Any]:
    """Return ``Certificate.strays``; values may be off by ``slack``, as those of masks are."""
    position = grid.to_index(vertices)
    nearest = np.rint(position).astype(np.int64)
    inside = ((nearest >= 0) & (nearest < grid.shape)).all(1)
    position, nearest = position[inside], nearest[inside]
    values = np.zeros(len(nearest))
    for planes in chunks_of(grid.shape[0], grid.shape[1] * grid.shape[2]):
        rows = np.flatnonzero((nearest[:, 0] >= planes.start) & (nearest[:, 0] < planes.stop))
        some = rescale(grid, offset, planes.start, planes.stop)
        values[rows] = some[tuple((nearest[rows] - np.array([planes.start, 0, 0])).T)]
    depth = np.abs(values) / 2 - np.linalg.norm(position - nearest, axis=1) - slack
    count, beyond = int((depth > STRAY).sum()), int((~inside).sum())
    return {"count": count, "beyond": beyond, "deepest": float(depth.max(initial=0))}


def check_coloured(path: Path, *, force: bool = False) -> None:
    """Raise if a coloured mesh cannot be written; called before the work starts."""
    if path.suffix.lower() != ".ply":
        raise OptionError(f"{path} is not a coloured mesh file: give .ply")
    check_free(path, force=force)


def write_coloured(certificate: Certificate, path: Path, *, force: bool = False) -> None:
    """Write the mesh of a certificate as PLY, with a colour and ``residual`` for each vertex."""
    residuals = certificate.residuals_at(certificate.mesh.vertices)
    write_coloured_ply(certificate.mesh, residuals, colours(residuals), path, force=force)


def colours(residuals: FloatArray) -> NDArray[np.uint8]:
    """Return red, green and blue, (n, 3), of residuals (n,) in voxels."""
    share = np.nan_to_num(np.clip(np.abs(residuals) / FULL, 0, 1))[:, None]
    end = np.where((residuals < 0)[:, None], PIERCED, NOT_TOUCHING)
    mixed = (1 - share) * np.array(TOUCHING) + share * end
    mixed[np.isnan(residuals)] = UNKNOWN
    return np.rint(mixed).astype(np.uint8)
