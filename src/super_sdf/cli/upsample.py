"""The command ``upsample``: one grid file to one mesh file, or an image to the meshes of labels."""

from __future__ import annotations

import json
from typing import Any

import click

from .. import __version__
from ..errors import OptionError, SuperSdfError
from ..files.formats import NAMED, list_formats
from ..options import MESH_FORMATS, OPTIONS, Options
from ..progress import Stopwatch
from . import common
from .common import option, print_stderr, print_stdout

HELP = f"""Refine the signed distance grid IN and write its surface as the mesh OUT.

IN is a grid file: {list_formats()}. FILE:NAME names one of several arrays in a {NAMED}
file. An .npz file has the keys values, spacing, origin and direction.

OUT is a mesh file: {", ".join(f".{name}" for name in MESH_FORMATS[:-1])} or .{MESH_FORMATS[-1]}.
"""
EXAMPLES = """\b
Examples:
  super-sdf upsample part.npz part.ply
  super-sdf upsample field.npy part.stl --spacing 0.5 --factor 8
  super-sdf upsample scan.h5:/distance part.ply --spacing 0.5
  super-sdf upsample organs.nii.gz organs.glb --labels all
"""
MANY = 50_000  # triangles of which simplifying is worth a hint
NOT_WITH_LABELS = ("save_field", "check", "report", "cluster", "jobs")


# fmt: off
@click.command(cls=common.Command, context_settings=common.CONTEXT, epilog=EXAMPLES, help=HELP,
    short_help="Refine a grid and write its surface as a mesh.")
@click.argument("source", metavar="IN")
@click.argument("target", metavar="OUT")
@common.table_options(*OPTIONS)
@common.shared("names", "cluster", "jobs", "check")
@option("--save-field", metavar="FIELD",
    help="Also write the refined field: .npz for the values near the surface, .vdb for a level set "
    "of OpenVDB, .npy or .vti for the whole fine lattice. A .vti needs the extra vti.")
@common.shared("report", "force", "json", "quiet")
@option("-v", "--verbose", is_flag=True, help="Also print counts and the time per stage.")
# fmt: on
def command(source: str, target: str, **given: Any) -> None:
    """Convert one grid to a mesh."""
    options, watch = common.chosen_options(given), Stopwatch()
    common.check_names(given["names"], options.labels)
    if options.labels is None:
        check_outputs(source, target, options, given)
    from ..network.network import digest_of_model, load_network

    network = load_network(**options.network())
    watch.lap("load network")
    model = options.network()["model"]
    report = {
        "input": source,
        "output": target,
        "version": __version__,
        "asked": options.digest(),
        "model": model,
        "network": digest_of_model(model, network.precision),
        "precision": network.precision,
        "device": network.device,
        "device_notes": list(network.notes),
    }
    work = upsample_grid if options.labels is None else upsample_labels
    lines = work(source, target, network, options, given, report, watch)
    report["seconds"] = watch.rounded()
    if given["as_json"]:
        print_stdout(json.dumps(report, indent=2), f"{target} is written")
    for line in () if given["quiet"] else lines:
        print_stderr(line)


def check_outputs(source: str, target: str, options: Options, given: dict[str, Any]) -> None:
    """Raise an error for what can be seen to fail before the work."""
    from ..files.meshes import check_target
    from ..files.regular import files_of

    force, field = given["force"], given["save_field"]
    check_target(target, force=force, unit=options.unit)
    if field is not None:
        from ..files.fields import check_field_target

        check_field_target(field, force=force)
    if given["report"]:
        outputs = (target, field) if field else (target,)
        common.check_page("--report", given["report"], [*files_of(source), *outputs], force=force)
    if given["cluster"] is not None:
        raise OptionError("--cluster is for batch: leave it out")
    elif given["jobs"]:
        raise OptionError(f"--jobs {given['jobs']} is for --cluster local: give that, or no --jobs")


