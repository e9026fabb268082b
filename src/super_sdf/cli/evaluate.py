"""The command ``evaluate``: quality against reference meshes and other methods."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from ..evaluation.names import EXPERIMENTS, FIELD_GROUPS, METHOD_LABELS, PEER_LABELS
from ..machine.extras import check_modules
from ..options import DEFAULT_QUALITY, ConvertOptions
from ..pictures.choices import AXES
from .common import CONTEXT, InterruptedCommand, one_line_errors, print_stderr, print_stdout
from .conversion import table_options
from .interrupts import raising_interrupts

EXAMPLES = """\b
Examples:
  super-sdf evaluate meshes/ --out report/
  super-sdf evaluate meshes/ --sizes 32 64 --experiments noise factors --out report/
  super-sdf evaluate meshes/ --sizes 32 --experiments fields --kinds mask --out report/
  super-sdf evaluate a.ply b.ply --sizes 32 --peers rfta --out report/
"""
# Options that the plan takes as they are, and lists, from which repeated entries are dropped.
NUMBERS = (
    "factor",
    "model",
    "precision",
    "experiment_shapes",
    "peer_shapes",
    "peer_size",
    "peer_limit",
    "turned",
    "peer_meshes",
)
LISTS = ("sizes", "experiments", "kinds", "peers")


class ListCommand(click.Command):
    """A command whose repeatable options take several values: ``--sizes 32 64 128``.

    The values of such an option end at the first word that is not a valid value.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Repeat the option before each of its further values, as click expects it."""
        lists = {
            name: param
            for param in self.params
            if isinstance(param, click.Option) and param.multiple
            for name in param.opts
        }
        spelt: list[str] = []
        current: click.Option | None = None
        for word in args:
            follows = len(spelt) > 1 and spelt[-2] in lists
            if current and follows and accepts(current, word, ctx):
                spelt += [current.opts[0]]
            elif not (spelt and spelt[-1] in lists):
                current = lists.get(word)
            spelt.append(word)
        return super().parse_args(ctx, spelt)


def accepts(option: click.Option, word: str, ctx: click.Context) -> bool:
    """Return whether a word is a valid value of an option."""
    try:
        option.type.convert(word, option, ctx)
    except click.UsageError:
        return False
    return True


@click.command(
    "evaluate",
    cls=ListCommand,
    context_settings=CONTEXT,
    epilog=EXAMPLES,
    short_help="Measure the quality on your own meshes.",
)
@click.argument(
    "sources", metavar="MESHES...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="Folder for the report."
)
@click.option(
    "--sizes",
    multiple=True,
    type=int,
    default=(32, 64, 128),
    show_default="32 64 128",
    metavar="N...",
    help="Grid sizes: samples along each axis.",
)
@click.option(
    "--factor",
    type=int,
    default=ConvertOptions.factor,
    show_default=True,
    help="Refinement per axis.",
)
@click.option(
    "--methods",
    multiple=True,
    type=click.Choice(tuple(METHOD_LABELS)),
    metavar="NAME...",
    help=f"Methods to compare: {', '.join(METHOD_LABELS)}. Default: all.",
)
@click.option(
    "--experiments",
    multiple=True,
    type=click.Choice(EXPERIMENTS),
    metavar="NAME...",
    help=f"Experiments, those of the paper beside its results: {', '.join(EXPERIMENTS)}.",
)
@click.option(
    "--experiment-shapes",
    type=click.IntRange(1),
    default=10,
    show_default=True,
    help="Number of shapes for the experiments, spread over the list.",
)
@click.option(
    "--kinds",
    multiple=True,
    type=click.Choice(FIELD_GROUPS),
    default=FIELD_GROUPS,
    show_default="all",
    metavar="NAME...",
    help=f"Kinds of grids that the experiment 'fields' makes from the exact samples: "
    f"{', '.join(FIELD_GROUPS)}.",
)
@click.option(
    "--peers",
    multiple=True,
    type=click.Choice(tuple(PEER_LABELS)),
    metavar="NAME...",
    help=f"Published methods to run as well: {', '.join(PEER_LABELS)}. They take minutes per "
    "shape and need the extra 'peers'.",
)
@click.option(
    "--peer-shapes",
    type=click.IntRange(1),
    default=6,
    show_default=True,
    help="Number of shapes for the peers.",
)
@click.option(
    "--peer-size", type=int, default=32, show_default=True, help="Grid size for the peers."
)
@click.option(
    "--peer-limit",
    type=float,
    default=900,
    show_default=True,
    metavar="SECONDS",
    help="Time limit for each peer on each shape.",
)
@click.option(
    "--peer-meshes",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Keep the meshes of the peers in FOLDER, and take them from there instead of running a "
    "peer on the same samples again.",
)
@click.option(
    "--limit", type=click.IntRange(1), help="Use only this many meshes, spread over the list."
)
@click.option(
    "--turned",
    type=int,
    metavar="SEED",
    help="Turn every mesh at random first: parts along the axes flatter every method on a lattice.",
)
@click.option(
    "--model",
    default=DEFAULT_QUALITY,
    show_default=True,
    help="Shipped network (fast, base or best) or an ONNX file.",
)
@table_options("precision")
@click.option(
    "--jobs", type=click.IntRange(1), help="Worker processes. Default and maximum: one per core."
)
@click.option(
    "--up",
    type=click.Choice(AXES),
    default="z",
    show_default=True,
    help="Axis that points up in pictures.",
)
@click.option("--no-pictures", is_flag=True, help="Do not draw the best and worst shapes.")
@click.option("-q", "--quiet", is_flag=True, help="Print errors only.")
def evaluate_command(sources: tuple[Path, ...], **options: Any) -> None:
    """Measure super-sdf, its baselines and its upper bound on closed reference meshes.

    MESHES are mesh files or folders of them. Each mesh is scaled to a box diagonal of 1 and sampled
    at every size; the surface that a method reconstructs from the samples is compared with the
    mesh. OUT/report.md has the tables, plots and pictures. OUT is a new or empty folder, or that
    of an earlier evaluation, which is resumed.
    """
    with one_line_errors():
        check_modules("evaluate", "eval")
        with raising_interrupts():  # to end worker processes and keep results
            is_complete = run_evaluate(sources, options)
    if not is_complete:
        sys.exit(1)


def run_evaluate(sources: tuple[Path, ...], options: dict[str, Any]) -> bool:
    """Plan, measure, report; return whether every shape was measured."""
    from ..evaluation.evaluate import evaluate
    from ..evaluation.scope import Scope, find_meshes, spread
    from ..machine.threads import count_cores

    if options["peers"]:
        check_modules("--peers", "peers")
    if "meshers" in options["experiments"] or options["peers"]:
        check_modules("--peers" if options["peers"] else "--experiments meshers", "simplify")
    paths = find_meshes(sources)
    jobs = min(options["jobs"] or count_cores(), count_cores())
    once: dict[str, Any] = {name: tuple(dict.fromkeys(options[name])) for name in LISTS}
    scope = Scope(
        spread(paths, options["limit"] or len(paths)),
        methods=tuple(n for n in METHOD_LABELS if n in (options["methods"] or METHOD_LABELS)),
        jobs=jobs,
        threads=max(1, count_cores() // jobs),
        **{name: options[name] for name in NUMBERS},
        **once,
    )
    with describing_interrupts(options["out"]):
        outcome = evaluate(
            scope,
            options["out"],
            up=options["up"],
            pictures=not options["no_pictures"],
            on_task=None if options["quiet"] else progress_lines(),
        )
    for entry in outcome.left_out:
        print_stderr(f"Left out: {entry.shape}: {entry.reason}")
    if not options["quiet"]:
        print_stdout(outcome.report.read_text(encoding="utf-8"), f"{outcome.report} is written")
        print_stderr(f"{outcome.report}")
    return not outcome.left_out


@contextmanager
def describing_interrupts(out: Path) -> Iterator[None]:
    """Let an interrupt's message name the results that are kept, if there are any."""
    from ..evaluation.folder import ROWS

    rows = out / ROWS
    try:
        yield
    except KeyboardInterrupt as interrupt:
        if not rows.exists():
            raise
        kept = f": results so far are kept in {rows}; run the same command again to resume"
        raise InterruptedCommand(kept, interrupt) from None


def progress_lines() -> Callable[[int, int, str, float], None]:
    """Return a function that prints one line per task, with the remaining time."""
    start = time.monotonic()

    def show(done: int, total: int, what: str, share: float) -> None:
        spent = time.monotonic() - start
        left = spent / share * (1 - share)
        print_stderr(f"{done} of {total}: {what}, {spent:.0f} s, {left:.0f} s left")

    return show
