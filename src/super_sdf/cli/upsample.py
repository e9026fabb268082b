"""The command ``upsample``: one grid file to one mesh file."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import OptionError
from ..files.formats import NAMED, list_formats
from ..machine.extras import check_modules
from .common import CONTEXT, one_line_errors, print_stderr, print_stdout, progress_bar
from .conversion import (
    check_can_check,
    check_cluster,
    check_option,
    check_simplification,
    chosen_model,
    cluster_option,
    conversion_options,
    labels_option,
    make_options,
)
from .interrupts import raising_interrupts
from .reporting import check_page, report_option

if TYPE_CHECKING:
    from ..certificate.check import Certificate
    from ..convert import Conversion, Engine
    from ..network.network import Network

HELP = f"""Refine the signed distance grid IN and write its surface as the mesh OUT.

IN is a grid file: {list_formats()}. FILE:NAME names one of several arrays in a {NAMED}
file. An .npz file has the keys values, spacing, origin and direction.

OUT is a .ply, .stl, .obj, .off, .glb or .3mf file.
"""
EXAMPLES = """\b
Examples:
  super-sdf upsample part.npz part.ply
  super-sdf upsample field.npy part.stl --spacing 0.5 --factor 8
  super-sdf upsample scan.h5:/distance part.ply --spacing 0.5
  super-sdf upsample organs.nii.gz organs.glb --labels all
