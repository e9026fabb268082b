"""The command ``check``: whether a mesh is valid and fits the samples of its grid."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import click

from ..errors import check_modules
from ..options import READ, Options
from . import common
from .common import option, print_stderr, print_stdout

EXAMPLES = """\b
Examples:
  super-sdf check part.ply part.npz
  super-sdf check part.ply part.npz --out coloured.ply --max-mean 0.01 --no-faults
"""

# fmt: off
TAKES = (
    click.argument("mesh", metavar="MESH", type=common.FILE),
    click.argument("grid", metavar="GRID", type=common.FILE),
    option("--out", type=common.FILE, metavar="COLOURED.ply",
        help="Write the mesh with a colour and the property residual (voxels) for each vertex, "
        "from the samples nearest to which it lies. White: the mesh touches their balls; red: it "
        "pierces them; blue: it does not reach them, both fully at 0.1 voxel; olive: no sample is "
        "near."),
    option("--max-residual", type=float, metavar="VOXELS",
        help="Fail if the largest residual of a sample is above this."),
    option("--tolerance", type=float, metavar="D",
        help="The same in world units: fail if the largest residual is above D."),
    option("--max-mean", type=float, metavar="VOXELS",
        help="Fail if the mean residual is above this."),
    option("--max-share", type=float, metavar="SHARE",
        help="Fail if more than this share of the samples, from 0 to 1, has a residual above 0.1 "
        "voxel."),
    option("--no-faults", is_flag=True,
        help="Fail if the mesh is open, not manifold, not oriented outward, intersects itself, has "
        "samples on the wrong side, or vertices where the grid has no surface."),
    option("--skip-intersections", is_flag=True,
        help="Do not count self-intersections, which takes up to half of the time."),
    common.table_options(*READ, "offset", "unit", "max_memory",
        offset="The --offset that the mesh was made with.",
        unit="The --unit that a .glb was made with.",
        max_memory="Memory limit of the process, such as 1500M or 4G. Default: 60 % of the free "
        "memory. Larger meshes are refused."),
    common.shared("force", "json", "quiet"),
)
# fmt: on


@common.make_command("Check a mesh against the grid that it was made from.", EXAMPLES, *TAKES)
def command(mesh: Path, grid: Path, **given: Any) -> None:
    """Check the mesh file MESH against the signed distance grid GRID that it was made from.

    The true surface is not needed. Every exact sample is the radius of an empty ball that touches
    the surface; its residual is its distance to the mesh minus that radius, in voxels: positive if
    the mesh does not reach the ball, negative if it pierces it. Truncated or noisy samples promise
    nothing and are left out. The mesh is also checked for being closed, oriented and manifold, and
    for self-intersections.

    MESH is any mesh file that trimesh reads; vertices at the same position count as one. GRID is
    what upsample takes. The exit code is 1 if a limit is exceeded.
    """
    check_modules("check", "report", ("igl",))
    from ..check.check import (
        LIMITS,
        check_coloured,
        check_files,
        check_limits,
        exceeded,
        write_coloured,
    )
    from ..files.output import check_apart
    from ..files.regular import files_of

    limits = {name: given[name] for name in LIMITS}
    check_limits(limits)
    if given["out"]:
        check_coloured(given["out"], force=given["force"])
        check_apart(given["out"], [mesh, *files_of(grid)])
    options = Options(**{name: given[name] for name in (*READ, "offset", "max_memory", "unit")})
    count = not given["skip_intersections"]
    certificate = check_files(mesh, grid, options, intersections=count)
    if given["out"]:
        write_coloured(certificate, given["out"], force=given["force"])
    faults = certificate.faults() if given["no_faults"] else []
    passed = exceeded(certificate, limits) + [f"the mesh has {fault}" for fault in faults]
    written = f"{given['out']} is written" if given["out"] else "nothing was written"
    if given["as_json"]:
        report = {"mesh": str(mesh), "grid": str(grid), **certificate.report()}
        print_stdout(json.dumps({**report, "limits_exceeded": passed}, indent=2), written)
    elif not given["quiet"]:
        print_stdout("\n".join(certificate.lines()), written)
    for note in () if given["quiet"] else certificate.grid.notes:
        print_stderr(f"Note: {note}")
    for sentence in passed:
        print_stderr(f"Limit exceeded: {sentence}")
    if passed:
        sys.exit(1)
