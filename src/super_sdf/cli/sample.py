"""The command ``sample``: parse, call the library, say what happened. No numerics here."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from ..errors import OptionError
from ..machine.extras import check_modules
from .common import CONTEXT, one_line_errors, progress_bar, tell
from .interrupts import raising_interrupts

EXAMPLES = """\b
Examples:
  super-sdf sample part.stl part.npz -n 64
  super-sdf sample part.stl part.npz --spacing 0.5 --padding 4
"""


@click.command(
    context_settings=CONTEXT, epilog=EXAMPLES, short_help="Make a grid from a closed mesh."
)
@click.argument("source", metavar="MESH", type=click.Path(path_type=Path))
@click.argument("target", metavar="OUT", type=click.Path(path_type=Path))
@click.option("-n", "samples", type=int, help="Samples along the longest axis.")
@click.option("--spacing", type=float, metavar="H", help="World distance between samples instead.")
@click.option(
    "--padding",
    type=float,
    default=2.0,
    show_default=True,
    help="Voxels between the mesh's box and the outer samples.",
)
@click.option(
    "--frame",
    type=click.Choice(["world", "unit"]),
    default="world",
    show_default=True,
    help="unit: box diagonal scaled to 1, centred in a cube of side 1 (n^3 voxel centres).",
)
@click.option(
    "--band",
    type=float,
    metavar="VOXELS",
    help="Exact only so near to the surface, cut off beyond; else all samples are exact up to "
    "256^3, and those within 4 voxels in larger grids.",
)
@click.option("--allow-open", is_flag=True, help="Guess what is inside a mesh with holes.")
@click.option("--force", is_flag=True, help="Replace OUT if it exists.")
@click.option("-q", "--quiet", is_flag=True, help="Print errors only.")
def sample(source: Path, target: Path, **options: Any) -> None:
    """Write the signed distances to the closed mesh MESH on a regular grid, OUT.

    MESH is any file that trimesh reads. OUT is .npz (keys values, spacing, origin), in the mesh's
    units, negative inside.
    """
    with one_line_errors():
        check_modules("sample", "eval")
        run_sample(source, target, options)


def run_sample(source: Path, target: Path, options: dict[str, Any]) -> None:
    """Read the mesh, lay out the grid, sample it, write it, say what was found."""
    from ..evaluation.metrics import normalise
    from ..files.grids import check_grid_target, write_grid
    from ..truth.sampling import check_numbers, fitted_layout, sample_solid, unit_layout
    from ..truth.solid import Solid, load_solid

    start = time.perf_counter()
    check_grid_target(target, force=options["force"])
    samples, spacing = options["samples"], options["spacing"]
    if (samples is None) == (spacing is None):
        raise OptionError("give either -n (samples along the longest axis) or --spacing")
    if options["frame"] == "unit" and samples is None:
        raise OptionError("--frame unit has a side of 1: give -n, not --spacing")
    chosen = {"n": samples, "spacing": spacing, "band": options["band"]}
    check_numbers(**chosen, padding=0 if options["frame"] == "unit" else options["padding"])
    padded = click.get_current_context().get_parameter_source("padding")
    if options["frame"] == "unit" and padded is not ParameterSource.DEFAULT:
        raise OptionError("--frame unit has a side of 1: it takes no --padding")
    solid, notes = load_solid(source, allow_open=options["allow_open"])
    if options["frame"] == "unit":
        solid, layout = Solid(normalise(solid.mesh)), unit_layout(samples)
    else:
        layout = fitted_layout(solid.mesh, n=samples, spacing=spacing, padding=options["padding"])
    with progress_bar("sampling", options["quiet"]) as progress:
        grid = sample_solid(solid, layout, band=options["band"], progress=progress)
    with raising_interrupts():
        write_grid(grid, target, force=options["force"])
    if not options["quiet"]:
        for note in (*notes, *grid.notes):
            tell(f"Note: {note}")
        size = " x ".join(map(str, grid.shape))
        seconds = time.perf_counter() - start
        tell(f"{target}: {size} samples, spacing {grid.voxel_size:g}, {seconds:.1f} s")
