"""The command line: parse, call the library, say what happened. No numerics here.

Only click is imported at the top, so that ``super-sdf --help`` is quick.
"""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any

import click

from . import __version__
from .cli_batch import batch
from .cli_common import CONTEXT, one_line_errors, progress_bar
from .cli_conversion import conversion_options, make_options
from .cli_evaluate import evaluate
from .cli_info import info
from .cli_render import render
from .cli_sample import sample

if TYPE_CHECKING:
    from .convert import Conversion
    from .network import Network

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
        self.seconds: dict[str, float] = {}
        self.network: Network
        self.done: Conversion

    def work(self) -> None:
        """Check what is asked, load the network, convert."""
        from .convert import convert
        from .files.meshes import check_target
        from .network import load_network
        from .nodes import check_factor
        from .progress import Stopwatch

        asked, watch = self.options, Stopwatch()
        check_factor(asked["factor"])
        check_target(self.target, force=asked["force"])
        watch.lap("start")
        self.network = load_network(
            asked["model"] or asked["quality"],
            device=asked["device"],
            threads=asked["threads"],
            precision=asked["precision"],
        )
        watch.lap("load network")
        with progress_bar("upsampling", asked["quiet"]) as progress:
            self.done = convert(
                self.source,
                self.target,
                self.network,
                make_options(asked),
                force=asked["force"],
                progress=progress,
            )
        self.seconds = watch.seconds | self.done.seconds

    def device_notes(self) -> list[str]:
        """Return what to know of where the network and compiled functions run."""
        from .compiling import why_not

        return [*self.network.notes, *why_not()]

    def report(self) -> dict[str, Any]:
        """Return counts, times and findings."""
        return {
            "input": self.source,
            "output": self.target,
            "factor": self.options["factor"],
            "offset": self.options["offset"],
            "model": self.options["model"] or self.options["quality"],
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
            click.echo(json.dumps(report, indent=2))
        if self.options["quiet"]:
            return
        for note in (*self.done.notes, *self.device_notes()):
            click.echo(f"Note: {note}", err=True)
        for warning in self.done.warnings:
            click.echo(f"Warning: {warning}", err=True)
        if self.options["verbose"]:
            for key in ("shape", "spacing", "origin", "device", "band_voxels", "nodes"):
                click.echo(f"{key.replace('_', ' ')}: {report[key]}", err=True)
            for stage, spent in self.seconds.items():
                click.echo(f"{stage}: {spent:.3f} s", err=True)
        total = sum(self.seconds.values())
        click.echo(
            f"{self.target}: {report['vertices']:,} vertices, {report['triangles']:,} triangles, "
            f"{total:.1f} s",
            err=True,
        )


for command in (batch, sample, evaluate, render, info):
    cli.add_command(command)


def main() -> None:
    """Run the command line; an interrupt ends it with one line, too."""
    try:
        cli.main(standalone_mode=False)
    except click.UsageError as error:
        click.echo(f"Error: {error.format_message()}", err=True)
        sys.exit(error.exit_code)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        click.echo("Error: interrupted; nothing was written", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
