"""The command ``render``: pictures of meshes, or a cross-section of a grid."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from ..errors import OptionError
from ..machine.extras import EXTRAS, check_modules
from ..options import ConvertOptions
from ..pictures.choices import AXES, COLOURS
from .common import CONTEXT, one_line_errors
from .interrupts import raising_interrupts

EXAMPLES = """\b
Examples:
  super-sdf render coarse.ply fine.ply pair.png --colour normal --up y
  super-sdf render fine.ply error.png --colour error --reference true.ply
  super-sdf render part.npz section.png --axis z
"""
# Options that apply to one kind of source only.
FOR_GRIDS = ("axis", "at", "factor")
FOR_MESHES = ("colour", "reference", "top", "up", "zoom")


@click.command(
    "render",
    context_settings=CONTEXT,
    epilog=EXAMPLES,
    short_help="Draw meshes, or a cross-section of a grid.",
)
@click.argument(
    "sources", metavar="MESH...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@click.argument("target", metavar="OUT.png", type=click.Path(path_type=Path))
@click.option(
    "--colour",
    type=click.Choice(COLOURS),
    default=COLOURS[0],
    show_default=True,
    help="shaded: lit; normal: by face normal; error: by distance to the reference.",
)
@click.option(
    "--reference", type=click.Path(path_type=Path), help="Reference mesh for --colour error."
)
@click.option(
    "--top",
    type=float,
    metavar="D",
    help="Distance at the end of the colour bar. Default: the 99th percentile of the errors.",
)
@click.option(
    "--up",
    type=click.Choice(AXES),
    default="z",
    show_default=True,
    help="Axis that points up.",
)
@click.option(
    "--zoom",
    type=float,
    default=1.0,
    show_default=True,
    help="Magnification; at 1 all meshes fit into the picture.",
)
@click.option(
    "--size",
    type=click.IntRange(100),
    default=700,
    show_default=True,
    help="Pixels along the long side of each panel.",
)
@click.option(
    "--axis",
    type=click.Choice(AXES),
    default="z",
    show_default=True,
    help="For a grid: axis normal to the section plane.",
)
@click.option(
    "--at",
    type=float,
    metavar="D",
    help="For a grid: world position of the section on that axis. Default: the middle of the "
    "surface.",
)
@click.option(
    "--factor",
    type=int,
    default=ConvertOptions.factor,
    show_default=True,
    help="For a grid: refinement per axis.",
)
@click.option("--force", is_flag=True, help="Replace OUT if it exists.")
def render_command(sources: tuple[Path, ...], target: Path, **options: Any) -> None:
    """Draw meshes side by side from one camera, or a cross-section of a grid.

    MESH is any mesh file that trimesh reads. A single grid, in any format that upsample reads, is
    drawn instead as a cross-section in false colours with its zero line, before and after
    refinement. No display is needed.
    """
    from ..files.formats import is_grid

    with one_line_errors(target):
        grids = [source for source in sources if is_grid(source)]
        check_modules("render", "view", EXTRAS["eval"] if grids else None)
        inputs = [*sources, *filter(None, [options["reference"]])]
        check_picture(target, inputs, force=options["force"])
        if grids and len(sources) > 1:
            raise OptionError(f"{grids[0]} is a grid: give it alone, or meshes only")
        check_given(FOR_MESHES if grids else FOR_GRIDS, "a grid" if grids else "meshes")
        (render_grid if grids else render_meshes)(sources, target, options)


def check_given(others: tuple[str, ...], drawn: str) -> None:
    """Raise OptionError if an option was given that does not apply to what is drawn."""
    context = click.get_current_context()
    for name in others:
        if context.get_parameter_source(name) is not ParameterSource.DEFAULT:
            raise OptionError(f"--{name} does not apply to {drawn}: leave it out")


def check_picture(target: Path, inputs: Iterable[Path], *, force: bool) -> None:
    """Raise if the picture cannot be written; called before the work starts."""
    from ..files.output import check_apart, check_free
    from ..files.regular import files_of

    if target.suffix.lower() != ".png":
        raise OptionError(f"{target} is not a picture file: give .png")
    check_free(target, force=force)
    check_apart(target, [file for each in inputs for file in files_of(each)])


def render_meshes(sources: tuple[Path, ...], target: Path, options: dict[str, Any]) -> None:
    """Draw meshes side by side; with a reference, coloured by their distance to it."""
    from ..pictures.page import check_page
    from ..pictures.rendering import Layout, Panel, check_numbers, render_panels, vertex_errors
    from ..truth.mesh_files import read_mesh
    from ..truth.solid import Solid

    check_numbers(zoom=options["zoom"], top=options["top"])
    check_page(options["size"], len(sources))
    if options["top"] is not None and options["colour"] != "error":
        raise OptionError("--top is the end of the colour bar: give it with --colour error")
    if (options["colour"] == "error") != (options["reference"] is not None):
        raise OptionError("--colour error and --reference MESH go together: give both or neither")
    meshes = [(source.name, read_mesh(source)) for source in sources]
    if options["reference"] is None:
        panels = [Panel(mesh, name) for name, mesh in meshes]
    else:
        reference = Solid(read_mesh(options["reference"]))
        panels = [Panel(mesh, name, vertex_errors(mesh, reference)) for name, mesh in meshes]
    layout = Layout(zoom=options["zoom"], size=options["size"])
    chosen = {name: options[name] for name in ("colour", "up", "top", "force")}
    with raising_interrupts():
        render_panels(panels, target, layout=layout, **chosen)


def render_grid(sources: tuple[Path, ...], target: Path, options: dict[str, Any]) -> None:
    """Draw a grid's section before and after upsampling."""
    from ..files.grids import read_grid
    from ..network.network import load_network
    from ..options import check_factor
    from ..pictures.sections import check_section, find_plane, render_section
    from ..pipeline import upsample

    check_factor(options["factor"])
    check_section(options["size"])
    grid = read_grid(sources[0])
    find_plane(grid, options["axis"], options["at"])  # raises if it is outside the grid
    field = upsample(grid, load_network(), options["factor"])
    chosen = {name: options[name] for name in ("axis", "at", "size", "force")}
    with raising_interrupts():
        render_section(grid, target, field=field, **chosen)
