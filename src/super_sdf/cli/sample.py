"""Sample the signed distance to the closed mesh MESH on a regular grid and write it to OUT.

MESH is any mesh file that trimesh reads. OUT is a .npz file with the keys values, spacing and
origin. The values are in the units of the mesh, and negative inside.

  super-sdf sample part.stl part.npz -n 64
  super-sdf sample part.stl part.npz --spacing 0.5 --padding 4
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from click import Argument, FloatRange, IntRange, Option

from ..errors import OptionError, check_modules
from . import main

TAKES = (
    Argument(["source"], metavar="MESH", type=main.FILE),
    Argument(["target"], metavar="OUT", type=main.FILE),
    Option(["-n", "samples"], type=IntRange(2), help="Samples along the longest axis."),
    Option(["--spacing"], type=FloatRange(0, min_open=True), metavar="H",
        help="World distance between samples, instead of -n."),
    Option(["--padding"], type=FloatRange(0), metavar="VOXELS",
        help="Voxels between the bounding box of the mesh and the grid's border. Default: 2.37."),
    Option(["--band"], type=FloatRange(1.5), metavar="VOXELS",
        help="Exact distances up to this many voxels from the surface, clamped beyond. Default: "
        "exact everywhere up to 256^3 samples, within 4 voxels in larger grids."),
    Option(["--allow-open"], is_flag=True, help="Accept a mesh with holes: the inside is a guess."),
    "force", "quiet",
)  # fmt: skip


def command(source: Path, target: Path, **given: Any) -> None:
    """Check the numbers, load the mesh, sample it and write the grid."""
    check_modules("sample", "eval")
    from ..files.grids import check_grid_target, write_grid
    from ..files.output import check_apart
    from ..truth import PADDING, fitted_layout, load_solid, sample_solid

    start, count, spacing = time.perf_counter(), given["samples"], given["spacing"]
    check_grid_target(target, force=given["force"])
    check_apart(target, [source])
    if (count is None) == (spacing is None):
        raise OptionError("give either -n (samples along the longest axis) or --spacing")
    padding = PADDING if given["padding"] is None else given["padding"]
    solid, notes = load_solid(source, allow_open=given["allow_open"])
    layout = fitted_layout(solid.mesh, n=count, spacing=spacing, padding=padding)
    with main.progress_bar("sampling", given["quiet"]) as progress:
        grid = sample_solid(solid, layout, band=given["band"], progress=progress)
    write_grid(grid, target, force=given["force"])
    if not given["quiet"]:
        shape, seconds = " x ".join(map(str, grid.shape)), time.perf_counter() - start
        said = f"{target}: {shape} samples, spacing {grid.voxel_size:g}, {seconds:.1f} s"
        main.print_stderr(*(f"Note: {note}" for note in (*notes, *grid.flagged)), said)
