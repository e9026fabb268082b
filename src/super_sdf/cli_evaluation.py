"""The commands of the measuring stick: sample, evaluate, render. No numerics here.

They want the extras ``eval`` and ``view``; only click is imported at the top.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from .cli_common import CONTEXT, one_line_errors
from .errors import FileError, OptionError

NEEDED = ("igl", "matplotlib", "scipy", "skimage")
SAMPLE_EXAMPLES = """\b
Examples:
  super-sdf sample part.stl part.npz -n 64
  super-sdf sample part.stl part.npz --spacing 0.5 --padding 4
"""
EVALUATE_EXAMPLES = """\b
Examples:
  super-sdf evaluate meshes/ --out report/
  super-sdf evaluate meshes/ --sizes 32 64 --experiments noise factors --out report/
  super-sdf evaluate a.ply b.ply --sizes 32 --peers rfta --out report/
"""
RENDER_EXAMPLES = """\b
Examples:
  super-sdf render coarse.ply fine.ply pair.png --colour normal --up y
  super-sdf render fine.ply error.png --colour error --reference true.ply
  super-sdf render part.npz section.png --axis z
"""


class ListCommand(click.Command):
    """A command whose repeatable options take several values: ``--sizes 32 64 128``.

    An option's values end at the first word that is not one of them.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Write each further value of such an option as the option itself once more."""
        lists = {
            name: param
            for param in self.params
            if isinstance(param, click.Option) and param.multiple
            for name in param.opts
        }
        spelt: list[str] = []
        current: click.Option | None = None
        for word in args:
            follows = len(spelt) > 1 and spelt[-2] in lists
            if current and follows and takes(current, word, ctx):
                spelt += [current.opts[0]]
            elif not (spelt and spelt[-1] in lists):
                current = lists.get(word)
            spelt.append(word)
        return super().parse_args(ctx, spelt)


def takes(option: click.Option, word: str, ctx: click.Context) -> bool:
    """Say whether a word is a value of an option."""
    try:
        option.type.convert(word, option, ctx)
    except click.UsageError:
        return False
    return True


