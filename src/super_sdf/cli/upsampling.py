"""The work of ``upsample``: checks, conversion, check, page, and what it prints."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..convert import Conversion, convert
from ..errors import OptionError, SuperSdfError
from ..files.meshes import check_target
from ..files.regular import files_of
from ..label_files import check_options, convert_labels
from ..machine.extras import check_modules
from ..network.network import Network
from ..options import QUALITIES, ConvertOptions
from ..progress import Progress, Stopwatch
from .common import print_stderr, print_stdout, progress_bar
from .conversion import check_can_check, check_cluster, chosen_model, load_chosen
from .interrupts import raising_interrupts
from .view import check_page

if TYPE_CHECKING:
    from ..certificate.check import Certificate

NOT_WITH_LABELS = ("save_field", "check", "report", "cluster", "jobs")


def upsample(
    source: str,
    target: str,
    chosen: ConvertOptions,
    options: dict[str, Any],
    network: Future[Network],
) -> None:
    """Convert a grid, check its mesh and write its page if asked for, and print the result."""
    run = Upsampling(source, target, chosen, options, network)
    run.convert()
    with raising_interrupts():
        if options["check"]:
            run.check()
        if options["report"]:
            run.write_page()
        run.print_report()


def check_arguments(
    source: str, target: str, chosen: ConvertOptions, options: dict[str, Any]
) -> None:
    """Raise an error for what can be seen to fail before the work."""
    check_target(target, force=options["force"])
    outputs: list[str] = [target]
    if options["save_field"] is not None:
        from ..fields.writing import check_field_target

        check_field_target(options["save_field"], force=options["force"])
        outputs.append(options["save_field"])
    if options["check"]:
        check_can_check()
    if options["report"]:
        check_modules("--report", "report")
        files: list[str | Path] = [*files_of(source), *outputs]
        check_page("--report", options["report"], files, force=options["force"])
    if options["cluster"] is not None:
        check_cluster(options)
        from ..cluster.bricks import check_can_brick

        check_can_brick(source, chosen, options["save_field"])
    elif options["jobs"]:
        raise OptionError(
            f"--jobs {options['jobs']} is for --cluster local: give that, too, or leave it out"
        )


def convert_on_workers(
    run: Upsampling, model: str, chosen: ConvertOptions, progress: Progress | None
) -> Conversion:
    """Convert a grid on the workers of a cluster."""
    from ..cluster.bricks import Loading, convert_on_cluster
    from ..cluster.connecting import connect

    options = run.options
    if model not in QUALITIES:
        model = str(Path(model).absolute())
    loading = Loading(model, options["precision"], options["device"])
    limits = {"threads": options["threads"], "max_memory": options["max_memory"]}
    with connect(options["cluster"], workers=options["jobs"], **limits) as cluster:
        return convert_on_cluster(
            run.source,
            run.target,
            cluster,
            loading,
            chosen,
            force=options["force"],
            progress=progress,
            announce=run.announce,
        )


class Upsampling:
    """One run of the command: its options, its result, and the time of each stage."""

    def __init__(
        self, source: str, target: str, chosen: ConvertOptions, options: dict[str, Any], network
    ) -> None:
        watch = Stopwatch()
        self.source, self.target, self.options = source, target, options
        self.chosen, self.model = chosen, chosen_model(options)
        check_arguments(source, target, self.chosen, options)
        watch.lap("start")
        self.network = network.result()
        watch.lap("load network")
        self.seconds = watch.seconds
        self.result: Conversion
        self.certificate: Certificate | None = None

    def convert(self) -> None:
        """Convert the grid here or on a cluster."""
        options = self.options
        with raising_interrupts(), progress_bar("upsampling", options["quiet"]) as progress:
            if options["cluster"] is not None:
                self.result = convert_on_workers(self, self.model, self.chosen, progress)
            else:
                self.result = convert(
                    self.source,
                    self.target,
                    self.network,
                    self.chosen,
                    force=options["force"],
                    progress=progress,
                    announce=self.announce,
                    save_field=options["save_field"],
                    keep=bool(options["check"] or options["report"]),
                )
        self.seconds |= self.result.seconds

    def check(self) -> None:
        """Check the finished mesh against its samples."""
        from ..certificate.check import check_files

        watch, threads = Stopwatch(), self.options["threads"]
        files = self.target, self.source, self.chosen
        try:
            self.certificate = check_files(*files, kept=self.result.kept, processes=threads)
        except SuperSdfError as error:
            raise type(error)(f"{error}; {self.target} is written, but not checked") from error
        watch.lap("check")
        self.seconds |= watch.seconds

    def write_page(self) -> None:
        """Write the page; what cannot be shown in it is said there."""
        from ..pages.html import page_of_conversion, write_page

        watch, threads = Stopwatch(), self.options["threads"]
        report = {**self.report(), "notes": [*self.result.remarks(), *self.network.notes]}
        given = self.chosen, self.result.kept, self.certificate
        text = page_of_conversion(report, *given, processes=threads)
        write_page(text, self.options["report"], force=self.options["force"])
        watch.lap("page")
        self.seconds |= watch.seconds

    def announce(self, line: str) -> None:
        """Print, before the work, what may make the user stop it; the bar is redrawn below."""
        if not self.options["quiet"]:
            print_stderr(f"\r{line}\x1b[K" if sys.stderr.isatty() else line)

    def print_report(self) -> None:
        """Print notes, warnings and a summary to stderr, and with ``--json`` JSON to stdout."""
        report, result = self.report(), self.result
        if self.options["as_json"]:
            print_stdout(json.dumps(report, indent=2), f"{self.target} is written")
        if self.options["quiet"]:
            return
        for note in (*result.notes, *result.remarks(), *self.network.notes):
            print_stderr(f"Note: {note}")
        for warning in result.warnings:
            print_stderr(f"Warning: {warning}")
        if self.options["verbose"]:
            for key in ("shape", "spacing", "origin", "device", "band_voxels", "nodes"):
                print_stderr(f"{key.replace('_', ' ')}: {report[key]}")
            for stage, seconds in self.seconds.items():
                print_stderr(f"{stage}: {seconds:.3f} s")
        print_stderr(f"{self.target}: {describe_mesh(result, sum(self.seconds.values()))}")
        if result.saved_field:
            print_stderr(f"{self.options['save_field']}: {describe_field(result.saved_field)}")
        if result.simplified:
            print_stderr(f"Simplified: {describe_simplified(result.simplified)}")
        if self.certificate:
            print_stderr(f"Check: {self.certificate.summary()}")
        if self.options["report"]:
            print_stderr(f"Report: {self.options['report']}")

    def report(self) -> dict[str, Any]:
        """Return counts, times and notes as ``--json`` prints them."""
        shown = ("factor", "offset", "mesher")
        return {
            "input": self.source,
            "output": self.target,
            **{name: getattr(self.chosen, name) for name in shown},
            **describe_network(self.model, self.network),
            **self.result.report(),
            **({"check": self.certificate.report()} if self.certificate else {}),
            "seconds": rounded(self.seconds),
        }


def upsample_labels(
    source: str, target: str, chosen: ConvertOptions, options: dict[str, Any]
) -> None:
    """Convert the labels of an image to meshes, and print what was made."""
    watch, model = Stopwatch(), chosen_model(options)
    check_options(chosen, [name for name in NOT_WITH_LABELS if options[name]])
    network, labels, force = load_chosen(options), options["labels"], options["force"]
    watch.lap("load network")
    with raising_interrupts(), progress_bar("upsampling", options["quiet"]) as progress:
        found = convert_labels(
            source, target, network, labels, chosen, force=force, progress=progress
        )
    watch.lap("convert")
    if options["as_json"]:
        report = {
            "input": source,
            "output": target,
            "factor": chosen.factor,
            **describe_network(model, network),
            **found,
            "seconds": rounded(watch.seconds),
        }
        print_stdout(json.dumps(report, indent=2), "the meshes are written")
    if options["quiet"]:
        return
    for note in (*found["inferred"], *network.notes):
        print_stderr(f"Note: {note}")
    for row in found["labels"]:
        print_stderr(
            f"{row['output']}: label {row['label']}, {row['vertices']:,} vertices, "
            f"{row['triangles']:,} triangles, closed, volume {row['volume']:.6g}"
        )
    print_stderr(f"{len(found['labels'])} labels, {sum(watch.seconds.values()):.1f} s")


def describe_network(model: str, network: Network) -> dict[str, Any]:
    """Return what ``--json`` says of the network."""
    return {
        "model": model,
        "precision": network.precision,
        "device": network.device,
        "device_notes": list(network.notes),
    }


def rounded(seconds: dict[str, float]) -> dict[str, float]:
    """Return the seconds of each stage for JSON."""
    return {stage: round(spent, 4) for stage, spent in seconds.items()}


def describe_mesh(result: Conversion, seconds: float) -> str:
    """Describe a mesh, and the time that it took, in one line."""
    counts = result.counts
    low, high = (f"({', '.join(f'{x:.6g}' for x in corner)})" for corner in result.bounds)
    closed = "closed" if result.closed else "open"
    return (
        f"{counts['vertices']:,} vertices, {counts['triangles']:,} triangles, {closed}, "
        f"from {low} to {high}, {seconds:.1f} s"
    )


def describe_field(field: dict[str, Any]) -> str:
    """Describe the file of a refined field in one line."""
    shape = " x ".join(map(str, field["shape"]))
    spacing, origin = (", ".join(f"{x:.12g}" for x in field[k]) for k in ("spacing", "origin"))
    return f"the refined field, lattice {shape}, spacing {spacing}, origin {origin}"


def describe_simplified(found: dict[str, Any]) -> str:
    """Describe in one line how much simpler a mesh is and how far from the unsimplified one."""
    off = found["deviation"]
    return (
        f"from {found['triangles_before']:,} to {found['triangles']:,} triangles; largest distance "
        f"{off['largest']:.4f} voxels from the unsimplified mesh to this one, "
        f"{off['largest_back']:.4f} back; mean {off['mean']:.4f} and {off['mean_back']:.4f}"
    )
