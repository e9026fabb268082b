"""The command ``batch``: parse, call the library, say what happened. No numerics here."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .batch_report import progress_line, tell_plan, tell_summary
from .common import CONTEXT, InterruptedCommand, one_line_errors
from .conversion import chosen_model, conversion_options, make_options
from .interrupts import raising_interrupts

if TYPE_CHECKING:
    from ..batch.job import Job
    from ..batch.plan import Batch, Settings

EXAMPLES = """\b
Examples:
  super-sdf batch grids/ --out meshes/
  super-sdf batch 'scans/**/*.npz' more.txt --out meshes/ --format stl --factor 2
"""


@click.command(
    context_settings=CONTEXT, epilog=EXAMPLES, short_help="Convert many grids, and go on later."
)
@click.argument("sources", metavar="IN...", nargs=-1, required=True)
@click.option(
    "--out",
    "folder",
    metavar="DIR",
    required=True,
    type=click.Path(path_type=Path),
    help="Where the meshes go, with report.jsonl; folders below IN are kept.",
)
@click.option(
    "--format",
    "kind",
    type=click.Choice(["ply", "stl", "obj", "off", "glb", "3mf"]),
    default="ply",
    show_default=True,
    help="Of the meshes.",
)
@conversion_options
@click.option(
    "--jobs",
    type=click.IntRange(0),
    default=0,
    help="Processes; 0: one a core, on CUDA one. They share the cores unless --threads is given.",
)
@click.option("--fail-fast", is_flag=True, help="Begin nothing more after the first failure.")
@click.option("--retry", is_flag=True, help="Try unchanged inputs again that failed before.")
@click.option("--force", is_flag=True, help="Do all again; replace meshes of another origin.")
@click.option("--dry-run", is_flag=True, help="Say what would be done; write nothing.")
@click.option("--json", "as_json", is_flag=True, help="Print the summary, or the plan, as JSON.")
@click.option("-q", "--quiet", is_flag=True, help="Print failures only.")
def batch(sources: tuple[str, ...], folder: Path, **options: Any) -> None:
    """Convert every grid that IN names to a mesh in DIR, as upsample would.

    IN are .npy and .npz files, folders of them, patterns ('**/*.npy'), and lists: .txt, a path a
    line, or .jsonl, an object a line: {"in": "a.npy", "out": "a.ply", "spacing": 0.5}, paths
    relative to the list.

    What failed is named and stops nothing. Run again, after a kill, with more inputs or other
    options, it does what is not done yet.
    """
    with one_line_errors():
        run_batch(sources, folder, options)


def run_batch(sources: tuple[str, ...], folder: Path, options: dict[str, Any]) -> None:
    """Find the inputs, do what is to be done, say what came of it."""
    from ..batch.inputs import find_jobs
    from ..batch.plan import Settings, preview
    from ..network.network import find_model
    from ..steps.nodes import check_factor

    start = time.perf_counter()
    check_factor(options["factor"])
    jobs, unread = find_jobs(sources, f".{options['kind']}", make_options(options))
    model = chosen_model(options)
    find_model(model, options["precision"])
    flags = {name: options[name] for name in ("force", "retry", "fail_fast")}
    settings = Settings(
        folder,
        model,
        precision=options["precision"],
        device=options["device"],
        threads=options["threads"],
        workers=options["jobs"],
        **flags,
    )
    if options["dry_run"]:
        plan = preview(jobs, settings)
        plan.unread = unread
        tell_plan(plan, options["as_json"])
        return
    done = complete(jobs, settings, options["quiet"])
    done.unread = unread
    done.seconds = time.perf_counter() - start
    tell_summary(done, options)
    if done.failures() or done.unread:
        sys.exit(1)


def complete(jobs: list[Job], settings: Settings, quiet: bool) -> Batch:
    """Run the batch; if interrupted, say what is kept."""
    from ..batch.lock import FolderLock
    from ..batch.run import Run

    with raising_interrupts(), FolderLock(settings.folder) as lock:
        run = Run(jobs, settings, lock)
        total = len(run.batch.waiting)
        try:
            with progress_line(total, quiet) as progress, raising_interrupts():
                run.complete(progress)
        except KeyboardInterrupt as error:
            done = f": {len(run.batch.done)} of {total} are done and kept"
            raise InterruptedCommand(f"{done}; run it again to go on", error) from None
    return run.batch
