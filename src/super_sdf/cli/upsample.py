"""The command ``upsample``: one grid file to one mesh file."""

from __future__ import annotations

from typing import Any

import click

from ..files.formats import NAMED, list_formats
from .common import CONTEXT, one_line_errors
from .conversion import (
    check_option,
    cluster_option,
    conversion_options,
    labels_option,
    make_options,
    start_loading,
)
from .view import report_option

HELP = f"""Refine the signed distance grid IN and write its surface as the mesh OUT.

IN is a grid file: {list_formats()}. FILE:NAME names one of several arrays in a {NAMED}
file. An .npz file has the keys values, spacing, origin and direction.

OUT is a .ply, .stl, .obj, .off, .glb or .3mf file.
"""
EXAMPLES = """\b
Examples:
  super-sdf upsample part.npz part.ply
  super-sdf upsample field.npy part.stl --spacing 0.5 --factor 8
  super-sdf upsample scan.h5:/distance part.ply --spacing 0.5
  super-sdf upsample organs.nii.gz organs.glb --labels all
"""


@click.command(
    "upsample",
    context_settings=CONTEXT,
    epilog=EXAMPLES,
    short_help="Refine a grid and write its surface as a mesh.",
    help=HELP,
)
@click.argument("source", metavar="IN")
@click.argument("target", metavar="OUT")
@conversion_options
@labels_option
@check_option
@click.option(
    "--save-field",
    metavar="FIELD",
    help="Also write the refined field: .npz for the values near the surface, .npy or .vti for "
    "the whole fine lattice. A .vti needs the extra vti.",
)
@report_option
@cluster_option
@click.option(
    "--jobs",
    type=click.IntRange(0),
    default=0,
    metavar="N",
    help="Worker processes of --cluster local; 0 means one per core.",
)
@click.option("--force", is_flag=True, help="Replace OUT, FIELD and PAGE.html if they exist.")
@click.option("--json", "as_json", is_flag=True, help="Print counts, times and notes as JSON.")
@click.option("-q", "--quiet", is_flag=True, help="Print errors only.")
@click.option("-v", "--verbose", is_flag=True, help="Also print counts and the time per stage.")
def upsample_command(source: str, target: str, **options: Any) -> None:
    """Convert one grid to a mesh."""
    with one_line_errors(target, options["save_field"], options["report"]):
        chosen = make_options(options)
        network = start_loading(options)
        # here, since help and wrong options do without NumPy
        from .upsampling import upsample, upsample_labels

        run = upsample if options["labels"] is None else upsample_labels
        run(source, target, chosen, options, network)
