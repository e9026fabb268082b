"""The certificate of a mesh: its faults as a surface, and how well it fits its grid's samples.

>>> from super_sdf.certificate.check import check_files
>>> check_files("part.ply", "part.npz").report()                         # doctest: +SKIP
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..errors import OutOfMemoryError
from ..files.grids import read_grid
from ..files.regular import check_regular_file
from ..grid.cubic import cubic_grid
from ..grid.sdf_grid import SdfGrid
from ..machine.memory import give_back, held_memory, in_words
from ..machine.resources import Resources, allot
from ..machine.threads import useful_threads
from ..mesh import Mesh
from ..options import ConvertOptions, ReadOptions, check_distance, check_max_memory
from ..steps.survey import no_surface, survey
from ..truth.mesh_files import read_mesh
from .slabs import search
from .strays import Strays, find_strays
from .surface import Surface, examine_surface
from .touching import NOTICEABLE, Touching, exact_samples, touch

# Bytes for each triangle and each exact sample, beside mesh and band, at the most: search trees.
BYTES_PER_TRIANGLE = 420
BYTES_PER_SAMPLE = 150
REACH = 2.0  # voxels: how far slabs look; the samples near the surface are within 1.4 of it
HEADER_BYTES = 4096  # of a PLY file, in which the number of faces is looked for


@dataclass(frozen=True, kw_only=True)
class CheckOptions(ReadOptions):
    """How the grid of a mesh is read, and what is counted; see ``ConvertOptions``.

    Attributes
    ----------
    offset : float
        As given when the mesh was made, like how its grid was read.
    intersections : bool
        Count self-intersections, which takes up to half of the time.
    processes : int
        How many may search large meshes at the same time; 0: one per core.
    """

    offset: float = 0.0
    intersections: bool = True
    processes: int = 1

    @classmethod
    def of(cls, options: ConvertOptions) -> CheckOptions:
        """Return how a grid is read that was converted with these options."""
        return cls(**options.reading(), offset=options.offset)


@dataclass(frozen=True, eq=False)
class Certificate:
    """What is certain of a mesh without the true surface.

    Attributes
    ----------
    mesh : Mesh
        Vertices at the same position are one.
    voxel_size : float
        Spacing of the grid, in world units.
    surface : Surface
        Whether the mesh bounds a solid, and which.
    touching : Touching
        The residual of each exact sample.
    strays : Strays, optional
        Vertices far from any surface of the grid; None if no sample is exact.
    notes : tuple of str
        What was inferred of the grid.
    """

    mesh: Mesh
    voxel_size: float
    surface: Surface
    touching: Touching
    strays: Strays | None
    notes: tuple[str, ...]

    def report(self) -> dict[str, Any]:
        """Return the certificate as it stands in JSON; residuals and depths are in voxels."""
        return {
            "voxel_size": self.voxel_size,
            "surface": self.surface.report(),
            **self.touching.report(),
            "strays": None if self.strays is None else asdict(self.strays),
            "faults": self.faults(),
            "inferred": list(self.notes),
        }

    def faults(self) -> list[str]:
        """Return what is wrong with the mesh whatever the limits, in words."""
        wrong, found = int(self.touching.wrong_side.sum()), self.surface.faults()
        found += [f"{wrong:,} samples on the wrong side"] * (wrong > 0)
        if self.strays and self.strays.count:
            found.append(f"{self.strays.count:,} vertices where the grid has no surface")
        return found

    def lines(self) -> list[str]:
        """Return the certificate as lines for users."""
        return [self.surface_line(), *self.sample_lines(), *self.fault_lines()]

    def surface_line(self) -> str:
        """Return the size of the mesh in one line."""
        surface = self.surface
        pieces = f"{surface.components:,} component" + "s" * (surface.components != 1)
        return (
            f"mesh: {surface.vertices:,} vertices, {surface.triangles:,} triangles, {pieces}, "
            f"volume {surface.volume:.6g}, area {surface.area:.6g}"
        )

    def sample_lines(self) -> list[str]:
        """Return what the samples say, in a line or a few."""
        touching = self.touching
        left_out = f"{touching.cut_off:,} cut off and {touching.noisy:,} noisy left out"
        lines = [f"samples: {len(touching.values):,} exact near the surface, {left_out}"]
        if not len(touching.values):
            return [*lines, "residual: unknown, since no sample is exact"]
        figures = touching.summary()
        at = ", ".join(f"{x:.6g}" for x in figures["largest_at"])
        return [
            *lines,
            f"residual in voxels: mean {figures['mean']:.4f}, 99th percentile "
            f"{figures['p99']:.4f}, largest {figures['largest_signed']:+.4f} at ({at})",
            f"above {NOTICEABLE:g} voxel: {figures['share_above_tenth']:.2%} of the samples "
            f"({figures['share_not_touching']:.2%} not touching, "
            f"{figures['share_pierced']:.2%} pierced)",
        ]

    def fault_lines(self) -> list[str]:
        """Return the faults in one line, and what was not looked for."""
        counted = self.surface.self_intersections is not None
        sound = "closed, oriented, manifold" + ", no self-intersections" * counted
        lines = ["faults: " + "; ".join(self.faults() or [f"none ({sound})"])]
        if not counted:
            lines.append("self-intersections: not counted")
        if self.strays and self.strays.beyond:
            lines.append(f"{self.strays.beyond:,} vertices lie beyond the grid and are unchecked")
        return lines

    def summary(self) -> str:
        """Return the certificate in one line."""
        if not len(self.touching.values):
            return "; ".join(["no sample is exact, so the residual is unknown", *self.faults()])
        figures = self.touching.summary()
        said = (
            f"residual {figures['mean']:.4f} voxels in the mean, {figures['largest']:.4f} at most, "
            f"{figures['share_above_tenth']:.2%} of {len(self.touching.values):,} samples above "
            f"{NOTICEABLE:g}"
        )
        return "; ".join([said, *(self.faults() or ["no faults"])])


def check_files(
    mesh: str | Path, grid: str | Path, options: CheckOptions | None = None
) -> Certificate:
    """Check a mesh file against the grid file that it was made from.

    Raises
    ------
    SuperSdfError
        As ``read_mesh``, ``read_grid`` and ``check_mesh`` raise it.
    """
    options = options or CheckOptions()
    return check_mesh(*read_for_check(mesh, grid, options), options)


def read_for_check(
    mesh: str | Path, grid: str | Path, options: CheckOptions
) -> tuple[Mesh, SdfGrid]:
    """Return a mesh and the grid that it was made from; raise OutOfMemoryError before both."""
    bound = allot(0, check_max_memory(options.max_memory))
    check_room(stated_triangles(check_regular_file(mesh)), 0, bound)
    found = read_grid(grid, **options.reading())
    return read_mesh(mesh, options.max_memory), found


def check_mesh(mesh: Mesh, grid: SdfGrid, options: CheckOptions | None = None) -> Certificate:
    """Check a mesh against the grid that it was made from.

    Parameters
    ----------
    mesh : Mesh
        Vertices at the same position must be one vertex, as ``read_mesh`` returns them.
    grid : SdfGrid
        Coarse signed distances.
    options : CheckOptions
        Of these: the offset, the memory bound, and what is counted.

    Raises
    ------
    GridError
        If the grid has no surface at the offset.
    OutOfMemoryError
        If the search trees would not fit in memory.
    """
    options = options or CheckOptions()
    offset = check_distance(options.offset)
    resources = allot(0, check_max_memory(options.max_memory))
    grid = cubic_grid(grid, offset)
    band = survey(grid, offset, resources)
    if not len(band.voxel_ijk):
        raise no_surface(grid, offset)
    check_room(len(mesh.faces), len(band.voxel_ijk), resources)
    samples = exact_samples(band, grid)
    del band
    give_back()
    found = search(
        mesh,
        samples.points,
        REACH * grid.voxel_size,
        intersections=options.intersections,
        processes=useful_threads(options.processes),
    )
    surface = examine_surface(mesh, found.intersections)
    give_back()
    touching = touch(mesh, samples, found, grid.voxel_size, simple=surface.is_simple)
    del found
    give_back()
    strays = find_strays(mesh.vertices, grid, offset) if len(touching.values) else None
    return Certificate(mesh, grid.voxel_size, surface, touching, strays, grid.notes)


def stated_triangles(path: Path) -> int:
    """Return how many triangles a mesh file has, by its header; 0 if that does not tell."""
    with path.open("rb") as file:
        header = file.read(HEADER_BYTES)
    if path.suffix.lower() == ".ply":
        found = re.search(rb"^element face (\d{1,12})\s*$", header, re.MULTILINE)
        return int(found.group(1)) if found else 0
    count = int.from_bytes(header[80:84], "little")
    is_stl = path.suffix.lower() == ".stl" and path.stat().st_size == 84 + 50 * count
    return count if is_stl else 0


def check_room(triangles: int, samples: int, resources: Resources) -> None:
    """Raise OutOfMemoryError if checking a mesh of ``triangles`` would exceed the memory bound."""
    need = triangles * BYTES_PER_TRIANGLE + samples * BYTES_PER_SAMPLE + (held_memory() or 0)
    if resources.memory is not None and need > resources.memory:
        raise OutOfMemoryError(
            f"checking {triangles:,} triangles needs {in_words(need)} of memory, "
            f"{in_words(resources.memory)} may be taken in all; allow more (--max-memory)"
        )
