"""The command ``check``: whether a mesh is valid and fits the samples of its grid."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import click

from ..machine.extras import check_modules
from ..options import GRID, LENGTHS, ConvertOptions, parse_size
from .common import (CHECK_MODULES, CONTEXT, Parsed, one_line_errors, print_stderr, print_stdout, table_options)
from .interrupts import raising_interrupts

EXAMPLES = """\b
Examples:
  super-sdf check part.ply part.npz
  super-sdf check part.ply part.npz --out coloured.ply --max-mean 0.01 --no-faults
"""


@click.command(
    "check",
    context_settings=CONTEXT,
    epilog=EXAMPLES,
    short_help="Check a mesh against the grid that it was made from.",
)
@click.argument("mesh", metavar="MESH", type=click.Path(path_type=Path))
@click.argument("grid", metavar="GRID", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="COLOURED.ply",
    help="Write the mesh with a colour and the property residual (voxels) for each vertex, from "
    "the samples nearest to which it lies. White: the mesh touches their balls; red: it pierces "
    "them; blue: it does not reach them, both fully at 0.1 voxel; olive: no sample is near.",
)
@click.option(
    "--max-residual",
    type=float,
    metavar="VOXELS",
    help="Fail if the largest residual of a sample is above this.",
)
@click.option(
    "--tolerance",
    type=float,
    metavar="D",
    help="The same in world units: fail if the largest residual is above D.",
)
@click.option(
    "--max-mean", type=float, metavar="VOXELS", help="Fail if the mean residual is above this."
)
@click.option(
    "--max-share",
    type=float,
    metavar="SHARE",
    help="Fail if more than this share of the samples, from 0 to 1, has a residual above 0.1 "
    "voxel.",
)
@click.option(
    "--no-faults",
    is_flag=True,
    help="Fail if the mesh is open, not manifold, not oriented outward, intersects itself, has "
    "samples on the wrong side, or vertices where the grid has no surface.",
)
@click.option(
    "--skip-intersections",
    is_flag=True,
    help="Do not count self-intersections, which takes up to half of the time.",
)
@table_options(*GRID)
@click.option(
    "--offset",
    type=float,
    default=0.0,
    show_default=True,
    metavar="D",
    help="The --offset that the mesh was made with.",
)
@click.option(
    "--unit", type=click.Choice(list(LENGTHS)), help="The --unit that a .glb was made with."
)
@click.option(
    "--max-memory",
    type=Parsed(parse_size),
    metavar="SIZE",
    help="Memory limit of the process, such as 1500M or 4G. Default: 60 % of the free memory. "
    "Larger meshes are refused.",
)
@click.option("--force", is_flag=True, help="Replace COLOURED.ply if it exists.")
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")
@click.option("-q", "--quiet", is_flag=True, help="Print errors and exceeded limits only.")
def check_command(mesh: Path, grid: Path, **options: Any) -> None:
    """Check the mesh file MESH against the signed distance grid GRID that it was made from.

    The true surface is not needed. Every exact sample is the radius of an empty ball that touches
    the surface; its residual is its distance to the mesh minus that radius, in voxels: positive if
    the mesh does not reach the ball, negative if it pierces it. Truncated or noisy samples promise
    nothing and are left out. The mesh is also checked for being closed, oriented and manifold, and
    for self-intersections.

    MESH is any mesh file that trimesh reads; vertices at the same position count as one. GRID is
    what upsample takes. The exit code is 1 if a limit is exceeded.
    """
    with one_line_errors(options["out"]):
        check_modules("check", "report", CHECK_MODULES)
        exceeded = run_check(mesh, grid, options)
    for sentence in exceeded:
        print_stderr(f"Limit exceeded: {sentence}")
    if exceeded:
        sys.exit(1)


def run_check(mesh: Path, grid: Path, options: dict[str, Any]) -> list[str]:
    """Check the files, print the certificate, write the coloured mesh; return exceeded limits."""
    from ..check.check import (LIMITS, check_coloured, check_files, check_limits, exceeded, write_coloured)
    from ..files.output import check_apart
    from ..files.regular import files_of

    limits = {name: options[name] for name in LIMITS}
    check_limits(limits)
    if options["out"]:
        check_coloured(options["out"], force=options["force"])
        check_apart(options["out"], [mesh, *files_of(grid)])
    given = ConvertOptions(
        **{name: options[name] for name in (*GRID, "offset", "max_memory", "unit")}
    )
    count = not options["skip_intersections"]
    certificate = check_files(mesh, grid, given, intersections=count)
    if options["out"]:
        with raising_interrupts():
            write_coloured(certificate, options["out"], force=options["force"])
    faults = certificate.faults() if options["no_faults"] else []
    passed = exceeded(certificate, limits) + [f"the mesh has {fault}" for fault in faults]
    written = f"{options['out']} is written" if options["out"] else "nothing was written"
    if options["as_json"]:
        report = {"mesh": str(mesh), "grid": str(grid), **certificate.report()}
        print_stdout(json.dumps({**report, "limits_exceeded": passed}, indent=2), written)
    elif not options["quiet"]:
        print_stdout("\n".join(certificate.lines()), written)
    for note in () if options["quiet"] else certificate.grid.notes:
        print_stderr(f"Note: {note}")
    return passed
