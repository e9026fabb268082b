"""The command line: parse, call the library, say what happened. No numerics here.

Only click is imported at the top, so that ``super-sdf --help`` is quick.
"""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any

import click

from .. import __version__
from .batch import batch
from .common import CONTEXT, InterruptedCommand, one_line_errors, print_result, progress_bar, tell
from .conversion import chosen_model, conversion_options, make_options
from .evaluate import evaluate
from .info import info
from .interrupts import ending_at_once, raising_interrupts
from .render import render
from .sample import sample
from .streams import settle_streams

if TYPE_CHECKING:
    from ..convert import Conversion
    from ..network.network import Network

EXAMPLES = """\b
Examples:
  super-sdf upsample part.npz part.ply
  super-sdf upsample field.npy part.stl --spacing 0.5 --factor 8
"""


@click.group(context_settings=CONTEXT)
@click.version_option(__version__, prog_name="super-sdf")
def cli() -> None:
    """Turn coarse signed distance grids into fine meshes."""


@cli.command(
    context_settings=CONTEXT, epilog=EXAMPLES, short_help="Refine a grid and write its surface."
)
@click.argument("source", metavar="IN")
@click.argument("target", metavar="OUT")
@conversion_options
@click.option("--force", is_flag=True, help="Replace OUT if it exists.")
@click.option("--json", "as_json", is_flag=True, help="Print counts, times and findings as JSON.")
@click.option("-q", "--quiet", is_flag=True, help="Print errors only.")
@click.option("-v", "--verbose", is_flag=True, help="Print counts and stage times too.")
def upsample(source: str, target: str, **options: Any) -> None:
    """Refine the signed distance grid IN and write its surface as the mesh OUT.

    IN is .npy (a 3D array: x, y, z) or .npz (keys values, spacing, origin). OUT is .ply, .stl,
    .obj, .off, .glb or .3mf.
    """
    with one_line_errors():
        run = Upsampling(source, target, options)
        run.work()
        run.tell()


class Upsampling:
    """One run of the command: what was asked, what came of it, and how long each stage took."""

    def __init__(self, source: str, target: str, options: dict[str, Any]) -> None:
        self.source, self.target, self.options = source, target, options
        self.model = chosen_model(options)
        self.seconds: dict[str, float] = {}
        self.network: Network
        self.done: Conversion

    def work(self) -> None:
        """Check what is asked, load the network, convert."""
        from ..convert import convert
        from ..files.meshes import check_target
        from ..network.network import load_network
        from ..progress import Stopwatch
        from ..steps.nodes import check_factor

        asked, watch = self.options, Stopwatch()
        check_factor(asked["factor"])
        check_target(self.target, force=asked["force"])
        watch.lap("start")
        self.network = load_network(
            self.model,
            device=asked["device"],
            threads=asked["threads"],
            precision=asked["precision"],
        )
        watch.lap("load network")
        with raising_interrupts(), progress_bar("upsampling", asked["quiet"]) as progress:
            self.done = convert(
                self.source,
                self.target,
                self.network,
                make_options(asked),
                force=asked["force"],
                progress=progress,
                announce=self.announce,
            )
        self.seconds = watch.seconds | self.done.seconds

    def device_notes(self) -> list[str]:
        """Return what to know of where the network runs."""
        return list(self.network.notes)

    def report(self) -> dict[str, Any]:
        """Return counts, times and findings."""
        return {
            "input": self.source,
            "output": self.target,
            "factor": self.options["factor"],
            "offset": self.options["offset"],
            "model": self.model,
            "precision": self.options["precision"],
            "device": self.network.device,
            "device_notes": self.device_notes(),
            **self.done.report(),
            "seconds": {stage: round(spent, 4) for stage, spent in self.seconds.items()},
        }

    def tell(self) -> None:
        """Print the findings: sentences on stderr, JSON on stdout."""
        report = self.report()
        if self.options["as_json"]:
            print_result(json.dumps(report, indent=2), f"{self.target} is written")
        if self.options["quiet"]:
            return
        for note in (*self.done.notes, *self.device_notes()):
            tell(f"Note: {note}")
        for warning in self.done.warnings:
            tell(f"Warning: {warning}")
        if self.options["verbose"]:
            for key in ("shape", "spacing", "origin", "device", "band_voxels", "nodes"):
                tell(f"{key.replace('_', ' ')}: {report[key]}")
            for stage, spent in self.seconds.items():
                tell(f"{stage}: {spent:.3f} s")
        tell(f"{self.target}: {self.summary()}")

    def summary(self) -> str:
        """Return the mesh in a line."""
        counts = self.done.counts
        low, high = (
            "(" + ", ".join(f"{x:.6g}" for x in corner) + ")" for corner in self.done.bounds
        )
        return (
            f"{counts['vertices']:,} vertices, {counts['triangles']:,} triangles, "
            f"{'closed' if self.done.closed else 'open'}, from {low} to {high}, "
            f"{sum(self.seconds.values()):.1f} s"
        )

    def announce(self, line: str) -> None:
        """Say before the work what a user may want to stop; the bar is drawn anew below."""
        if not self.options["quiet"]:
            tell(f"\r{line}\x1b[K" if sys.stderr.isatty() else line)


for command in (batch, sample, evaluate, render, info):
    cli.add_command(command)


def main() -> None:
    """Run the command line; whatever ends it is told in one line."""
    with ending_at_once():
        try:
            code = run()
        finally:
            settle_streams()
    if code:
        sys.exit(code)


def run() -> int:
    """Run a command; return the exit code."""
    try:
        cli.main(standalone_mode=False)
    except click.ClickException as error:
        tell(f"Error: {error.format_message()}")
        return error.exit_code
    except InterruptedCommand as error:
        tell(f"Error: {error}")
        return error.exit_code
    except click.Abort:  # outside of a command's work
        tell("Error: interrupted; nothing was written")
        return 130
    except OSError as error:  # outside of a command's work: help
        tell(f"Error: stdout cannot be written: {error.strerror or error}")
        return 1
    return 0


if __name__ == "__main__":
    main()