def upsample_grid(
    source: str,
    target: str,
    network: Any,
    options: Options,
    given: dict[str, Any],
    report: dict[str, Any],
    watch: Stopwatch,
) -> list[str]:
    """Convert a grid, check its mesh and write its page if asked for; return what to print."""
    force, page, certificate = given["force"], given["report"], None
    with common.progress_bar("upsampling", given["quiet"]) as progress:
        told = {"force": force, "progress": progress}
        from ..convert import convert

        done = convert(source, target, network, options, save_field=given["save_field"], **told)
    watch.take(done.seconds)
    report |= done.report()
    if given["check"]:
        from ..check.check import check_files

        try:
            certificate = check_files(target, source, options, made=done)
        except SuperSdfError as error:
            raise type(error)(f"{error}; {target} is written, but not checked") from error
        report["check"] = certificate.report()
        watch.lap("check")
    if page:
        from ..pages.html import page_of_conversion, write_page

        said = {"seconds": watch.rounded(), "notes": [*done.remarks(), *network.notes]}
        text = page_of_conversion({**report, **said}, options, done, certificate)
        write_page(text, page, force=force)
        watch.lap("page")
    lines = [f"Note: {note}" for note in (*done.notes, *done.remarks(), *network.notes)]
    lines += [f"Warning: {warning}" for warning in done.warnings]
    if given["verbose"]:
        keys = ("shape", "spacing", "origin", "device", "band_voxels", "nodes")
        lines += [f"{key.replace('_', ' ')}: {report[key]}" for key in keys]
        lines += [f"{stage}: {seconds:.3f} s" for stage, seconds in watch.seconds.items()]
    counts, few = done.counts, done.simplified
    low, high = (f"({', '.join(f'{x:.6g}' for x in corner)})" for corner in done.bounds)
    hint = "; far fewer triangles within 0.02 voxels of these: --simplify 0.02"
    lines.append(
        f"{target}: {counts['vertices']:,} vertices, {counts['triangles']:,} triangles, "
        f"{'closed' if done.closed else 'open'}, from {low} to {high}, "
        f"{sum(watch.seconds.values()):.1f} s" + hint * (not few and counts["triangles"] > MANY)
    )
    if field := done.saved_field:
        shape = " x ".join(map(str, field["shape"]))
        place = [", ".join(f"{x:.12g}" for x in field[key]) for key in ("spacing", "origin")]
        said_of = f"lattice {shape}, spacing {place[0]}, origin {place[1]}"
        lines.append(f"{given['save_field']}: the refined field, {said_of}")
    if few:
        off = few["deviation"]
        largest = max(off["largest"], off["largest_back"]) * few["voxel_size"]
        lines.append(
            f"Simplified: from {few['triangles_before']:,} to {few['triangles']:,} triangles; "
            f"largest distance {off['largest']:.4f} voxels from the unsimplified mesh to this one, "
            f"{off['largest_back']:.4f} back; mean {off['mean']:.4f} and {off['mean_back']:.4f}; "
            f"at most {largest:.4g} {options.unit or 'in world units'}"
        )
    lines += [f"Check: {certificate.summary()}"] if certificate else []
    return lines + [f"Report: {page}"] * bool(page)


def upsample_labels(
    source: str,
    target: str,
    network: Any,
    options: Options,
    given: dict[str, Any],
    report: dict[str, Any],
    watch: Stopwatch,
) -> list[str]:
    """Convert the labels of an image to meshes; return what to print."""
    from ..labels.files import check_options, convert_labels, missing_note
    from ..labels.names import read_names

    check_options(options, [name for name in NOT_WITH_LABELS if given[name]])
    names = read_names(given["names"]) if given["names"] else None
    with common.progress_bar("upsampling", given["quiet"]) as progress:
        made = convert_labels(
            source, target, network, options, names=names, force=given["force"], progress=progress
        )
    watch.lap("convert")
    report |= made
    notes = (*made["inferred"], *missing_note(made["missing"]), *network.notes)
    return [
        *(f"Note: {note}" for note in notes),
        *(
            f"{row['output']}: {row['name']}, {row['vertices']:,} vertices, "
            f"{row['triangles']:,} triangles, "
            f"{row['components']:,} closed component{'s' * (row['components'] != 1)}, "
            f"volume {row['volume']:.6g}, of its samples {row['sample_volume']:.6g}"
            for row in made["labels"]
        ),
        f"{len(made['labels'])} labels, {sum(watch.seconds.values()):.1f} s",
    ]
