"""Draw meshes side by side from one camera, or a cross-section of a grid, as a PNG file.

    python -m lab render coarse.ply fine.ply pair.png --colour normal --up y
    python -m lab render fine.ply error.png --colour error --reference true.ply
    python -m lab render part.npz section.png --axis z

A single grid is drawn as a cross-section in false colours with its zero line, before and after
refinement. No display is needed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from super_sdf.errors import OptionError
from super_sdf.files.formats import is_grid
from super_sdf.files.grids import read_grid
from super_sdf.network.network import load_network
from super_sdf.options import check_factor
from super_sdf.pipeline import upsample
from super_sdf.truth.mesh_files import read_mesh
from super_sdf.truth.solid import Solid

from . import parser_of
from .cross_sections import find_plane, render_section
from .drawing import AXES, COLOURS, Panel, render_panels, vertex_errors

# Options that apply to one kind of source only, with their defaults.
FOR_GRIDS = {"axis": "z", "at": None, "factor": 4}
FOR_MESHES = {"colour": COLOURS[0], "reference": None, "up": "z"}


def main() -> None:
    """Draw what is given."""
    parser = parser_of(__doc__)
    parser.add_argument("sources", metavar="MESH", type=Path, nargs="+", help="meshes, or one grid")
    parser.add_argument("target", metavar="OUT.png", type=Path)
    parser.add_argument("--colour", choices=COLOURS, help="by light, face normal or distance")
    parser.add_argument("--reference", type=Path, help="mesh for --colour error")
    parser.add_argument("--up", choices=AXES, help="axis that points up")
    parser.add_argument("--axis", choices=AXES, help="for a grid: normal to the section")
    parser.add_argument("--at", type=float, help="for a grid: world position on that axis")
    parser.add_argument("--factor", type=int, help="for a grid: refinement per axis")
    words = parser.parse_args()
    grids = [source for source in words.sources if is_grid(source)]
    if words.target.suffix.lower() != ".png":
        raise OptionError(f"{words.target} is not a picture file: give .png")
    if grids and len(words.sources) > 1:
        raise OptionError(f"{grids[0]} is a grid: give it alone, or meshes only")
    for name in FOR_MESHES if grids else FOR_GRIDS:
        if getattr(words, name) is not None:
            drawn = "a grid" if grids else "meshes"
            raise OptionError(f"--{name} does not apply to {drawn}: leave it out")
    for name, default in (FOR_GRIDS if grids else FOR_MESHES).items():
        if getattr(words, name) is None:
            setattr(words, name, default)
    (render_grid if grids else render_meshes)(words)


def render_meshes(words: argparse.Namespace) -> None:
    """Draw meshes side by side; with a reference, coloured by their distance to it."""
    if (words.colour == "error") != (words.reference is not None):
        raise OptionError("--colour error and --reference MESH go together: give both or neither")
    meshes = {source.name: read_mesh(source) for source in words.sources}
    truth = Solid(read_mesh(words.reference)) if words.reference else None
    panels = [Panel(mesh, name, truth and vertex_errors(mesh, truth))
              for name, mesh in meshes.items()]  # fmt: skip
    render_panels(panels, words.target, colour=words.colour, up=words.up)


def render_grid(words: argparse.Namespace) -> None:
    """Draw a grid's section before and after upsampling."""
    check_factor(words.factor)
    grid = read_grid(words.sources[0])
    plane = find_plane(grid, words.axis, words.at)  # raises if it is outside the grid
    field = upsample(grid, load_network(), words.factor)
    render_section(grid, field, words.target, words.axis, plane)