@contextmanager
def bar(label: str, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Draw a bar on stderr, if somebody is there to see it."""
    if quiet or not sys.stderr.isatty():
        yield lambda done, total: None
        return
    with click.progressbar(length=1000, label=label, file=sys.stderr) as shown:
        yield lambda done, total: shown.update(1000 * done // total - shown.pos)


def check_extra(command: str) -> None:
    """Raise if the packages of the extra are not there."""
    from importlib.util import find_spec

    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise FileError(f"{command} needs {', '.join(missing)}: pip install 'super-sdf[eval]'")


@click.command(
    context_settings=CONTEXT, epilog=SAMPLE_EXAMPLES, short_help="Make a grid from a closed mesh."
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
        check_extra("sample")
        run_sample(source, target, options)


def run_sample(source: Path, target: Path, options: dict[str, Any]) -> None:
    """Read the mesh, lay out the grid, sample it, write it, say what was found."""
    from .evaluation.metrics import normalise
    from .evaluation.sampling import fitted_layout, sample_solid, unit_layout
    from .evaluation.solid import Solid, load_solid
    from .io import check_grid_target, write_grid

    start = time.perf_counter()
    check_grid_target(target, force=options["force"])
    samples, spacing = options["samples"], options["spacing"]
    if (samples is None) == (spacing is None):
        raise OptionError("give either -n (samples along the longest axis) or --spacing")
    if options["frame"] == "unit" and samples is None:
        raise OptionError("--frame unit has a side of 1: give -n, not --spacing")
    solid, notes = load_solid(source, allow_open=options["allow_open"])
    if options["frame"] == "unit":
        solid, layout = Solid(normalise(solid.mesh)), unit_layout(samples)
    else:
        layout = fitted_layout(solid.mesh, n=samples, spacing=spacing, padding=options["padding"])
    with bar("sampling", options["quiet"]) as progress:
        grid = sample_solid(solid, layout, band=options["band"], progress=progress)
    write_grid(grid, target, force=options["force"])
    if not options["quiet"]:
        for note in (*notes, *grid.notes):
            click.echo(f"Note: {note}", err=True)
        size = " x ".join(map(str, grid.shape))
        seconds = time.perf_counter() - start
        click.echo(
            f"{target}: {size} samples, spacing {grid.voxel_size:g}, {seconds:.1f} s", err=True
        )


@click.command(
    cls=ListCommand,
    context_settings=CONTEXT,
    epilog=EVALUATE_EXAMPLES,
    short_help="Measure quality on your own meshes.",
)
@click.argument(
    "sources", metavar="MESHES...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the report.")
@click.option(
    "--sizes",
    multiple=True,
    type=int,
    default=(32, 64, 128),
    show_default="32 64 128",
    metavar="N...",
    help="Samples along each axis.",
)
@click.option("--factor", type=int, default=4, show_default=True, help="How many times finer.")
@click.option(
    "--methods",
    multiple=True,
    type=click.Choice(["mc", "mc-lewiner", "trilinear", "bspline", "ours", "bound"]),
    metavar="NAME...",
    help="Of mc, mc-lewiner, trilinear, bspline, ours, bound; all unless given.",
)
@click.option(
    "--experiments",
    multiple=True,
    type=click.Choice(["factors", "noise", "iterated", "scale", "timings"]),
    metavar="NAME...",
    help="The paper's, beside what it printed: factors, noise, iterated, scale, timings.",
)
@click.option(
    "--experiment-shapes",
    type=click.IntRange(1),
    default=10,
    show_default=True,
    help="Shapes that the experiments take, spread over the list.",
)
@click.option(
    "--peers",
    multiple=True,
    type=click.Choice(["rfta", "dual-contouring"]),
    metavar="NAME...",
    help="Other methods: rfta, dual-contouring. Minutes a shape; wants the extra peers.",
)
@click.option(
    "--peer-shapes", type=click.IntRange(1), default=5, show_default=True, help="Shapes for them."
)
@click.option("--peer-size", type=int, default=32, show_default=True, help="Size for them.")
@click.option(
    "--peer-limit",
    type=float,
    default=900,
    show_default=True,
    metavar="SECONDS",
    help="Time for each of them on each shape.",
)
@click.option("--limit", type=click.IntRange(1), help="Take so many meshes, spread over the list.")
@click.option(
    "--model", default="base", show_default=True, help="A shipped network, or an ONNX file."
)
@click.option("--jobs", type=click.IntRange(1), help="Processes; one a core unless given.")
@click.option(
    "--up",
    type=click.Choice(["x", "y", "z"]),
    default="z",
    show_default=True,
    help="The axis that points up in pictures.",
)
@click.option("--no-pictures", is_flag=True, help="Leave out the best and worst shapes.")
@click.option("-q", "--quiet", is_flag=True, help="Print errors only.")
def evaluate(sources: tuple[Path, ...], **options: Any) -> None:
    """Measure super-sdf, its baselines and its bound on closed reference meshes.

    MESHES are files or folders. Each is scaled to a box diagonal of 1 and sampled at every size;
    what each method makes of the samples is compared with the mesh itself. Killed and started
    again, it goes on where it was. OUT/report.md has the tables, plots and pictures.
    """
    with one_line_errors():
        check_extra("evaluate")
        left_out = run_evaluate(sources, options)
    if left_out:
        sys.exit(1)


def run_evaluate(sources: tuple[Path, ...], options: dict[str, Any]) -> bool:
    """Plan, measure, report; say which shapes were left out, and return whether any was."""
    from .evaluation.evaluate import evaluate
    from .evaluation.methods import METHODS
    from .evaluation.peers import peers_are_installed
    from .evaluation.plan import Plan, find_meshes, spread

    if options["peers"] and not peers_are_installed():
        raise FileError("peers need gpytoolbox: pip install 'super-sdf[peers]'")
    paths = find_meshes(sources)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    jobs = options["jobs"] or cores or 1
    plan = Plan(
        spread(paths, options["limit"] or len(paths)),
        methods=tuple(name for name in METHODS if name in (options["methods"] or METHODS)),
        jobs=jobs,
        threads=max(1, (cores or 1) // jobs),
        **{
            name: options[name]
            for name in (
                *("sizes", "factor", "model", "experiments", "experiment_shapes"),
                *("peers", "peer_shapes", "peer_size", "peer_limit"),
            )
        },
    )
    outcome = evaluate(
        plan,
        options["out"],
        up=options["up"],
        pictures=not options["no_pictures"],
        progress=None if options["quiet"] else progress_lines(),
    )
    for entry in outcome.left_out:
        click.echo(f"Left out: {entry.shape}: {entry.reason}", err=True)
    if not options["quiet"]:
        click.echo(outcome.report.read_text())
        click.echo(f"{outcome.report}", err=True)
    return bool(outcome.left_out)


def progress_lines() -> Callable[[int, int, str, float], None]:
    """Return a function that prints a line a task, with the time that the rest will take."""
    start = time.monotonic()

    def tell(done: int, total: int, what: str, share: float) -> None:
        spent = time.monotonic() - start
        left = spent / share * (1 - share)
        click.echo(f"{done} of {total}: {what}, {spent:.0f} s, {left:.0f} s left", err=True)

    return tell


@click.command(
    context_settings=CONTEXT,
    epilog=RENDER_EXAMPLES,
    short_help="Draw meshes, or a cross-section of a grid.",
)
@click.argument(
    "sources", metavar="MESH...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@click.argument("target", metavar="OUT.png", type=click.Path(path_type=Path))
@click.option(
    "--colour",
    type=click.Choice(["shaded", "normal", "error"]),
    default="shaded",
    show_default=True,
    help="By light, by the direction of the face, or by the distance to the reference.",
)
@click.option(
    "--reference", type=click.Path(path_type=Path), help="The mesh that errors are measured to."
)
@click.option(
    "--top",
    type=float,
    metavar="D",
    help="Distance at the end of the colour bar.",
)
@click.option(
    "--up",
    type=click.Choice(["x", "y", "z"]),
    default="z",
    show_default=True,
    help="The axis that points up.",
)
@click.option("--zoom", type=float, default=1.0, show_default=True, help="Closer in.")
@click.option(
    "--size", type=click.IntRange(100), default=700, show_default=True, help="Pixels a panel."
)
@click.option(
    "--axis",
    type=click.Choice(["x", "y", "z"]),
    default="z",
    show_default=True,
    help="Of a grid: the axis that the section cuts across.",
)
@click.option(
    "--at", type=float, metavar="D", help="Of a grid: where on that axis; else the middle."
)
@click.option(
    "--factor", type=int, default=4, show_default=True, help="Of a grid: how many times finer."
)
@click.option("--force", is_flag=True, help="Replace OUT if it exists.")
def render(sources: tuple[Path, ...], target: Path, **options: Any) -> None:
    """Draw meshes side by side from one camera, or a section of a grid before and after.

    MESH is any file that trimesh reads; a single .npy or .npz grid is drawn as a cross-section in
    false colours with its zero line, as it is and as super-sdf refines it. No display is needed.
    """
    from .io import GRID_SUFFIXES

    with one_line_errors():
        check_extra("render")
        check_picture(target, force=options["force"])
        grids = [source for source in sources if source.suffix.lower() in GRID_SUFFIXES]
        if grids and len(sources) > 1:
            raise OptionError(f"{grids[0]} is a grid: give it alone, or meshes only")
        (render_grid if grids else render_meshes)(sources, target, options)


def check_picture(target: Path, *, force: bool) -> None:
    """Raise if a picture cannot be written there; asked before the work starts."""
    from .io import check_free

    if target.suffix.lower() != ".png":
        raise OptionError(f"{target} is no picture file: give .png")
    check_free(target, force=force)


def render_meshes(sources: tuple[Path, ...], target: Path, options: dict[str, Any]) -> None:
    """Draw meshes; by their errors, if there is a reference to compare with."""
    from .evaluation.rendering import Panel, render_panels, vertex_errors
    from .evaluation.solid import Solid, read_mesh

    if (options["colour"] == "error") != (options["reference"] is not None):
        raise OptionError("--colour error and --reference MESH go together: give both or neither")
    meshes = [(source.name, read_mesh(source)) for source in sources]
    if options["reference"] is None:
        panels = [Panel(mesh, name) for name, mesh in meshes]
    else:
        reference = Solid(read_mesh(options["reference"]))
        panels = [Panel(mesh, name, vertex_errors(mesh, reference)) for name, mesh in meshes]
    chosen = {name: options[name] for name in ("colour", "up", "zoom", "size", "top")}
    render_panels(panels, target, **chosen)


def render_grid(sources: tuple[Path, ...], target: Path, options: dict[str, Any]) -> None:
    """Draw a grid's section before and after upsampling."""
    from .evaluation.sections import render_section
    from .io import read_grid
    from .network import load_network
    from .pipeline import upsample

    grid = read_grid(sources[0])
    field = upsample(grid, load_network(), options["factor"])
    chosen = {name: options[name] for name in ("axis", "at", "size")}
    render_section(grid, target, field=field, **chosen)
