"""Check the mesh file MESH, with GRID also against the signed distance grid that it was made from.

The true surface is not needed. Every exact sample is the radius of an empty ball that touches the
surface. The residual of a sample is its distance to the mesh minus the radius, in voxels: positive
if the mesh does not reach the ball, negative if the mesh pierces the ball. Without GRID only faults
are counted.

MESH is any mesh file that trimesh reads; vertices at the same position are merged. GRID is a grid
file as for upsample. Each part of a MESH of several labels is checked against its label in GRID.
The exit code is 1 if a limit is exceeded; without GRID, or with several parts, also for faults.

  super-sdf check part.ply part.npz
  super-sdf check part.ply part.npz --max-mean 0.01 --no-faults
  super-sdf check organs.glb labels.nii.gz --unit mm
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from click import Argument, FloatRange, Option

from ..errors import OptionError, check_modules
from ..options import READ, Options
from . import main

TAKES = (
    Argument(["mesh"], metavar="MESH", type=main.FILE),
    Argument(["grid"], metavar="[GRID]", required=False, type=main.NAME),
    Option(["--tolerance"], type=FloatRange(0), metavar="D",
        help="Fail if the largest residual of a sample is above D, in world units."),
    Option(["--max-mean"], type=FloatRange(0), metavar="VOXELS",
        help="Fail if the mean of the absolute residuals is above VOXELS."),
    Option(["--no-faults"], is_flag=True,
        help="Fail if the mesh is open, not manifold, not oriented outward, intersects itself, has "
        "samples on the wrong side, or vertices where the grid has no surface."),
    *READ, "names",
    main.table_option("offset", "The --offset with which the mesh was made."),
    main.table_option("unit", "Unit of the mesh: the --unit of a .glb; also for volumes in ml."),
    main.table_option("max_memory", "Memory limit of the process, such as 4G. Default: 60 % of the "
        "free memory. Larger meshes are refused."),
    "json", "quiet",
)  # fmt: skip


def command(mesh: Path, grid: str | None, **given: Any) -> None:
    """Check the mesh, print a certificate of each part, and fail where it exceeds a limit."""
    check_modules("check", "report", ("igl",))
    limits = given.pop("tolerance"), given.pop("max_mean")
    if grid is None and limits != (None, None):
        raise OptionError("--tolerance and --max-mean are limits of residuals: give a GRID, too")
    found = certificates(mesh, grid, main.chosen_options(given, grid or "-"), given["names"])
    alone = found.get("")  # a mesh beside its grid
    failed = [said for each in found.values() if grid for said in each.exceeded(*limits)]
    if given["no_faults"] or not alone:
        wrong = [(name or "the mesh", x) for name, each in found.items() for x in each.faults()]
        failed += [f"{name} has {fault}" for name, fault in wrong]
    if given["as_json"]:
        parts = [{"name": name, "faults": x.faults(), **x.report()} for name, x in found.items()]
        said = {"mesh": str(mesh), "grid": grid, "limits_exceeded": failed}
        main.print_stdout(said | (alone.report() if alone else {"parts": parts}))
    elif not given["quiet"]:
        counts = {name: (x.surface if grid else x).counts() for name, x in found.items()}
        rows = [f"{name}: {counts[name]}; {x.summary()}" for name, x in found.items()]
        main.print_stdout(*(alone.lines() if alone else rows))
    notes = alone.grid.flagged if alone and not given["quiet"] else ()
    main.print_stderr(*(f"Note: {note}" for note in notes))
    main.print_stderr(*(f"Limit exceeded: {sentence}" for sentence in failed))
    if failed:
        sys.exit(1)


def certificates(mesh: Path, grid: str | None, options: Options, names: Any) -> dict[str, Any]:
    """Return what is found of each part by its name, "" for a mesh alone beside its grid."""
    from ..check import check_mesh, examine_surface
    from ..files.grids import names_in, read_grid
    from ..labels.files import names_of
    from ..truth import read_parts

    parts, found = read_parts(mesh, options.unit), dict[str, Any]()
    if grid is None:
        unit = options.unit or ("m" if mesh.suffix.lower() == ".glb" else None)  # by its standard
        return {name: examine_surface(part, unit) for name, part in parts.items()}
    known = names or names_in(grid)
    numbers = {name: str(number) for number, (name, _) in names_of(known, known).items()}
    is_label = options.label is None and not parts.keys() - numbers.keys()
    if len(parts) == 1 and not is_label:
        samples = read_grid(grid, **options.reading())
        return {"": check_mesh(parts.popitem()[1], samples, options)}
    for name, part in parts.items():
        label = numbers.get(name, name.removeprefix("label "))
        if not label.lstrip("-").isdigit():
            raise OptionError(f"{mesh} has a part {name!r}: give the --names that it was made with")
        samples = read_grid(grid, **options.reading() | {"label": int(label)})
        found[name] = check_mesh(part, samples, options)
    return found
