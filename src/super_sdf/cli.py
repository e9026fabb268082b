"""The command line: parse, call the library, say what happened. No numerics here.

Only click is imported at the top, so that ``super-sdf --help`` is quick.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from . import __version__
from .cli_common import CONTEXT, one_line_errors
from .cli_evaluate import evaluate
from .cli_render import render
from .cli_sample import sample

if TYPE_CHECKING:
    from .field import FineField
    from .grid import SdfGrid
    from .mesh import Mesh
    from .network import Network

EXAMPLES = """\b
Examples:
  super-sdf upsample part.npz part.ply
  super-sdf upsample field.npy part.stl --spacing 0.5 --factor 8
"""


def parse_numbers(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | None:
    """Parse one number, or three with commas between: "0.5" or "0.5,0.5,0.5"."""
    if value is None:
        return None
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (1, 3):
        raise click.BadParameter(f"{value!r}: give one number, or three with commas between")
    return numbers


@click.group(context_settings=CONTEXT)
@click.version_option(__version__, prog_name="super-sdf")
def cli() -> None:
    """Turn coarse signed distance grids into fine meshes."""


@cli.command(
    context_settings=CONTEXT, epilog=EXAMPLES, short_help="Refine a grid and write its surface."
)
@click.argument("source", metavar="IN")
@click.argument("target", metavar="OUT")
@click.option(
    "--factor", type=int, default=4, show_default=True, help="How many times finer: 2, 4, 8 or 16."
)
@click.option(
    "--spacing",
    callback=parse_numbers,
    metavar="H",
    help="World distance between samples; from the file or the values if not given.",
)
@click.option(
    "--origin",
    callback=parse_numbers,
    metavar="X,Y,Z",
    help="World position of sample (0, 0, 0); from the file, else 0.",
)
@click.option(
    "--inside",
    type=click.Choice(["negative", "positive", "auto"]),
    default="auto",
    show_default=True,
    help="The sign of values inside; auto takes the grid's border for outside.",
)
@click.option(
    "--offset",
    type=float,
    default=0.0,
    show_default=True,
    metavar="D",
    help="Mesh the surface at distance D (world units, positive outwards).",
)
@click.option("--cap", is_flag=True, help="Close a surface that runs out of the grid.")
@click.option(
    "--quality",
    type=click.Choice(["fast", "base", "best"]),
    default="base",
    show_default=True,
    help="The network: fast is small, best asks base eight times.",
)
@click.option(
    "--precision",
    type=click.Choice(["float32", "int8"]),
    default="float32",
    show_default=True,
    help="Of the network: int8 is quicker on the CPU, and a little less exact.",
)
@click.option("--model", metavar="FILE", help="Another network, an ONNX file, in place of these.")
@click.option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda"]),
    default="auto",
    show_default=True,
    help="Where the network runs; auto takes CUDA where it can.",
)
@click.option("--threads", type=click.IntRange(0), default=0, help="CPU threads; 0: one a core.")
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
        self.clock = time.perf_counter()
        self.grid: SdfGrid
        self.network: Network
        self.field: FineField
        self.mesh: Mesh
        self.warnings: list[str] = []

    def lap(self, stage: str) -> None:
        """Book the time since the last lap under a stage."""
        now = time.perf_counter()
        self.seconds[stage], self.clock = now - self.clock, now

    def work(self) -> None:
        """Read, refine, mesh and write."""
        from .field import border_is_crossed
        from .io import check_target, read_grid, write_mesh
        from .network import load_network
        from .nodes import check_factor
        from .pipeline import STEPS, mesh_field, upsample

        asked = self.options
        check_factor(asked["factor"])
        check_target(self.target, force=asked["force"])
        self.lap("start")
        self.grid = read_grid(
            self.source,
            spacing=asked["spacing"],
            origin=asked["origin"],
            inside=asked["inside"],
            level=asked["offset"],
        )
        self.lap("read")
        self.network = load_network(
            asked["model"] or asked["quality"],
            device=asked["device"],
            threads=asked["threads"],
            precision=asked["precision"],
        )
        self.lap("load network")
        with self.progress_bar() as advance:

            def tell(done: int, total: int) -> None:
                self.lap(STEPS[done - 1])
                advance(1)

            self.field = upsample(
                self.grid, self.network, asked["factor"], offset=asked["offset"], progress=tell
            )
            self.find_warnings(border_is_crossed(self.field))
            self.mesh = mesh_field(self.field, self.grid, offset=asked["offset"], cap=asked["cap"])
            tell(len(STEPS), len(STEPS))
        write_mesh(self.mesh, self.target, force=asked["force"])
        self.lap("write")

    @contextmanager
    def progress_bar(self) -> Iterator[Any]:
        """Draw a bar on stderr if somebody is there to see it."""
        from .pipeline import STEPS

        if self.options["quiet"] or not sys.stderr.isatty():
            yield lambda steps: None
            return
        with click.progressbar(length=len(STEPS), label="upsampling", file=sys.stderr) as bar:
            yield bar.update

    def find_warnings(self, crossed: bool) -> None:
        """Note what a user should know of the result."""
        if crossed and not self.options["cap"]:
            self.warnings.append(
                "the surface runs out of the grid and is open there (close it with --cap)"
            )
        if self.field.noisy_voxels:
            share = 100 * self.field.noisy_voxels / self.field.band_voxels
            self.warnings.append(
                f"in {share:.2g} % of the band the values differ by more than distances can: they "
                "are taken for noisy there, and corrected"
            )
        if self.field.pinned:
            self.warnings.append(
                f"{self.field.pinned} fine values contradict the coarse ones around them and were "
                "given their sign: the input is no distance field there"
            )

    def report(self) -> dict[str, Any]:
        """Return counts, times and findings."""
        return {
            "input": self.source,
            "output": self.target,
            "shape": list(self.grid.shape),
            "spacing": list(self.grid.spacing),
            "origin": list(self.grid.origin),
            "factor": self.field.factor,
            "offset": self.options["offset"],
            "inferred": list(self.grid.notes),
            "warnings": self.warnings,
            "model": self.options["model"] or self.options["quality"],
            "precision": self.options["precision"],
            "device": self.network.device,
            "band_voxels": self.field.band_voxels,
            "noisy_voxels": self.field.noisy_voxels,
            "decoded_voxels": len(self.field.voxel_ijk),
            "nodes": len(self.field.values),
            "vertices": len(self.mesh.vertices),
            "triangles": len(self.mesh.faces),
            "pinned_nodes": self.field.pinned,
            "seconds": {stage: round(spent, 4) for stage, spent in self.seconds.items()},
        }

    def tell(self) -> None:
        """Print the findings: sentences on stderr, JSON on stdout."""
        report = self.report()
        if self.options["as_json"]:
            click.echo(json.dumps(report, indent=2))
        if self.options["quiet"]:
            return
        for note in self.grid.notes:
            click.echo(f"Note: {note}", err=True)
        for warning in self.warnings:
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


@cli.command(context_settings=CONTEXT, short_help="Show versions, devices and networks.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def info(as_json: bool) -> None:
    """Show versions, devices, and the shipped networks with their cards."""
    import platform

    import onnxruntime

    from .network import available_devices, load_network, shipped_models

    with one_line_errors():
        facts = {
            "super-sdf": __version__,
            "python": platform.python_version(),
            "onnxruntime": onnxruntime.__version__,
            "devices": available_devices(),
            "models": {
                name: dict(load_network(name, device="cpu").card) for name in shipped_models()
            },
        }
    if as_json:
        click.echo(json.dumps(facts, indent=2))
        return
    for key in ("super-sdf", "python", "onnxruntime"):
        click.echo(f"{key} {facts[key]}")
    click.echo(f"devices: {', '.join(facts['devices'])}")
    for name, card in facts["models"].items():
        click.echo(f"model {name}")
        for key, value in sorted(card.items()):
            click.echo(f"  {key.replace('_', ' ')}: {value}")


for command in (sample, evaluate, render):
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
