"""The report: tables of quality, the paper's experiments, peers, pictures, time and memory.

OUT/report.md      all of it
OUT/shapes.md      every figure of every shape
OUT/results.jsonl  the rows it is made from, a line for each shape, setting and method
OUT/plots, OUT/pictures
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ..errors import SuperSdfError
from ..machine.extras import how_to_install
from ..mesh import Mesh
from ..network.network import load_network
from ..pictures.rendering import Panel, can_render, render_panels, vertex_errors
from . import experiment_tables
from .cases import Case, Setting, Shape
from .folder import REPORT, SHAPES, make_folder, write_page
from .measuring import Measurement
from .methods import METHODS
from .names import LABELS, OURS, OURS_MESHED
from .plots import draw_plots
from .results import Results
from .scope import Scope, with_matched
from .tables import (
    COST,
    EDGES,
    SHORT,
    cost_table,
    edge_table,
    empty_lines,
    gap_line,
    markdown,
    mean_row,
    shape_table,
    surface_table,
    win_line,
)
from .timing import describe_machine

EXTREMES = 5  # number of best shapes shown, and of worst
ERROR_TOP = 0.25  # upper end of the colour bar in the pictures, in voxels
PROTOCOL_LINES = """\
Lengths are in units of the reference's box diagonal. 100,000 points are sampled on each surface; CD
is the sum of the mean squared distances both ways, F1 at 0.003, NC the normal consistency. p2s is
the mean exact point-to-triangle distance of both directions ("ref to res", "res to ref"); ECD and
EF1 (at 0.005) compare sharp edges. Field errors are those at the fine nodes of the band. The bound
is marching cubes of the true distances at the same nodes; the floor compares two independent
samplings of the reference. A result without a surface counts as a dot at the origin; a shape on
which a method failed is left out of that table for all methods, and named. Published rows are of
other shapes (Thingi30)."""

EDGE_LINES = """\
EFv is the F1 of points on the sharp edges (over 30 degrees) of both meshes, at a tenth of a coarse
voxel. The edge distance is that of points on the reference's edges to the result's triangles, in
coarse voxels: its mean. The angles, in degrees, are those between the result's normals and that of
the nearest triangle of the reference, within a coarse voxel of the reference's edges ("near") and
beyond. Slivers are triangles with an angle under 5 degrees; the min angle is the mean over the
shapes of the smallest. "Shapes" counts those with edges that were measured."""


def write_report(
    results: Results,
    out: Path,
    timings: Mapping[int, Sequence[Measurement]],
    *,
    up: str,
    pictures: bool,
) -> Path:
    """Write report.md, shapes.md, plots and pictures; return the path of report.md.

    Parameters
    ----------
    results : Results
        The measurements.
    out : Path
        The folder of the report.
    timings : measurements by size
        Of whole processes; empty if not asked for.
    up : {"x", "y", "z"}
        The axis that points up in the pictures.
    pictures : bool
        Whether to draw the best and the worst shapes.
    """
    scope = results.scope
    sections = [title_section(results)]
    sections += [size_section(results, setting) for setting in scope.settings()]
    sections += [edge_section(results)]
    tables = experiment_tables.SECTIONS
    sections += [tables[name](results) for name in scope.experiments if name in tables]
    sections += [peer_section(results)] if scope.peers else []
    sections += [experiment_tables.timing_section(timings)] if timings else []
    sections += [cost_section(results), plot_section(results, out)]
    sections += [picture_section(results, out, up)] if pictures and OURS in scope.methods else []
    shapes = [f"## {s.size}^3\n\n{shape_table(results.by_method(s))}" for s in scope.settings()]
    write_page(out / SHAPES, "\n\n".join(shapes) + "\n")
    text = "\n\n".join(filter(None, [*sections, note_section(results)])) + "\n"
    return write_page(out / REPORT, text)


def title_section(results: Results) -> str:
    """Return the title, the protocol, and what could not be measured."""
    lines = [f"# Quality of super-sdf on {len(results.floors)} shapes", PROTOCOL_LINES]
    turned = results.scope.turned
    lines += [] if turned is None else [f"The shapes are turned at random, by seed {turned}."]
    lines += [f"Left out, {entry.shape}: {entry.reason}." for entry in results.left_out]
    return "\n\n".join(lines)


def note_section(results: Results) -> str:
    """Return notes on flaws of the shapes themselves."""
    lines = [
        f"- {row['shape']}: {'; '.join(row['notes'])}."
        for row in results.floors.values()
        if row["notes"]
    ]
    return "\n".join(["## Notes on the shapes\n", *lines]) if lines else ""


def size_section(results: Results, setting: Setting) -> str:
    """Return the section on the quality at one size."""
    by_method = results.by_method(setting)
    lines = [win_line(by_method), gap_line(by_method), *empty_lines(by_method)]
    title = f"## {setting.size}^3, factor {setting.factor}"
    return "\n\n".join([title, surface_table(by_method, setting.size), *filter(None, lines)])


def edge_section(results: Results) -> str:
    """Return the section on edges, angles and triangles."""
    tables = [
        f"**{setting.size}^3, factor {setting.factor}**\n\n"
        + edge_table({LABELS[name]: rows for name, rows in results.by_method(setting).items()})
        for setting in results.scope.settings()
    ]
    return "\n\n".join(["## Edges and triangles", EDGE_LINES, *tables])


def peer_section(results: Results) -> str:
    """Return the section on the peers, each on the shapes that it finished."""
    scope, rows = results.scope, []
    setting, paths = Setting(scope.peer_size), scope.peer_paths()
    columns = (*SHORT, *EDGES, *COST)
    names = ("mc", "bspline", *OURS_MESHED.values())
    for name in (*names, *(name for peer in scope.peers for name in with_matched(peer))):
        done = results.rows(setting, name, paths)
        closed = f"{sum(row['closed'] for row in done)} of {len(done)}"
        finished = f"{len(done)} of {len(results.names(paths))}"
        rows.append([*mean_row(LABELS[name], done, columns), closed, finished])
    titles = ["method", *(column.title for column in columns), "closed", "finished"]
    failed = [
        f"{LABELS[name]}, {row['shape']}: {row['error']}."
        for name in scope.peers
        for row in results.out_of_time(setting, name, paths)
    ]
    title = f"## Peers, {scope.peer_size}^3, {len(results.names(paths))} shapes"
    return "\n\n".join([title, markdown(titles, rows), *failed])


def cost_section(results: Results) -> str:
    """Return the section on time and memory, from the grid in memory to the mesh in memory."""
    names = [name for name in results.scope.methods if name != "bound"]  # it needs the truth
    tables = [
        f"**{setting.size}^3**\n\n"
        + cost_table({LABELS[name]: results.rows(setting, name) for name in names})
        for setting in results.scope.settings()
    ]
    jobs = results.scope.jobs
    text = (
        f"From the samples in memory to the mesh in memory, {jobs} at a time on one machine, the "
        f"network with {results.scope.threads or 'all'} threads: to compare methods, not to quote. "
        "The peak is what the process held beyond what it held before."
    )
    return "\n\n".join(["## Time and memory", describe_machine(), text, *tables])


def plot_section(results: Results, out: Path) -> str:
    """Draw the plots; return the section that shows them."""
    by_size = {setting.size: results.by_method(setting) for setting in results.scope.settings()}
    titles = draw_plots(by_size, out / "plots")
    return "\n\n".join(["## Plots", *(f"![{text}](plots/{name})" for name, text in titles.items())])


def picture_section(results: Results, out: Path, up: str) -> str:
    """Draw the shapes on which ours is best and worst; return the section that shows them.

    They are ranked by F1 over the floor's F1, which is low on large surfaces: there 100,000 points
    are far apart.
    """
    setting, floors = results.scope.settings()[0], results.floors
    ranked = results.rows(setting, OURS)
    ranked.sort(key=lambda row: row["f1"] / floors[row["shape"]]["f1"], reverse=True)
    if not ranked:
        return ""
    shown = ranked if len(ranked) < 2 * EXTREMES else [*ranked[:EXTREMES], *ranked[-EXTREMES:]]
    title = extremes_title(len(ranked), setting)
    if not can_render():
        return f"{title}\n\nNot drawn: PyVista is not installed ({how_to_install('view')})."
    paths = {path.stem: path for path in results.scope.paths}
    lines, folder = [title], make_folder(out / "pictures")
    for row in shown:
        picture = folder / f"{row['shape']}.png"
        floor = floors[row["shape"]]["f1"]
        lines.append(
            f"**{row['shape']}**, F1 {row['f1']:.3f} (floor {floor:.3f}), NC {row['nc']:.3f}"
        )
        try:
            draw_shape(results.scope, paths[row["shape"]], picture, up)
            lines.append(f"![{row['shape']}](pictures/{picture.name})")
        except SuperSdfError as problem:  # the tables matter more than a picture
            lines.append(f"Not drawn: {problem}.")
    return "\n\n".join(lines)


def extremes_title(count: int, setting: Setting) -> str:
    """Return the heading of the pictures, which show all shapes if there are few."""
    if count == 1:
        return f"## The shape at {setting.size}^3"
    if count < 2 * EXTREMES:
        return f"## All {count} shapes at {setting.size}^3, best F1 over the floor's first"
    return (
        f"## The {EXTREMES} best and the {EXTREMES} worst shapes at {setting.size}^3, by F1 over "
        "the floor's"
    )


def draw_shape(scope: Scope, path: Path, target: Path, up: str) -> None:
    """Draw a picture of coarse marching cubes, ours, the reference, and the error of ours."""
    setting, shape = scope.settings()[0], Shape.read(path, scope.turned)
    case = Case(shape, setting)
    network = load_network(scope.model, device="cpu", precision=scope.precision)
    coarse, ours = (METHODS[name](case, network).mesh for name in ("mc", OURS))
    panels = [
        Panel(coarse, titled(coarse, f"marching cubes of {setting.size}^3")),
        Panel(ours, titled(ours, "super-sdf")),
        Panel(shape.mesh, "reference"),
        Panel(ours, "error of super-sdf", vertex_errors(ours, shape.solid)),
    ]
    render_panels(
        panels,
        target,
        colour="error",
        up=up,
        top=ERROR_TOP * case.spacing,
        unit="box diagonal 1",
    )


def titled(mesh: Mesh, title: str) -> str:
    """Return the title of a panel, which says so if the mesh is empty."""
    return title if len(mesh.faces) else f"{title}: no surface"
