"""The command ``batch``: many grid files to mesh files."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import SuperSdfError, WriteError
from ..files.formats import NAMED, list_formats
from ..machine.extras import check_modules
from ..options import MESH_FORMATS
from .batch_report import (made_again_lines, print_plan, print_summary, progress_line, sentence, summary)
from .common import (CONTEXT, GroupedCommand, InterruptedCommand, check_can_check, check_cluster, check_names, check_option, check_page, chosen_model, cluster_option, conversion_options, labels_option, make_options, names_option, one_line_errors, print_stderr, report_option)
from .interrupts import describe_interrupt, exit_code, raising_interrupts

if TYPE_CHECKING:
    from ..batch.job import Job, Settings
    from ..batch.run import Batch

HELP = f"""Convert many grids to meshes in the folder DIR, each as upsample would.

Each IN is a grid file, a folder (searched with its subfolders), a pattern such as '**/*.npy', or a
list of inputs: .txt with one path per line, or .jsonl with one object per line such as
{{"in": "a.npy", "out": "a.ply", "spacing": 0.5}}. Paths are relative to the list.

Grid files are {list_formats()}. FILE:NAME names one of several arrays in a {NAMED} file.

A file that fails is reported and does not stop the others. Run the command again to resume
after an interruption, or with more inputs or other options: only what is missing is done.
"""
EXAMPLES = """\b
Examples:
  super-sdf batch grids/ --out meshes/
  super-sdf batch 'scans/**/*.npz' more.txt --out meshes/ --format stl --factor 2
  super-sdf batch cases/ --out meshes/ --format stl --labels all --names organs.ctbl
"""


@click.command(
    "batch",
    cls=GroupedCommand,
    context_settings=CONTEXT,
    epilog=EXAMPLES,
    short_help="Convert many grids; can be stopped and resumed.",
    help=HELP,
)
@click.argument("sources", metavar="IN...", nargs=-1, required=True)
@click.option(
    "--out",
    "folder",
    metavar="DIR",
    required=True,
    type=click.Path(path_type=Path),
    help="Folder for the meshes and report.jsonl; subfolders of IN are kept.",
)
@click.option(
    "--format",
    "kind",
    type=click.Choice(MESH_FORMATS),
    default=MESH_FORMATS[0],
    show_default=True,
    help="Mesh file format.",
)
@conversion_options
@labels_option
@names_option
@check_option
@report_option
@click.option(
    "--jobs",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Worker processes; 0 means one per core, or a single one on CUDA. They share the cores "
    "unless --threads is given.",
)
@cluster_option
@click.option("--fail-fast", is_flag=True, help="Start no further file after the first failure.")
@click.option("--retry", is_flag=True, help="Retry inputs that failed before and have not changed.")
@click.option(
    "--force",
    is_flag=True,
    help="Convert everything again; replace files that are not as a batch wrote them.",
)
@click.option("--dry-run", is_flag=True, help="Show what would be done; write nothing.")
@click.option("--json", "as_json", is_flag=True, help="Print the summary, or the plan, as JSON.")
@click.option("-q", "--quiet", is_flag=True, help="Print failures only.")
def batch_command(sources: tuple[str, ...], folder: Path, **options: Any) -> None:
    """Convert many grids to meshes."""
    with one_line_errors():
        run_batch(sources, folder, options)


def run_batch(sources: tuple[str, ...], folder: Path, options: dict[str, Any]) -> None:
    """Find the inputs, convert what is not done yet, print a summary."""
    start, page = time.perf_counter(), options["report"]
    chosen, suffix = make_options(options), f".{options['kind']}"
    from ..batch.inputs import find_jobs
    from ..batch.job import Settings
    from ..batch.run import Batch
    from ..labels.files import check_options
    from ..labels.names import read_names
    from ..network.network import find_model

    if options["check"]:
        check_can_check()
    check_cluster(options)
    names = read_names(options["names"]) if options["names"] else None
    jobs, unread = find_jobs(sources, suffix, chosen, names)
    of_labels = [job.options for job in jobs if job.options.labels is not None]
    check_names(options["names"], of_labels or None)
    for each in of_labels:
        check_options(each, [name for name in ("check", "report") if options[name]])
    if any(job.options.goals() for job in jobs):  # a list may say so
        check_modules("simplify", "simplify")
    items = check_batch_page(page, jobs, folder, force=options["force"]) if page else None
    model = chosen_model(options)
    find_model(model, options["precision"])
    taken = "precision", "device", "threads", "cluster", "force", "retry", "fail_fast", "check"
    settings = Settings(
        folder,
        model,
        workers=options["jobs"],
        items=items,
        names=names,
        **{name: options[name] for name in taken},
    )
    if options["dry_run"]:
        print_plan(Batch(jobs, settings, unread), options["as_json"])
        return
    done = complete(jobs, settings, options, unread)
    done.seconds = time.perf_counter() - start
    print_summary(done, options)
    if done.failures() or done.unread:
        sys.exit(1)


def check_batch_page(page: Path, jobs: list[Job], folder: Path, *, force: bool) -> Path:
    """Return the folder beside a page for its meshes; raise if one of them cannot be written.

    A page that super-sdf wrote may be replaced, so that a batch can be resumed.
    """
    check_modules("--report", "report")
    from ..files.regular import files_of
    from ..pages.html import is_page
    from ..pages.items import items_folder

    files = (path for job in jobs for path in (*files_of(job.source), folder / job.target))
    check_page("--report", page, files, force=force or is_page(page))
    beside = items_folder(page)
    if beside.exists() and not beside.is_dir():
        raise WriteError(f"{beside}, for the meshes of the page, is no folder: move it")
    return beside


def complete(
    jobs: list[Job], settings: Settings, options: dict[str, Any], unread: list[tuple[str, str]]
) -> Batch:
    """Run the batch and write its page; an interrupt reports how many files are done."""
    from ..batch.record import folder_lock
    from ..batch.run import Batch

    with raising_interrupts(), folder_lock(settings.folder):
        batch = Batch(jobs, settings, unread)
        for line in () if options["quiet"] else made_again_lines(batch):
            print_stderr(line)
        total = len(batch.waiting)
        try:
            with progress_line(total, options["quiet"]) as progress, raising_interrupts():
                batch.run(progress)
            write_page(batch, options["report"])
        except KeyboardInterrupt as error:
            try:
                write_page(batch, options["report"], describe_interrupt(exit_code(error)))
            except SuperSdfError as fault:
                print_stderr(f"Warning: {fault}")
            kept = f": {len(batch.done)} of {total} are done and kept; run it again to go on"
            raise InterruptedCommand(kept, error, summary(batch)) from None
    return batch


def write_page(batch: Batch, path: Path | None, interrupted: str = "") -> None:
    """Write the page, if one was asked for; after an interrupt, at once and without drawing."""
    if path is None:
        return
    from ..batch.page import BatchPage
    from ..pages.html import is_page

    page = BatchPage(path, batch)
    alert = ""
    if page.unfinished or interrupted:
        why = f", {interrupted}" if interrupted else ""
        alert = f"Incomplete{why}: {len(page.unfinished)} not finished; run it again to go on"
    title, force = f"Batch: {batch.settings.folder}", batch.settings.force or is_page(path)
    page.write(title, sentence(batch), alert, force=force, draw=not interrupted)
