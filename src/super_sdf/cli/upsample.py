"""The command ``upsample``: one grid file to one mesh file, or an image to the meshes of labels."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import click

from .. import __version__
from ..errors import SuperSdfError
from ..files.formats import LISTED, NAMED
from ..options import MESH_FORMATS, OPTIONS, Options
from ..threads import Stopwatch
from . import main
from .main import SHARED, option, table_option

HELP = f"""Refine the signed distance grid IN and write its surface as the mesh OUT.

IN is a grid file: {LISTED}. FILE:NAME names one of several arrays in a {NAMED}
file. An .npz file has the keys values, spacing, origin and direction.

OUT is a mesh file: {", ".join(f".{name}" for name in MESH_FORMATS[:-1])} or .{MESH_FORMATS[-1]}.

\b
Examples:
  super-sdf upsample part.npz part.ply
  super-sdf upsample field.npy part.stl --spacing 0.5 --factor 8
  super-sdf upsample scan.h5:/distance part.ply --spacing 0.5
  super-sdf upsample organs.nii.gz organs.glb --labels all
"""
MANY = 50_000  # triangles of which simplifying is worth a hint
TILES_PER_THREAD = 2  # of a cluster: one that dies costs little
NOT_WITH_LABELS = ("save_field", "check", "report", "cluster", "jobs")

# fmt: off
TAKES = (
    click.argument("source", metavar="IN"),
    click.argument("target", metavar="OUT"),
    *map(table_option, OPTIONS),
    *(SHARED[name] for name in ("names", "cluster", "jobs", "check")),
    option("--save-field", metavar="FIELD",
        help="Also write the refined field: .npz for the values near the surface, .vdb for a level "
        "set of OpenVDB, .npy or .vti (extra vti) for the whole fine lattice."),
    *(SHARED[name] for name in ("report", "force", "json", "quiet")),
    option("-v", "--verbose", is_flag=True, help="Also print counts and the time per stage."),
)
# fmt: on


@main.make_command("Refine a grid and write its surface as a mesh.", HELP, *TAKES)
def command(source: str, target: str, **given: Any) -> None:
    """Convert one grid to a mesh, or the labels of an image to meshes."""
    options, page, watch = main.chosen_options(given), given["report"], Stopwatch()
    main.check_names(given, options.labels)
    if page:
        others = [name for name in (target, given["save_field"]) if name]
        main.check_page("--report", page, [source], others, force=given["force"])
    from ..network.network import load_network

    network = load_network(**options.network())
    watch.lap("load network")
    done, certificate = converted(source, target, network, options, given), None
    watch.take(done.seconds)
    report = {
        "input": source,
        "output": target,
        "version": __version__,
        "asked": options.digest(),
        "model": options.network()["model"],
        "precision": network.precision,
        "device": network.device,
        "device_notes": list(network.notes),
        **done.report(),
    }
    if given["as_json"] or page:
        from hashlib import sha256  # imported here, as it loads OpenSSL

        report["network"] = sha256(network.path.read_bytes()).hexdigest()
    if given["check"]:
        from ..check import check_mesh, read_for_check

        try:
            certificate = check_mesh(*read_for_check(target, source, options, done), options)
        except SuperSdfError as error:
            why = f"{error.flagged}; {target} is written, but not checked"
            raise type(error)(why) from error
        report["check"] = certificate.report()
        watch.lap("check")
    if page:
        from ..pages.html import page_of_conversion, write_page

        facts = {**report, "seconds": watch.seconds, "notes": network.notes}
        text = page_of_conversion(facts, options, done, certificate)
        write_page(text, page, force=given["force"])
        watch.lap("page")
    report["seconds"] = {stage: round(spent, 4) for stage, spent in watch.seconds.items()}
    if given["as_json"]:
        main.print_stdout(report, f"{target} is written")
    if not given["quiet"]:
        lines = lines_of(report, [*report["inferred"], *network.notes], given["verbose"])
        lines += [f"Check: {certificate.summary()}"] if certificate else []
        main.print_stderr(*lines, *[f"Report: {page}"] * bool(page))


def converted(
    source: str, target: str, network: Any, options: Options, given: dict[str, Any]
) -> Any:
    """Return the conversion of a grid, here or on a cluster, or that of the labels of an image."""
    with ExitStack() as stack:
        bar = main.progress_bar("upsampling", given["quiet"], "reading")
        both: Any = {"progress": stack.enter_context(bar), "force": given["force"]}
        if options.labels is not None:
            from ..labels.files import check_options, convert_labels, read_names

            check_options(options, [name for name in NOT_WITH_LABELS if given[name]])
            how: Any = {"names": given["names"] and read_names(given["names"])}
            return convert_labels(source, target, network, options, **how, **both)
        from ..convert import convert

        how = {"save_field": given["save_field"]}
        if given["cluster"] is not None:
            from ..batch.cluster import connect, tiles_on

            to = connect(given["cluster"], given["jobs"], options.max_memory)
            client: Any = stack.enter_context(to)
            least = TILES_PER_THREAD * sum(client.nthreads().values())
            how |= {"map_tiles": tiles_on(client), "least_tiles": least}
        return convert(source, target, network, options, **how, **both)


def lines_of(report: dict[str, Any], notes: list[str], is_verbose: bool) -> list[str]:
    """Return lines on a result: notes and warnings, counts and times if asked for, and meshes."""
    lines = [f"Note: {note}" for note in notes]
    lines += [f"Warning: {warning}" for warning in report.get("warnings", ())]
    if is_verbose:
        keys = ("shape", "spacing", "origin", "device", "band_voxels", "nodes")
        lines += [f"{key.replace('_', ' ')}: {report[key]}" for key in keys if key in report]
        lines += [f"{stage}: {spent:.3f} s" for stage, spent in report["seconds"].items()]
    seconds = f"{sum(report['seconds'].values()):.1f} s"
    for row in report.get("labels", ()):
        plural = "s" * (row["components"] != 1)
        lines.append(
            f"{row['output']}: {row['name']}, {row['triangles']:,} triangles, "
            f"{row['components']:,} closed component{plural}, volume {row['volume']:.6g}, of its "
            f"samples {row['sample_volume']:.6g}"
        )
    if "labels" in report:
        return [*lines, f"{len(report['labels'])} labels, {seconds}"]
    return lines + describe_mesh(report, seconds)


def describe_mesh(report: dict[str, Any], seconds: str) -> list[str]:
    """Return lines on a mesh, its field and how it was simplified."""
    few, field, triangles = report.get("simplified"), report.get("saved_field"), report["triangles"]
    low, high = (f"({', '.join(f'{x:.6g}' for x in corner)})" for corner in report["bounds"])
    closed = "closed" if report["closed"] else "open"
    line = f"{report['output']}: {report['vertices']:,} vertices, {triangles:,} triangles, {closed}"
    line += f", from {low} to {high}, {seconds}"
    if not few and triangles > MANY:
        line += "; far fewer triangles within 0.02 voxels of these: --simplify 0.02"
    lines = [line]
    if field:
        shape = " x ".join(map(str, field["shape"]))
        spacing, origin = (", ".join(f"{x:.12g}" for x in field[k]) for k in ("spacing", "origin"))
        place = f"lattice {shape}, spacing {spacing}, origin {origin}"
        lines.append(f"{field['path']}: the refined field, {place}")
    if few:
        off, unit = few["deviation"], report["asked"]["unit"] or "in world units"
        largest = max(off["largest"], off["largest_back"]) * few["voxel_size"]
        lines.append(
            f"Simplified: from {few['triangles_before']:,} to {few['triangles']:,} triangles; "
            f"largest distance {off['largest']:.4f} voxels from the unsimplified mesh to this one, "
            f"{off['largest_back']:.4f} back; mean {off['mean']:.4f} and {off['mean_back']:.4f}; "
            f"at most {largest:.4g} {unit}"
        )
    return lines
