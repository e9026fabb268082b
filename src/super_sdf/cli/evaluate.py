"""The command ``evaluate``: parse, call the library, say what happened. No numerics here."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from ..evaluation.names import EXPERIMENTS, METHOD_LABELS, PEER_LABELS
from ..machine.extras import check_modules
from .common import CONTEXT, InterruptedCommand, one_line_errors, print_result, tell
from .interrupts import raising_interrupts

EXAMPLES = """\b
Examples:
  super-sdf evaluate meshes/ --out report/
  super-sdf evaluate meshes/ --sizes 32 64 --experiments noise factors --out report/
  super-sdf evaluate a.ply b.ply --sizes 32 --peers rfta --out report/
"""
# Options that the plan takes as they are; of a list, each entry once.
NUMBERS = ("factor", "model", "experiment_shapes", "peer_shapes", "peer_size", "peer_limit")
LISTS = ("sizes", "experiments", "peers")


class ListCommand(click.Command):
    """A command whose repeatable options take several values: ``--sizes 32 64 128``.

    An option's values end at the first word that is not one of them.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Write each further value of such an option as the option itself once more."""
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
            if current and follows and takes(current, word, ctx):
                spelt += [current.opts[0]]
            elif not (spelt and spelt[-1] in lists):
                current = lists.get(word)
            spelt.append(word)
        return super().parse_args(ctx, spelt)


def takes(option: click.Option, word: str, ctx: click.Context) -> bool:
    """Say whether a word is a value of an option."""
    try:
        option.type.convert(word, option, ctx)
    except click.UsageError:
        return False
    return True


@click.command(
    cls=ListCommand,
    context_settings=CONTEXT,
    epilog=EXAMPLES,
    short_help="Measure quality on your own meshes.",
)
@click.argument(
    "sources", metavar="MESHES...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the report.")
@click.option(
    "--sizes",
    multiple=True,
    type=int,
    default=(32, 64, 128),
    show_default="32 64 128",
    metavar="N...",
    help="Samples along each axis.",
)
@click.option("--factor", type=int, default=4, show_default=True, help="How many times finer.")
@click.option(
    "--methods",
    multiple=True,
    type=click.Choice(tuple(METHOD_LABELS)),
    metavar="NAME...",
    help=f"Of {', '.join(METHOD_LABELS)}; all unless given.",
)
@click.option(
    "--experiments",
    multiple=True,
    type=click.Choice(EXPERIMENTS),
    metavar="NAME...",
    help=f"The paper's, beside what it printed: {', '.join(EXPERIMENTS)}.",
)
@click.option(
    "--experiment-shapes",
    type=click.IntRange(1),
    default=10,
    show_default=True,
    help="Shapes that the experiments take, spread over the list.",
)
@click.option(
    "--peers",
    multiple=True,
    type=click.Choice(tuple(PEER_LABELS)),
    metavar="NAME...",
    help=f"Other methods: {', '.join(PEER_LABELS)}. Minutes a shape; wants the extra peers.",
)
@click.option(
    "--peer-shapes", type=click.IntRange(1), default=5, show_default=True, help="Shapes for them."
)
@click.option("--peer-size", type=int, default=32, show_default=True, help="Size for them.")
@click.option(
    "--peer-limit",
    type=float,
    default=900,
    show_default=True,
    metavar="SECONDS",
    help="Time for each of them on each shape.",
)
@click.option("--limit", type=click.IntRange(1), help="Take so many meshes, spread over the list.")
@click.option(
    "--model", default="base", show_default=True, help="fast, base, best, or an ONNX file."
)
@click.option("--jobs", type=click.IntRange(1), help="Processes, one a core at most.")
@click.option(
    "--up",
    type=click.Choice(["x", "y", "z"]),
    default="z",
    show_default=True,
    help="The axis that points up in pictures.",
)
@click.option("--no-pictures", is_flag=True, help="Leave out the best and worst shapes.")
@click.option("-q", "--quiet", is_flag=True, help="Print errors only.")
def evaluate(sources: tuple[Path, ...], **options: Any) -> None:
    """Measure super-sdf, its baselines and its bound on closed reference meshes.

    MESHES are files or folders. Each is scaled to a box diagonal of 1 and sampled at every size;
    what each method makes of the samples is compared with the mesh itself. Killed and started
    again, it goes on where it was. OUT/report.md has the tables, plots and pictures; OUT is a new
    folder, an empty one, or that of an earlier evaluation.
    """
    with one_line_errors():
        check_modules("evaluate", "eval")
        with raising_interrupts():  # there are processes to end, and results to keep
            left_out = run_evaluate(sources, options)
    if left_out:
        sys.exit(1)


def run_evaluate(sources: tuple[Path, ...], options: dict[str, Any]) -> bool:
    """Plan, measure, report; say which shapes were left out, and return whether any was."""
    from ..evaluation.evaluate import evaluate
    from ..evaluation.scope import Scope, find_meshes, spread
    from ..machine.threads import count_cores

    if options["peers"]:
        check_modules("--peers", "peers")
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
    with interrupts_explained(options["out"]):
        outcome = evaluate(
            scope,
            options["out"],
            up=options["up"],
            pictures=not options["no_pictures"],
            on_task=None if options["quiet"] else progress_lines(),
        )
    for entry in outcome.left_out:
        tell(f"Left out: {entry.shape}: {entry.reason}")
    if not options["quiet"]:
        print_result(outcome.report.read_text(encoding="utf-8"), f"{outcome.report} is written")
        tell(f"{outcome.report}")
    return bool(outcome.left_out)


@contextmanager
def interrupts_explained(out: Path) -> Iterator[None]:
    """Say of an interrupt what is kept, if anything is."""
    from ..evaluation.folder import ROWS

    rows = out / ROWS
    try:
        yield
    except KeyboardInterrupt as interrupt:
        if not rows.exists():
            raise
        kept = f": what was measured is kept in {rows}; the same command goes on from there"
        raise InterruptedCommand(kept, interrupt) from None


def progress_lines() -> Callable[[int, int, str, float], None]:
    """Return a function that prints a line a task, with the time that the rest will take."""
    start = time.monotonic()

    def show(done: int, total: int, what: str, share: float) -> None:
        spent = time.monotonic() - start
        left = spent / share * (1 - share)
        tell(f"{done} of {total}: {what}, {spent:.0f} s, {left:.0f} s left")

    return show
