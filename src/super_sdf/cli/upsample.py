"""The command ``upsample``: one grid file to one mesh file, or an image to the meshes of labels."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .. import __version__
from ..errors import OptionError, SuperSdfError
from ..files.formats import NAMED, list_formats
from ..machine.extras import check_modules
from ..options import MESH_FORMATS, ConvertOptions
from ..progress import Progress, Stopwatch
from .common import (CONTEXT, GroupedCommand, check_can_check, check_cluster, check_names, check_option, check_page, chosen_model, cluster_option, conversion_options, labels_option, load_chosen, make_options, names_option, one_line_errors, print_stderr, print_stdout, progress_bar, report_option)
from .interrupts import raising_interrupts

if TYPE_CHECKING:
    from ..check.check import Certificate
    from ..convert import Conversion
    from ..network.network import Network

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


@click.command(
    "upsample",
    cls=GroupedCommand,
    context_settings=CONTEXT,
    epilog=EXAMPLES,
    short_help="Refine a grid and write its surface as a mesh.",
    help=HELP,
)
@click.argument("source", metavar="IN")
@click.argument("target", metavar="OUT")
@conversion_options
@labels_option
@names_option
@check_option
@click.option(
    "--save-field",
    metavar="FIELD",
    help="Also write the refined field: .npz for the values near the surface, .vdb for a level set "
    "of OpenVDB, .npy or .vti for the whole fine lattice. A .vti needs the extra vti.",
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
        check_names(options["names"], chosen.labels)
        if chosen.labels is None:
            Upsampling(source, target, chosen, options).complete()
        else:
            upsample_labels(source, target, chosen, options)


class Upsampling:
    """One run of the command: its options, its result, and the time of each stage."""

    def __init__(
        self, source: str, target: str, chosen: ConvertOptions, options: dict[str, Any]
    ) -> None:
        watch = Stopwatch()
        self.source, self.target, self.options = source, target, options
        self.chosen, self.model = chosen, chosen_model(options)
        self.network = load_chosen(options, meanwhile=self._check_arguments)
        watch.lap("load network")
        self.seconds = watch.seconds
        self.result: Conversion
        self.certificate: Certificate | None = None

    def complete(self) -> None:
        """Convert the grid, check its mesh and write its page if asked for, print the result."""
        options = self.options
        from ..convert import SHARE_BEFORE

        then = (SHARE_BEFORE, "simplifying") if self.chosen.goals() else None
        with raising_interrupts(), progress_bar("upsampling", options["quiet"], then) as progress:
            self.result = self._convert_here(progress)
        self.seconds |= self.result.seconds
        with raising_interrupts():
            if options["check"]:
                self._check()
            if options["report"]:
                self._write_page()
            self.print_report()

    def _check_arguments(self) -> None:
        """Raise an error for what can be seen to fail before the work."""
        from ..files.meshes import check_target
        from ..files.regular import files_of

        options, force = self.options, self.options["force"]
        check_target(self.target, force=force, unit=self.chosen.unit)
        outputs: list[str] = [self.target]
        if options["save_field"] is not None:
            from ..files.fields import check_field_target

            check_field_target(options["save_field"], force=force)
            outputs.append(options["save_field"])
        if options["check"]:
            check_can_check()
        if options["report"]:
            check_modules("--report", "report")
            files: list[str | Path] = [*files_of(self.source), *outputs]
            check_page("--report", options["report"], files, force=force)
        if options["cluster"] is not None:
            check_cluster(options)
            raise OptionError("--cluster is not there yet: leave it out")
        elif options["jobs"]:
            raise OptionError(
                f"--jobs {options['jobs']} is for --cluster local: give that, too, or leave it out"
            )

    def _convert_here(self, progress: Progress | None) -> Conversion:
        from ..convert import convert

        return convert(
            self.source,
            self.target,
            self.network,
            self.chosen,
            force=self.options["force"],
            progress=progress,
            announce=self._announce,
            save_field=self.options["save_field"],
        )

    def _announce(self, line: str) -> None:
        """Print, before the work, what may make the user stop it; the bar is redrawn below."""
        if not self.options["quiet"]:
            print_stderr(f"\r{line}\x1b[K" if sys.stderr.isatty() else line)

    def _check(self) -> None:
        """Check the finished mesh against its samples."""
        from ..check.check import check_files

        watch = Stopwatch()
        files = self.target, self.source, self.chosen
        try:
            self.certificate = check_files(*files, made=self.result)
        except SuperSdfError as error:
            raise type(error)(f"{error}; {self.target} is written, but not checked") from error
        watch.lap("check")
        self.seconds |= watch.seconds

    def _write_page(self) -> None:
        """Write the page; what cannot be shown in it is said there."""
        from ..pages.html import page_of_conversion, write_page

        watch = Stopwatch()
        report = {**self._report(), "notes": [*self.result.remarks(), *self.network.notes]}
        given = self.chosen, self.result, self.certificate
        text = page_of_conversion(report, *given)
        write_page(text, self.options["report"], force=self.options["force"])
        watch.lap("page")
        self.seconds |= watch.seconds

    def print_report(self) -> None:
        """Print notes, warnings and a summary to stderr, and with ``--json`` JSON to stdout."""
        result = self.result
        if self.options["as_json"]:
            print_stdout(json.dumps(self._report(), indent=2), f"{self.target} is written")
        if self.options["quiet"]:
            return
        for note in (*result.notes, *result.remarks(), *self.network.notes):
            print_stderr(f"Note: {note}")
        for warning in result.warnings:
            print_stderr(f"Warning: {warning}")
        if self.options["verbose"]:
            report = self._report()
            for key in ("shape", "spacing", "origin", "device", "band_voxels", "nodes"):
                print_stderr(f"{key.replace('_', ' ')}: {report[key]}")
            for stage, seconds in self.seconds.items():
                print_stderr(f"{stage}: {seconds:.3f} s")
        print_stderr(f"{self.target}: {_describe_mesh(result, sum(self.seconds.values()))}")
        if result.saved_field:
            print_stderr(f"{self.options['save_field']}: {_describe_field(result.saved_field)}")
        if result.simplified:
            print_stderr(f"Simplified: {_describe_simplified(result.simplified, self.chosen.unit)}")
        if self.certificate:
            print_stderr(f"Check: {self.certificate.summary()}")
        if self.options["report"]:
            print_stderr(f"Report: {self.options['report']}")

    def _report(self) -> dict[str, Any]:
        """Return counts, times and notes as ``--json`` prints them."""
        return {
            "input": self.source,
            "output": self.target,
            "version": __version__,
            "asked": self.chosen.digest(),
            **_describe_network(self.model, self.network),
            **self.result.report(),
            **({"check": self.certificate.report()} if self.certificate else {}),
            "seconds": _rounded(self.seconds),
        }


def upsample_labels(
    source: str, target: str, chosen: ConvertOptions, options: dict[str, Any]
) -> None:
    """Convert the labels of an image to meshes, and print what was made."""
    from ..labels.files import check_options, convert_labels
    from ..labels.names import read_names

    watch, model = Stopwatch(), chosen_model(options)
    check_options(chosen, [name for name in NOT_WITH_LABELS if options[name]])
    names = read_names(options["names"]) if options["names"] else None
    network = load_chosen(options)
    watch.lap("load network")
    with raising_interrupts(), progress_bar("upsampling", options["quiet"]) as progress:
        made = convert_labels(
            *(source, target, network, chosen),
            names=names,
            force=options["force"],
            progress=progress,
        )
    watch.lap("convert")
    if options["as_json"]:
        report = {
            "input": source,
            "output": target,
            "version": __version__,
            "asked": chosen.digest(),
            **_describe_network(model, network),
            **made.report(),
            "seconds": _rounded(watch.seconds),
        }
        print_stdout(json.dumps(report, indent=2), "the meshes are written")
    if options["quiet"]:
        return
    for note in (*made.grid.notes, *made.notes, *made.remarks(), *network.notes):
        print_stderr(f"Note: {note}")
    for row in made.labels:
        print_stderr(
            f"{row['output']}: {row['name']}, {row['vertices']:,} vertices, "
            f"{row['triangles']:,} triangles, "
            f"{row['components']:,} closed component{'s' * (row['components'] != 1)}, "
            f"volume {row['volume']:.6g}, of its samples {row['sample_volume']:.6g}"
        )
    print_stderr(f"{len(made.labels)} labels, {sum(watch.seconds.values()):.1f} s")


def _describe_network(model: str, network: Network) -> dict[str, Any]:
    from ..network.network import digest_of_model

    return {
        "model": model,
        "network": digest_of_model(model, network.precision),
        "precision": network.precision,
        "device": network.device,
        "device_notes": list(network.notes),
    }


def _rounded(seconds: dict[str, float]) -> dict[str, float]:
    return {stage: round(spent, 4) for stage, spent in seconds.items()}


def _describe_mesh(result: Conversion, seconds: float) -> str:
    counts = result.counts
    low, high = (f"({', '.join(f'{x:.6g}' for x in corner)})" for corner in result.bounds)
    closed = "closed" if result.closed else "open"
    is_large = not result.simplified and counts["triangles"] > MANY
    hint = "; far fewer triangles within 0.02 voxels of these: --simplify 0.02" if is_large else ""
    return (
        f"{counts['vertices']:,} vertices, {counts['triangles']:,} triangles, {closed}, "
        f"from {low} to {high}, {seconds:.1f} s{hint}"
    )


def _describe_field(field: dict[str, Any]) -> str:
    shape = " x ".join(map(str, field["shape"]))
    spacing, origin = (", ".join(f"{x:.12g}" for x in field[k]) for k in ("spacing", "origin"))
    return f"the refined field, lattice {shape}, spacing {spacing}, origin {origin}"


def _describe_simplified(simplified: dict[str, Any], unit: str | None) -> str:
    """Describe in one line how much simpler a mesh is and how far from the unsimplified one."""
    off = simplified["deviation"]
    largest = max(off["largest"], off["largest_back"])
    return (
        f"from {simplified['triangles_before']:,} to {simplified['triangles']:,} triangles; "
        f"largest distance {off['largest']:.4f} voxels from the unsimplified mesh to this one, "
        f"{off['largest_back']:.4f} back; mean {off['mean']:.4f} and {off['mean_back']:.4f}; "
        f"at most {largest * simplified['voxel_size']:.4g} {unit or 'in world units'}"
    )
