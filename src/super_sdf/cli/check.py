"""Check the mesh file MESH against the signed distance grid GRID that it was made from.

The true surface is not needed. Every exact sample is the radius of an empty ball that touches the
surface. The residual of a sample is its distance to the mesh minus that radius, in voxels: positive
if the mesh does not reach the ball, negative if the mesh pierces the ball. The mesh is also checked
for being closed, oriented and manifold, and for self-intersections.

MESH is any mesh file that trimesh reads; vertices at the same position are merged. GRID is a grid
file as for upsample. The exit code is 1 if a limit is exceeded.

  super-sdf check part.ply part.npz
  super-sdf check part.ply part.npz --max-mean 0.01 --no-faults
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from click import Argument, FloatRange, Option

from ..errors import check_modules
from ..options import READ, Options
from . import main

TAKES = (
    Argument(["mesh"], metavar="MESH", type=main.FILE),
    Argument(["grid"], metavar="GRID", type=main.FILE),
    Option(["--tolerance"], type=FloatRange(0), metavar="D",
        help="Fail if the largest residual of a sample is above D, in world units."),
    Option(["--max-mean"], type=FloatRange(0), metavar="VOXELS",
        help="Fail if the mean of the absolute residuals is above VOXELS."),
    Option(["--no-faults"], is_flag=True,
        help="Fail if the mesh is open, not manifold, not oriented outward, intersects itself, has "
        "samples on the wrong side, or vertices where the grid has no surface."),
    *READ,
    main.table_option("offset", "The --offset with which the mesh was made."),
    main.table_option("unit", "Unit of the mesh: the --unit of a .glb; also for volumes in ml."),
    main.table_option("max_memory", "Memory limit of the process, such as 4G. Default: 60 % of the "
        "free memory. Larger meshes are refused."),
    "json", "quiet",
)  # fmt: skip


def command(mesh: Path, grid: Path, **given: Any) -> None:
    """Check the mesh, print the certificate, and fail where it exceeds a limit."""
    check_modules("check", "report", ("igl",))
    from ..check import check_mesh, read_for_check

    options = Options(**{name: given[name] for name in (*READ, "offset", "max_memory", "unit")})
    found = check_mesh(*read_for_check(mesh, grid, options), options)
    failed = found.exceeded(given["tolerance"], given["max_mean"])
    failed += [f"the mesh has {each}" for each in found.faults() if given["no_faults"]]
    if given["as_json"]:
        said = {"mesh": str(mesh), "grid": str(grid), **found.report(), "limits_exceeded": failed}
        main.print_stdout(said)
    elif not given["quiet"]:
        main.print_stdout(*found.lines())
    main.print_stderr(*(f"Note: {note}" for note in found.grid.flagged if not given["quiet"]))
    main.print_stderr(*(f"Limit exceeded: {sentence}" for sentence in failed))
    if failed:
        sys.exit(1)