"""


@click.command(
    "upsample",
    context_settings=CONTEXT,
    epilog=EXAMPLES,
    short_help="Refine a grid and write its surface as a mesh.",
    help=HELP,
)
@click.argument("source", metavar="IN")
@click.argument("target", metavar="OUT")
@conversion_options
@labels_option
@check_option
@click.option(
    "--save-field",
    metavar="FIELD",
    help="Also write the refined field: .npz for the values near the surface, .npy or .vti for "
    "the whole fine lattice. A .vti needs the extra vti.",
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
    if options["labels"] is not None:
        from .labels import run_labels

        with one_line_errors(target):
            return run_labels(source, target, options)
    with one_line_errors(target, options["save_field"], options["report"]):
        run = Upsampling(source, target, options)
        run.work()
        with raising_interrupts():
            if options["check"]:
                run.check()
            if options["report"]:
                run.write_page()
            run.print_report()


class Upsampling:
    """One run of the command: its options, its result, and the time of each stage."""

    def __init__(self, source: str, target: str, options: dict[str, Any]) -> None:
        self.source, self.target, self.options = source, target, options
        self.model = chosen_model(options)
        self.seconds: dict[str, float] = {}
        self.network: Network
        self.result: Conversion
        self.certificate: Certificate | None = None

    def work(self) -> None:
        """Check the options, load the network, convert."""
        from ..convert import convert
        from ..fields.writing import check_field_target
        from ..files.meshes import check_target
        from ..network.network import load_network
        from ..progress import Stopwatch
        from ..steps.nodes import check_factor

        options, watch = self.options, Stopwatch()
        check_factor(options["factor"])
        check_target(self.target, force=options["force"])
        if options["save_field"] is not None:
            check_field_target(options["save_field"], force=options["force"])
        if options["check"]:
            check_can_check(self.target)
        if options["report"]:
            self.check_page()
        check_simplification(options)
        self.check_cluster()
        watch.lap("start")
        self.network = load_network(
            self.model,
            device=options["device"],
            threads=options["threads"],
            precision=options["precision"],
        )
        watch.lap("load network")
        with (
            raising_interrupts(),
            self.engine() as engine,
            progress_bar("upsampling", options["quiet"]) as progress,
        ):
            self.result = convert(
                self.source,
                self.target,
                self.network,
                make_options(options),
                force=options["force"],
                progress=progress,
                announce=self.announce,
                save_field=options["save_field"],
                engine=engine,
            )
        self.seconds = watch.seconds | self.result.seconds

    def check_cluster(self) -> None:
        """Raise an error if ``--cluster`` cannot be used, or not with the other options."""
        options = self.options
        if options["cluster"] is None:
            if options["jobs"]:
                raise OptionError(
                    f"--jobs {options['jobs']} is for --cluster local: give that, too, or leave "
                    "it out"
                )
            return
        check_cluster(options)
        from ..bricks.engine import check_can_brick

        check_can_brick(self.source, make_options(options), options["save_field"])

    @contextmanager
    def engine(self) -> Iterator[Engine | None]:
        """Connect to the cluster; None without one."""
        options = self.options
        if options["cluster"] is None:
            yield None
            return
        from ..bricks.engine import BricksEngine
        from ..bricks.meshing import Loading
        from ..cluster.connecting import connect

        loading = Loading(absolute_model(self.model), options["precision"], options["device"])
        limits = {"threads": options["threads"], "max_memory": options["max_memory"]}
        with (
            connect(options["cluster"], workers=options["jobs"], **limits) as cluster,
            closing(BricksEngine(cluster, loading, self.announce)) as engine,
        ):
            yield engine

    def check(self) -> None:
        """Check the finished mesh against its samples."""
        from ..certificate.check import CheckOptions, check_files
        from ..errors import SuperSdfError
        from ..progress import Stopwatch

        watch, options = Stopwatch(), CheckOptions.of(make_options(self.options))
        options = replace(options, processes=self.options["threads"])
        try:
            self.certificate = check_files(self.target, self.source, options)
        except SuperSdfError as error:
            raise type(error)(f"{error}; {self.target} is written, but not checked") from error
        watch.lap("check")
        self.seconds |= watch.seconds

    def check_page(self) -> None:
        """Raise if the page cannot be written, or would replace what is read or written."""
        from ..files.store import files_of

        check_modules("--report", "report")
        field = [self.options["save_field"]] if self.options["save_field"] else []
        files = *files_of(self.source), self.target, *field
        check_page("--report", self.options["report"], files, force=self.options["force"])

    def write_page(self) -> None:
        """Write the page; what cannot be shown in it is said there."""
        from ..certificate.check import CheckOptions
        from ..pages.viewing import write_single
        from ..progress import Stopwatch

        watch, page = Stopwatch(), self.options["report"]
        options = replace(
            CheckOptions.of(make_options(self.options)), processes=self.options["threads"]
        )
        notes = [*self.result.remarks(), *self.device_notes()]
        report = {**self.report(), "notes": notes}
        write_single(page, report, options, self.certificate, force=self.options["force"])
        watch.lap("page")
        self.seconds |= watch.seconds

    def announce(self, line: str) -> None:
        """Print, before the work, what may make the user stop it; the bar is redrawn below."""
        if not self.options["quiet"]:
            print_stderr(f"\r{line}\x1b[K" if sys.stderr.isatty() else line)

    def print_report(self) -> None:
        """Print notes, warnings and a summary to stderr, and with ``--json`` JSON to stdout."""
        report = self.report()
        if self.options["as_json"]:
            print_stdout(json.dumps(report, indent=2), f"{self.target} is written")
        if self.options["quiet"]:
            return
        for note in (*self.result.notes, *self.result.remarks(), *self.device_notes()):
            print_stderr(f"Note: {note}")
        for warning in self.result.warnings:
            print_stderr(f"Warning: {warning}")
        if self.options["verbose"]:
            for key in ("shape", "spacing", "origin", "device", "band_voxels", "nodes"):
                print_stderr(f"{key.replace('_', ' ')}: {report[key]}")
            for stage, seconds in self.seconds.items():
                print_stderr(f"{stage}: {seconds:.3f} s")
        print_stderr(f"{self.target}: {self.summary()}")
        if self.result.saved_field:
            print_stderr(f"{self.options['save_field']}: {self.field_summary()}")
        if self.result.simplified:
            print_stderr(f"Simplified: {describe_simplified(self.result.simplified)}")
        if self.certificate:
            print_stderr(f"Check: {self.certificate.summary()}")
        if self.options["report"]:
            print_stderr(f"Report: {self.options['report']}")

    def report(self) -> dict[str, Any]:
        """Return counts, times and notes as ``--json`` prints them."""
        return {
            "input": self.source,
            "output": self.target,
            "factor": self.options["factor"],
            "offset": self.options["offset"],
            "mesher": self.options["mesher"],
            "model": self.model,
            "precision": self.network.precision,
            "device": self.network.device,
            "device_notes": self.device_notes(),
            **self.result.report(),
            **({"check": self.certificate.report()} if self.certificate else {}),
            "seconds": {stage: round(seconds, 4) for stage, seconds in self.seconds.items()},
        }

    def device_notes(self) -> list[str]:
        """Return notes on the device of the network."""
        return list(self.network.notes)

    def field_summary(self) -> str:
        """Describe the file of the refined field in one line."""
        field = self.result.saved_field or {}
        shape = " x ".join(map(str, field["shape"]))
        spacing, origin = (", ".join(f"{x:.12g}" for x in field[k]) for k in ("spacing", "origin"))
        return f"the refined field, lattice {shape}, spacing {spacing}, origin {origin}"

    def summary(self) -> str:
        """Describe the mesh in one line."""
        counts = self.result.counts
        low, high = (
            "(" + ", ".join(f"{x:.6g}" for x in corner) + ")" for corner in self.result.bounds
        )
        return (
            f"{counts['vertices']:,} vertices, {counts['triangles']:,} triangles, "
            f"{'closed' if self.result.closed else 'open'}, from {low} to {high}, "
            f"{sum(self.seconds.values()):.1f} s"
        )


def absolute_model(model: str) -> str:
    """Return a network for workers: by its name, or by the absolute path of its file."""
    from ..network.names import QUALITIES

    return model if model in QUALITIES else str(Path(model).absolute())


def describe_simplified(found: dict[str, Any]) -> str:
    """Describe in one line how much simpler a mesh is and how far from the unsimplified one."""
    off = found["deviation"]
    return (
        f"from {found['triangles_before']:,} to {found['triangles']:,} triangles; largest distance "
        f"{off['largest']:.4f} voxels from the unsimplified mesh to this one, "
        f"{off['largest_back']:.4f} back; mean {off['mean']:.4f} and {off['mean_back']:.4f}"
    )
