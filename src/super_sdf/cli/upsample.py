"""Refine the signed distance grid IN and write its surface as the mesh OUT.

IN is a grid file: $grids. FILE:NAME names one of several arrays in a $several
file. An .npz file has the keys values, spacing, origin and direction.

OUT is a mesh file: one of $meshes. With - for IN, an .npy file is
read from standard input; with - for OUT, the mesh is written to standard output.

  super-sdf upsample part.npz part.ply
  super-sdf upsample field.npy part.stl --spacing 0.5 --factor 8
  super-sdf upsample scan.h5:/distance part.ply --spacing 0.5
  super-sdf upsample organs.nii.gz organs.glb --labels all
  cat field.npy | super-sdf upsample - - --format stl > part.stl
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from click import Argument, Choice, Option

from .. import __version__
from ..errors import OptionError, SuperSdfError
from ..files.meshes import has_parts
from ..options import LENGTHS, MESH_FORMATS, OPTIONS, Options
from . import main

MANY = 50_000  # triangles of which simplifying is worth a hint
TILES_PER_THREAD = 2  # of a cluster: one that dies costs little
NOT_WITH_LABELS = ("save_field", "check", "report", "cluster", "jobs")

TAKES = (
    Argument(["source"], metavar="IN", type=main.NAME),
    Argument(["target"], metavar="OUT", type=main.NAME),
    Option(["--format", "kind"], type=Choice(MESH_FORMATS),
        help="Mesh file format on standard output. Default: ply."),
    *OPTIONS,
    "names", "cluster", "jobs", "check",
    Option(["--save-field"], metavar="FIELD",
        help="Also write the refined field: .npz for the values near the surface, .vdb for a level "
        "set of OpenVDB, .npy or .vti (extra vti) for the whole fine lattice."),
    "report", "force", "json", "quiet",
)  # fmt: skip


def command(source: str, target: str, **given: Any) -> None:
    """Convert one grid to a mesh, or the labels of an image to meshes."""
    start, options, page = time.perf_counter(), main.chosen_options(given, source), given["report"]
    if target == "-" and given["as_json"]:
        raise OptionError("--json is for standard output, too: give a file for OUT")
    if target == "-" and options.labels is not None and not has_parts(f"-.{given['kind']}"):
        raise OptionError("--labels makes a file for each label: give --format glb or 3mf")
    with standard_streams(source, target, given["kind"]) as (grid, mesh):
        if page:
            outputs = [name for name in (target, given["save_field"]) if name]
            main.check_page("--report", page, [source], outputs, force=given["force"])
        from ..network.network import load_network

        network, certificate = load_network(**options.network()), None
        seconds = {"load network": time.perf_counter() - start}
        done = converted(grid, mesh, network, options, **given)
        report: dict[str, Any] = {"input": source, "output": target, "version": __version__}
        report |= {"asked": options.digest(), "model": options.network()["model"]}
        report |= {"precision": network.precision, "device": network.device}
        report |= {"device_notes": list(network.notes), **done.facts}
        seconds, start = seconds | done.seconds, time.perf_counter()
        if given["as_json"] or page:
            report["network"] = sha256(network.path.read_bytes()).hexdigest()
        if given["check"]:
            from ..check import check_mesh
            from ..truth import merged

            certificate = check_mesh(merged(done.mesh), done.grid, options)
            report["check"] = certificate.report()
            seconds["check"] = time.perf_counter() - start
        report["seconds"] = {stage: round(spent, 4) for stage, spent in seconds.items()}
        if page:
            from ..pages.html import page_of_conversion, write_page

            shown = {**report, "notes": network.notes}
            text = page_of_conversion(shown, options, done, certificate)
            write_page(text, page, force=given["force"])
        if given["as_json"]:
            main.print_stdout(report)
        if not given["quiet"]:
            checked = [f"Check: {certificate.summary()}"] if certificate else []
            main.print_stderr(*lines_of(report), *checked, *[f"Report: {page}"] * bool(page))


@contextmanager
def standard_streams(source: str, target: str, kind: str | None) -> Iterator[tuple[str, str]]:
    """Yield the files IN and OUT; for - those in a temporary folder, named so in messages."""
    if kind and target != "-":
        raise OptionError(f"--format {kind} is for an OUT that is -: leave it out for {target}")
    if "-" not in (source, target):
        yield source, target
        return
    if (source == "-" and not sys.stdin) or (target == "-" and not sys.stdout):
        raise OptionError("- is a standard stream, which is closed: give a file")
    with TemporaryDirectory() as folder:
        grid, mesh = Path(folder, "stdin.npy"), Path(folder, f"stdout.{kind or MESH_FORMATS[0]}")
        if source == "-":
            grid.write_bytes(sys.stdin.buffer.read())
        try:
            yield str(grid) if source == "-" else source, str(mesh) if target == "-" else target
        except SuperSdfError as error:
            raise type(error)(error.flagged.replace(folder + os.sep, "")) from None
        if target == "-":
            sys.stdout.buffer.write(mesh.read_bytes())


def converted(source: str, target: str, network: Any, options: Options, **given: Any) -> Any:
    """Return the conversion of a grid, here or on a cluster, or that of the labels of an image."""
    with ExitStack() as stack:
        bar = main.progress_bar("upsampling", given["quiet"], "reading")
        how: Any = {"progress": stack.enter_context(bar), "force": given["force"]}
        if options.labels is not None:
            from ..labels.files import check_options, convert_labels

            check_options(options, [name for name in NOT_WITH_LABELS if given[name]])
            return convert_labels(source, target, network, options, names=given["names"], **how)
        from ..convert import convert

        if given["cluster"]:
            from ..batch.cluster import connect, tiles_on

            to = connect(given["cluster"], given["jobs"], options.max_memory)
            client: Any = stack.enter_context(to)
            least = TILES_PER_THREAD * sum(client.nthreads().values())
            how |= {"map_tiles": tiles_on(client), "least_tiles": least}
        return convert(source, target, network, options, save_field=given["save_field"], **how)


def lines_of(report: dict[str, Any]) -> list[str]:
    """Return lines on a result: notes and warnings, and what was written."""
    lines = [f"Note: {note}" for note in (*report["inferred"], *report["device_notes"])]
    lines += [f"Warning: {warning}" for warning in report.get("warnings", ())]
    is_mm = report["space"] and "the unit that it states" not in " ".join(report["inferred"])
    unit = report["asked"]["unit"] or ("mm" if is_mm else None)
    scale, ml = ((100 * LENGTHS[unit]) ** 3, " ml") if unit else (1, "")
    if report["asked"]["unit"] and report["output"] != "-" and not has_parts(report["output"]):
        lines.append(f"Note: {report['output']} states no unit, only a .glb or .3mf does")
    seconds = f"{sum(report['seconds'].values()):.1f} s"
    for row in report.get("labels", ()):
        name = report["output"] if report["output"] == "-" else row["output"]
        line = f"{name}: {row['name']}, {row['triangles']:,} triangles, "
        line += f"pieces: {row['components'] - row['cavities']}, cavities: {row['cavities']}, "
        volumes = [f"{scale * row[name]:.6g}{ml}" for name in ("volume", "sample_volume")]
        lines.append(f"{line}volume {volumes[0]}, of its voxels {volumes[1]}")
    if "labels" in report:
        return [*lines, f"labels: {len(report['labels'])}, {seconds}"]
    few, field, triangles = report.get("simplified"), report.get("saved_field"), report["triangles"]
    low, high = (f"({', '.join(f'{x:.6g}' for x in corner)})" for corner in report["bounds"])
    line = f"{report['output']}: {report['vertices']:,} vertices, {triangles:,} triangles, "
    line += f"{'closed' if report['closed'] else 'open'}, from {low} to {high}, {seconds}"
    if not few and triangles > MANY:
        line += "; for far fewer triangles, within 0.02 voxel: --simplify 0.02"
    lines.append(line)
    if field:
        shape = " x ".join(map(str, field["shape"]))
        lines.append(f"{field['path']}: the refined field, lattice {shape}")
    if few:
        off = max(few["deviation"][way] for way in ("largest", "largest_back"))
        said = f"Simplified: from {few['triangles_before']:,} to {triangles:,} triangles; largest "
        said += f"distance {off:.4f} voxels, {off * few['voxel_size']:.4g} in world units"
        lines.append(said)
        if off > 0.5:
            lines.append("Note: over half a voxel thin parts may be lost: --simplify 0.1 is closer")
    return lines
