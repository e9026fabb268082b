"""The certificate of a mesh: its faults as a surface, and how well it fits its grid's samples.

>>> from super_sdf.check.check import check_files
>>> check_files("part.ply", "part.npz").report()                         # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..errors import OptionError, OutOfMemoryError
from ..files.grids import read_grid
from ..files.mesh_writers import write_coloured_ply
from ..files.output import check_free
from ..grid.sdf_grid import SdfGrid, cubic_grid, volume_of_samples
from ..options import LENGTHS, MASK, Options
from ..refine.survey import Band, no_surface, survey
from ..surface.mesh import Mesh
from ..threads import give_back, held_memory, in_words, memory_bound, useful_threads
from ..truth.mesh_files import merged, read_mesh
from .evidence import NOTICEABLE, Strays, Surface, Touching, find_strays, touch, vertex_residuals

# Bytes for each triangle and each voxel of the band, beside mesh and band: search trees.
BYTES_PER_TRIANGLE = 420
BYTES_PER_SAMPLE = 150
OFF_OF_MASKS = 0.5  # voxels by which the distances that are made of a mask may be off
NO_EVIDENCE = "no sample is exact, so no limit on residuals can be shown to be kept"
AS_GIVEN = Options()
FULL = 0.1  # voxels: residual at which a colour is saturated
TOUCHING, PIERCED = (240, 240, 240), (190, 20, 30)
NOT_TOUCHING, UNKNOWN = (20, 70, 190), (120, 120, 60)
WORLD = "in world units"
LIMITS = {
    "max_residual": ("largest", "the largest residual is", "voxels"),
    "tolerance": ("largest", "the largest residual is", WORLD),
    "max_mean": ("mean", "the mean residual is", "voxels"),
    "max_share": ("share_above_tenth", "above 0.1 voxel is", ""),
}
"""Options, the figures that they limit, and how these are named, with their unit."""


@dataclass(frozen=True, eq=False)
class Certificate:
    """What is certain of a mesh without the true surface."""

    mesh: Mesh  # vertices at the same position are one
    grid: SdfGrid  # on its cubic lattice
    surface: Surface
    touching: Touching
    strays: Strays | None  # None if no sample is exact, and it is no mask
    sample_volume: float | None = None  # of a mask: of its samples inside, each of which is a box

    @property
    def voxel_size(self) -> float:
        """The spacing of the grid, in world units."""
        return self.grid.voxel_size

    @property
    def has_evidence(self) -> bool:
        """Whether any sample is exact."""
        return len(self.touching.values) > 0

    def report(self) -> dict[str, Any]:
        """Return the certificate as it stands in JSON; residuals and depths are in voxels."""
        return {
            "voxel_size": self.voxel_size,
            "surface": self.surface.report(),
            **self.touching.report(),
            "strays": None if self.strays is None else asdict(self.strays),
            "sample_volume": self.sample_volume,
            "faults": self.faults(),
            "inferred": list(self.grid.notes),
        }

    def faults(self) -> list[str]:
        """Return what is wrong with the mesh whatever the limits, in words."""
        wrong, strays = int(self.touching.wrong_side.sum()), self.strays.count if self.strays else 0
        found = [f"{wrong:,} samples on the wrong side"] * (wrong > 0)
        found += [f"{strays:,} vertices where the grid has no surface"] * (strays > 0)
        return self.surface.faults() + found

    def lines(self) -> list[str]:
        """Return the certificate as lines for users."""
        surface, touching, faults = self.surface, self.touching, self.faults()
        pieces = f"{surface.components:,} component" + "s" * (surface.components != 1)
        lines = [
            f"mesh: {surface.vertices:,} vertices, {surface.triangles:,} triangles, {pieces}, "
            f"volume {surface.volume:.6g}, area {surface.area:.6g}",
            f"samples: {len(touching.values):,} exact near the surface, {touching.cut_off:,} cut "
            f"off and {touching.noisy:,} noisy left out",
        ]
        if self.has_evidence:
            figures = touching.summary()
            at = ", ".join(f"{x:.6g}" for x in figures["largest_at"])
            lines += [
                f"residual in voxels: mean {figures['mean']:.4f}, 99th percentile "
                f"{figures['p99']:.4f}, largest {figures['largest_signed']:+.4f} at ({at}), "
                f"{figures['largest'] * self.voxel_size:.4g} in world units",
                f"above {NOTICEABLE:g} voxel: {figures['share_above_tenth']:.2%} of the samples "
                f"({figures['share_not_touching']:.2%} not touching, "
                f"{figures['share_pierced']:.2%} pierced)",
            ]
        else:
            lines.append("residual: unknown, since no sample is exact")
        if self.sample_volume:
            lines.append(f"volume of the samples inside: {self.sample_volume:.6g}; {self._off()}")
        counted = surface.self_intersections is not None
        sound = "closed, oriented, manifold" + ", no self-intersections" * counted
        lines.append("faults: " + "; ".join(faults or [f"none ({sound})"]))
        lines += ["self-intersections: not counted"] * (not counted)
        if self.strays and self.strays.beyond:
            lines.append(f"{self.strays.beyond:,} vertices lie beyond the grid and are unchecked")
        return lines

    def _off(self) -> str:
        share = self.surface.volume / (self.sample_volume or 1) - 1
        return f"the mesh's volume is {share:+.2%} off that of the samples"

    def summary(self) -> str:
        """Return the certificate in one line."""
        if not self.has_evidence:
            said = ["no sample is exact, so the residual is unknown"]
            said += [self._off()] if self.sample_volume else []
            return "; ".join([*said, *self.faults()])
        figures = self.touching.summary()
        residual = (
            f"residual {figures['mean']:.4f} voxels in the mean, {figures['largest']:.4f} at most, "
            f"{figures['share_above_tenth']:.2%} of {len(self.touching.values):,} samples above "
            f"{NOTICEABLE:g}"
        )
        return "; ".join([residual, *(self.faults() or ["no faults"])])

    def residuals_at(self, vertices: NDArray[Any]) -> FloatArray:
        """Return ``vertex_residuals`` at positions on the mesh."""
        return vertex_residuals(vertices, self.touching, self.grid)


def check_limits(limits: Mapping[str, float | None]) -> None:
    """Raise OptionError if one of ``LIMITS``, None for those not asked for, is out of range."""
    for name in LIMITS:
        limit, option = limits[name], f"--{name.replace('_', '-')}"
        if limit is not None and not 0 <= limit < float("inf"):
            raise OptionError(f"{option} is {limit:g}: give a number from 0 on")
    if (share := limits["max_share"]) is not None and share > 1:
        raise OptionError(f"--max-share is {share:g}: give a share from 0 to 1")


def exceeded(certificate: Certificate, limits: Mapping[str, float | None]) -> list[str]:
    """Return a sentence for each of ``LIMITS`` that a certificate exceeds."""
    asked = {name: limit for name in LIMITS if (limit := limits[name]) is not None}
    if asked and not certificate.has_evidence:
        return [NO_EVIDENCE]
    figures, found = certificate.touching.summary() if asked else {}, []
    for name, limit in asked.items():
        key, words, unit = LIMITS[name]
        figure = figures[key] * (certificate.voxel_size if unit == WORLD else 1)
        if figure > limit:
            value = f"{figure:.4g} {unit}".rstrip()
            found.append(f"{words} {value}, --{name.replace('_', '-')} is {limit:g}")
    return found


def check_files(
    mesh: str | Path,
    grid: str | Path,
    options: Options = AS_GIVEN,
    *,
    made: Any = None,
    intersections: bool = True,
) -> Certificate:
    """Check a mesh file against the grid file that it was made from; see ``check_mesh``.

    ``options`` are those that the mesh was made with: how the grid is read, the offset, the memory
    bound. What was ``made`` has the ``mesh`` and the ``grid``, so that they are not read again.
    """
    both = read_for_check(mesh, grid, options, made)
    return check_mesh(*both, options, intersections=intersections)


def read_for_check(
    mesh: str | Path, grid: str | Path, options: Options, made: Any = None
) -> tuple[Mesh, SdfGrid]:
    """Return a mesh and its grid: those that were ``made``, else read from their files."""
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
    band, offset = band_of(grid, options), options.offset
    bound, triangles = memory_bound(options.max_memory), len(mesh.faces)
    need = triangles * BYTES_PER_TRIANGLE + len(band.voxel_ijk) * BYTES_PER_SAMPLE
    need += held_memory() or 0
    if bound is not None and need > bound:
        raise OutOfMemoryError(
            f"checking {triangles:,} triangles needs {in_words(need)} of memory, "
            f"{in_words(bound)} may be taken in all; allow more (--max-memory)"
        )
    lattice = cubic_grid(grid, offset)
    touching, surface = touch(mesh, band, lattice, intersections=intersections)
    give_back()
    is_mask, strays = lattice.field.kind == MASK, None
    if is_mask or len(touching.values):
        strays = find_strays(mesh.vertices, lattice, offset, OFF_OF_MASKS * is_mask)
    volume = volume_of_samples(grid, offset) if is_mask else None
    return Certificate(mesh, lattice, surface, touching, strays, volume)


def band_of(grid: SdfGrid, options: Options = AS_GIVEN) -> Band:
    """Return the band of a grid on its cubic lattice; NoSurfaceError if it has none."""
    offset = options.offset
    band = survey(cubic_grid(grid, offset), offset, threads=useful_threads(0))
    if not len(band.voxel_ijk):
        raise no_surface(grid, offset)
    return band


def check_coloured(path: Path, *, force: bool = False) -> None:
    """Raise if a coloured mesh cannot be written; called before the work starts."""
    if path.suffix.lower() != ".ply":
        raise OptionError(f"{path} is not a coloured mesh file: give .ply")
    check_free(path, force=force)


def write_coloured(certificate: Certificate, path: Path, *, force: bool = False) -> None:
    """Write the mesh of a certificate as PLY, with a colour and ``residual`` for each vertex."""
    mesh = certificate.mesh
    residuals = certificate.residuals_at(mesh.vertices)
    write_coloured_ply(mesh, residuals, colours(residuals), path, force=force)


def colours(residuals: FloatArray) -> NDArray[np.uint8]:
    """Return red, green and blue, (n, 3), of residuals (n,) in voxels."""
    share = np.nan_to_num(np.clip(np.abs(residuals) / FULL, 0, 1))[:, None]
    end = np.where((residuals < 0)[:, None], PIERCED, NOT_TOUCHING)
    mixed = (1 - share) * np.array(TOUCHING) + share * end
    mixed[np.isnan(residuals)] = UNKNOWN
    return np.rint(mixed).astype(np.uint8)
