"""Conversion of one grid file to one mesh file: read, refine, extract the surface, write, report.

>>> from super_sdf.convert import ConvertOptions, convert
>>> convert("part.npz", "part.ply", load_network(), ConvertOptions())    # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .arrays import Triple
from .errors import check_modules
from .files.grids import read_grid
from .files.meshes import check_format_holds, check_target, local_origin_note, write_mesh
from .files.output import check_apart, check_free
from .files.regular import files_of
from .grid.cubic import cubic_grid
from .grid.placement import as_triple
from .grid.sdf_grid import SdfGrid
from .network.decoder import Decoder
from .options import MASK, SCALED, SHARP
from .options import ConvertOptions as ConvertOptions
from .pipeline import mesh_grid
from .progress import Progress, Stopwatch, part_of, share_of
from .refine.field import lattice_shape
from .surface.cap import check_can_close
from .surface.mesh import Mesh

if TYPE_CHECKING:
    from .files.fields import FieldFile
    from .simplify.simplify import Simplified

CAPPED = (
    "the solid runs out of the grid: its surface is closed along the border (leave it open with "
    "--open)"
)
SHARE_BEFORE = 0.2  # of the time, until the mesh is simplified


@dataclass(frozen=True, eq=False)
class Conversion:
    """The result of a conversion."""

    grid: SdfGrid  # as it was read
    mesh: Mesh  # as it was written
    counts: dict[str, int]  # ``refine.field.COUNTS``, vertices, triangles, tiles
    bounds: tuple[Triple, Triple]  # lowest and highest coordinates, in world units
    closed: bool  # no edge is open; else the surface leaves the grid and is not capped
    capped: bool  # the solid runs out of the grid, and was closed along the border
    warnings: tuple[str, ...]  # on what may be wrong with the result
    simplified: dict[str, Any] | None  # ``Simplified.report``; distances in voxels
    notes: tuple[str, ...] = ()  # on what was inferred
    seconds: dict[str, float] = field(default_factory=dict)  # per stage
    saved_field: dict[str, Any] | None = None  # its path; shape, spacing, origin of the lattice
    engine: dict[str, Any] = field(default_factory=dict)  # who did the work, if not this process

    def remarks(self) -> list[str]:
        """Return sentences on what the mesh has that the samples do not show, or lacks."""
        return [CAPPED] * self.capped

    def report(self) -> dict[str, Any]:
        """Return the result as a dictionary that can be written as JSON."""
        return {
            **describe_place(self.grid),
            **self.counts,
            "bounds": [list(corner) for corner in self.bounds],
            "closed": self.closed,
            "capped": self.capped,
            "field": self.grid.field.report(),
            **self.engine,
            **({"saved_field": self.saved_field} if self.saved_field else {}),
            **({"simplified": self.simplified} if self.simplified else {}),
            "inferred": list(self.notes),
            "warnings": list(self.warnings),
        }


def convert(
    source: str | Path,
    target: str | Path,
    network: Decoder,
    options: ConvertOptions,
    *,
    force: bool = False,
    progress: Progress | None = None,
    before_rename: Callable[[Path], None] | None = None,
    save_field: str | Path | None = None,
) -> Conversion:
    """Convert a grid file to a mesh file, in formats of ``read_grid`` and ``write_mesh``.

    ``force`` replaces the target, and the field's file, if they exist. ``progress`` is called with
    (done, total), see ``progress.Progress``; an exception in it ends the work. ``before_rename`` is
    called with the path of the finished temporary file, before it is renamed to ``target``.
    ``save_field`` is a file for the refined field, in a format of ``write_field``: it and the mesh
    file are both complete at the end, or neither is written.

    SuperSdfError as in ``read_grid``, ``reconstruct``, ``simplify_mesh`` and ``write_mesh``.
    Nothing is written then.
    """
    watch = Stopwatch()
    if options.goals():
        check_modules("simplifying", "simplify")
    grid = read_grid(source, **options.reading())
    if save_field is not None:
        check_apart(save_field, files_of(source))
    check_can_close(grid, cap=options.cap)
    check_apart(target, files_of(source))
    check_target(target, force=force, unit=options.unit)
    if options.keep_volume:
        from .labels.volumes import check_has_volume  # imported here, as few conversions need it

        check_has_volume(grid, options.offset, cap=options.cap)
    lattice = cubic_grid(grid, options.offset)
    check_format_holds(target, lattice, options.factor)
    watch.lap("read")
    shown = part_of(progress, 0, SHARE_BEFORE) if options.goals() else progress
    with _field_file(save_field, grid, options, force=force) as file:
        save = file.write if file else None
        made = mesh_grid(grid, network, options, progress=shown, save_field=save)
        watch.take(made.seconds)
        mesh, simplified, off = made.mesh, None, list[str]()
        if options.keep_volume or options.goals():
            mesh, simplified, off = _reworked(made.mesh, grid, options, progress)
            watch.lap("simplify" if simplified else "isosurface")

        def complete(part: Path) -> None:
            if file:
                check_free(file.path, force=force)  # both files appear, or none
            if before_rename:
                before_rename(part)

        write_mesh(
            mesh,
            target,
            force=force,
            unit=options.unit,
            space=grid.space,
            before_rename=complete,
        )
        watch.lap("write")
    counts = {**made.counts, "vertices": len(mesh.vertices), "triangles": len(mesh.faces)}
    counts["tiles"] = made.tiles
    is_open = made.open_edges > 0
    warnings = find_warnings(grid, options.offset, counts, is_open=is_open)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    return Conversion(
        grid,
        mesh,
        counts,
        bounds=(as_triple(low, "low"), as_triple(high, "high")),
        closed=simplified.mesh.is_closed() if simplified else not is_open,
        capped=options.cap and made.leaves,
        warnings=(*warnings, *(simplified.warnings if simplified else ())),
        simplified=simplified.report(grid.voxel_size) if simplified else None,
        notes=(
            *(*lattice.notes, *edges_note(lattice, options), *local_origin_note(target, [mesh])),
            *off,
        ),
        seconds=watch.seconds,
        saved_field=file.report if file else None,
    )


def describe_place(grid: SdfGrid) -> dict[str, Any]:
    """Return where the samples of a grid lie, for JSON."""
    return {
        "shape": list(grid.shape),
        "spacing": list(grid.spacing),
        "origin": list(grid.origin),
        "direction": [list(row) for row in grid.direction],
        "space": grid.space,
    }


def _field_file(
    path: str | Path | None, grid: SdfGrid, options: ConvertOptions, *, force: bool
) -> AbstractContextManager[FieldFile | None]:
    """Return the file to write the refined field to, which appears at the end; None without."""
    if path is None:
        return nullcontext()
    # imported here, since few conversions write a field, and the start is part of each
    from .files.fields import check_field_fits, check_field_target, saving_field

    check_can_close(grid, cap=options.cap)
    path, shape = check_field_target(path, force=force), lattice_shape(grid.shape, options.factor)
    check_field_fits(path, shape, options.max_memory)
    return saving_field(path, force=force)


def _reworked(
    mesh: Mesh, grid: SdfGrid, options: ConvertOptions, progress: Progress | None
) -> tuple[Mesh, Simplified | None, list[str]]:
    """Return the mesh with the volume of its samples, and simplified, if so asked, and notes."""
    simplified, off = None, list[str]()
    if options.keep_volume:
        from .labels.volumes import keep_volumes, mean_spacing, volume_notes, volume_of_samples

        volume = volume_of_samples(grid)
        (mesh,) = keep_volumes([mesh], [volume], mean_spacing(grid))
    if options.goals():
        from .simplify.simplify import simplify_mesh

        simplified = simplify_mesh(
            mesh,
            error=options.error(grid.voxel_size),
            triangles=options.triangles,
            max_memory=options.max_memory,
            progress=share_of(part_of(progress, SHARE_BEFORE, 1)),
        )
        mesh = simplified.mesh
    if options.keep_volume:  # simplifying may have changed it
        off = volume_notes({"the mesh": (mesh.volume(), volume)})
    return mesh, simplified, off


def edges_note(grid: SdfGrid, options: ConvertOptions) -> list[str]:
    """Return why no edges are found, if they were asked for."""
    if options.mesher != SHARP or grid.field.has_exact:
        return []
    return [f"{grid.field.kind} values show no edges: the mesh is that of marching cubes"]


def find_warnings(
    grid: SdfGrid, offset: float, counts: dict[str, int], *, is_open: bool
) -> list[str]:
    """Return a sentence on each thing that may be wrong with the mesh of a grid."""
    warnings = []
    if is_open and grid.field.unseen is not None:
        warnings.append("the surface ends where samples are unknown, and is open there")
    elif is_open:
        warnings.append("the surface runs out of the grid and is open there (close it with --cap)")
    if grid.low >= offset:
        thin = "no sample lies inside: the solid is thinner than the spacing"
        warnings.append(f"{thin}, and its mesh may have holes")
    if grid.field.kind in (MASK, SCALED):  # only distances can be noisy, or contradict each other
        return warnings
    if counts["noisy_voxels"]:
        share = in_percent(counts["noisy_voxels"], counts["band_voxels"])
        differ = f"in {share} of the band the values differ by more than distances can"
        warnings.append(f"{differ}: they are taken as noisy there, and corrected")
    if pinned := counts["pinned_nodes"]:
        contradict = f"{pinned} fine values contradict the coarse ones around them"
        way = "were given their sign: the input is no distance field there"
        warnings.append(f"{contradict} and {way}")
    return warnings


def in_percent(part: int, whole: int) -> str:
    """Return a share, which must not be 0, as a percentage with two digits."""
    share = 100 * part / whole
    if share < 0.01:
        return "less than 0.01 %"
    return f"{share:.0f} %" if share >= 9.95 else f"{share:.2g} %"
