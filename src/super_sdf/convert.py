"""Conversion of one grid file to one mesh file: read, refine, mesh, write, report."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .files.formats import files_of
from .files.grids import read_grid
from .files.meshes import World, check_mesh_suffix, write_meshes
from .files.output import check_apart, check_free
from .grid.sdf_grid import SdfGrid, describe_place, mean_spacing, volume_of_samples
from .pipeline import Result, mesh_grid
from .threads import STEPS, Progress, Steps

if TYPE_CHECKING:
    from .network.contract import Decoder
    from .options import Options
    from .surface.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Conversion:
    """The result of a conversion."""

    grid: SdfGrid  # as it was read
    mesh: Mesh  # as it was written
    facts: dict[str, Any]  # as ``--json`` has them: docs/reference/json.md
    seconds: dict[str, float]  # per stage


def convert(
    source: str | Path,
    target: str | Path,
    network: Decoder,
    options: Options,
    *,
    force: bool = False,
    progress: Progress | None = None,
    save_field: str | Path | None = None,
    **how: Any,
) -> Conversion:
    """Convert a grid file to a mesh file, in formats of ``read_grid`` and ``write_mesh``.

    ``force`` replaces the target, and the field's file, if they exist. ``progress`` is called with
    (done, total), see ``threads.Progress``; an exception in it ends the work. ``save_field`` is a
    file for the refined field, in a format of ``write_field``: it and the mesh file are both
    complete at the end, or neither is written. ``how`` is passed to ``mesh_grid``.

    SuperSdfError as in ``read_grid``, ``reconstruct``, ``simplify_mesh`` and ``write_mesh``.
    """
    steps, files, saved = Steps(progress, STEPS), files_of(source), dict[str, Any]()
    check_free(check_mesh_suffix(Path(target)), force=force)
    check_apart(target, files)
    with ExitStack() as saving:
        if save_field is not None:
            from .files.fields import saving_field

            check_apart(save_field, files)
            write = saving.enter_context(saving_field(save_field, force=force))
            how["save_field"] = lambda field: saved.update(write(field))
        grid = read_grid(source, **options.reading())
        unit = options.unit_for(Path(target), grid.flagged)
        if options.keep_volume:
            from .labels.volumes import check_has_volume  # imported here, as few need it

            check_has_volume(grid, options.offset, cap=options.cap)
        steps.finish("read")
        made = mesh_grid(grid, network, options, steps=steps, **how)
        facts = _facts(grid, made, options)
        mesh = _finished(made.mesh, grid, options, facts)
        steps.lap("simplify" if options.goals() else "isosurface")
        write_meshes({Path(target): {"": mesh}}, force=force, world=World(unit, grid.space))
        steps.lap("write")
    if saved:
        facts["saved_field"] = saved
    return Conversion(grid, mesh, facts, steps.seconds)


def _facts(grid: SdfGrid, made: Result, options: Options) -> dict[str, Any]:
    """Return what is known of how a mesh was made, for JSON."""
    notes, warnings = made.said(grid)
    return {
        **describe_place(grid),
        "band_voxels": made.whole.count,
        "noisy_voxels": made.whole.noisy,
        "tiles": made.tiles,
        "factor": options.factor_for(mask=grid.field.sides_only),
        "closed": not made.open_edges,
        "capped": made.capped,
        "field": grid.field.report(),
        "inferred": notes,
        "warnings": warnings,
    }


def _finished(mesh: Mesh, grid: SdfGrid, options: Options, facts: dict[str, Any]) -> Mesh:
    """Return the mesh, with the volume of its samples and simplified, if so asked; add facts."""
    volume = volume_of_samples(grid) if options.keep_volume else None
    if volume is not None:
        from .labels.volumes import keep_volumes, volume_notes
        from .simplify.walls import Walls

        kept = keep_volumes(Walls.of(mesh), [volume], mean_spacing(grid))
        mesh = replace(mesh, vertices=kept.vertices)
    if options.goals():
        from .simplify.simplify import simplified

        error = options.error(grid.voxel_size)
        mesh = made = simplified(mesh, error, options.triangles, options.max_memory)
        facts["simplified"], facts["closed"] = made.report(grid.voxel_size), made.is_closed()
        facts["warnings"] += made.warnings
    if volume is not None:
        facts["inferred"] += volume_notes({"the mesh": (mesh.volume(), volume)})
    facts |= {"vertices": len(mesh.vertices), "triangles": len(mesh.faces)}
    facts["bounds"] = [[end(x).item() for x in mesh.vertices.T] for end in (np.min, np.max)]
    return mesh
