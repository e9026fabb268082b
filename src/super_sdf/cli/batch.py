"""The command ``batch``: many grid files to mesh files."""

from __future__ import annotations

import json
import os
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import OptionError, SuperSdfError, WriteError, check_modules
from ..files.formats import NAMED, list_formats
from ..options import MESH_FORMATS, OPTIONS, WORK
from . import common
from .common import option, print_stderr, print_stdout

if TYPE_CHECKING:
    from ..batch.job import Job
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
MOST_FAILURES = 20  # printed; the report has all

# fmt: off
TAKES = (
    click.argument("sources", metavar="IN...", nargs=-1, required=True),
    option("--out", "folder", metavar="DIR", required=True, type=common.FILE,
        help="Folder for the meshes and report.jsonl; subfolders of IN are kept."),
    option("--format", "kind", type=click.Choice(MESH_FORMATS), default=MESH_FORMATS[0],
        show_default=True, help="Mesh file format."),
    common.table_options(*OPTIONS),
    common.shared("names", "cluster", "jobs"),
    option("--fail-fast", is_flag=True, group=WORK,
        help="Start no further file after the first failure."),
    option("--retry", is_flag=True, group=WORK,
        help="Retry inputs that failed before and have not changed."),
    option("--dry-run", is_flag=True, group=WORK, help="Show what would be done; write nothing."),
    common.shared("check", "report"),
    option("--force", is_flag=True,
        help="Convert everything again; replace files that are not as a batch wrote them."),
    common.shared("json", "quiet"),
)
# fmt: on


@common.make_command("Convert many grids; can be stopped and resumed.", EXAMPLES, *TAKES, text=HELP)
def command(sources: tuple[str, ...], folder: Path, **given: Any) -> None:
    """Find the inputs, convert what is not done yet, print a summary."""
    start, page, quiet = time.perf_counter(), given["report"], given["quiet"]
    options = common.chosen_options(given)
    from ..batch.inputs import find_jobs
    from ..batch.job import Settings
    from ..batch.record import folder_lock
    from ..batch.run import Batch
    from ..labels.files import check_options
    from ..labels.files import read_names
    from ..network.network import find_model

    names = read_names(given["names"]) if given["names"] else None
    jobs, unread = find_jobs(sources, f".{given['kind']}", options, names)
    of_labels = [job.options for job in jobs if job.options.labels is not None]
    if names and not of_labels:
        raise OptionError(f"--names {given['names']} is for --labels: give that, too")
    for each in of_labels:
        check_options(each, [name for name in ("check", "report") if given[name]])
    if any(job.options.goals() for job in jobs):  # a list may say so
        check_modules("simplify", "simplify")
    items = check_batch_page(page, jobs, folder, force=given["force"]) if page else None
    model = options.network()["model"]
    find_model(model, options.precision)
    some = {name: given[name] for name in ("cluster", "force", "retry", "fail_fast", "check")}
    where = (folder, model, options.precision, options.device, options.threads, given["jobs"])
    settings = Settings(*where, items=items, names=names, **some)
    if given["dry_run"]:
        print_plan(Batch(jobs, settings, unread), given["as_json"])
        return
    with folder_lock(folder):
        batch = Batch(jobs, settings, unread)
        total = len(batch.waiting)
        for line in () if quiet else made_again_lines(batch):
            print_stderr(line)
        try:
            with common.progress_bar("converting", quiet or not total) as progress:

                def show(batch: Batch) -> None:
                    if progress:
                        progress(len(batch.done) + len(batch.failed), total)

                batch.run(show)
            write_page(batch, page)
        except KeyboardInterrupt:
            with suppress(SuperSdfError):
                write_page(batch, page, "interrupted")
            done = f"{len(batch.done)} of {total} are done and kept"
            raise KeyboardInterrupt(f"{done}; run it again to go on") from None
    batch.seconds = time.perf_counter() - start
    report, failures = folder / "report.jsonl", batch.failures()
    if given["as_json"]:
        print_stdout(json.dumps(summary(batch), indent=2), f"all is in {report}")
    lines = [f"Failed: {result.failure()}" for result in failures]
    lines += [f"Failed: {path} {reason}" for path, reason in unread]
    more = len(lines) - MOST_FAILURES
    lines[MOST_FAILURES:] = [f"and {more} more, see {report}"] * (more > 0)
    for line in lines if quiet else (*lines, *remarks(batch, report), sentence(batch)):
        print_stderr(line)
    if failures or unread:
        sys.exit(1)


def check_batch_page(page: Path, jobs: list[Job], folder: Path, *, force: bool) -> Path:
    """Return the folder beside a page for its meshes; raise if one of them cannot be written.

    A page that super-sdf wrote may be replaced, so that a batch can be resumed.
    """
    from ..files.regular import files_of
    from ..pages.html import is_page
    from ..pages.items import items_folder

    files = (path for job in jobs for path in (*files_of(job.source), folder / job.target))
    common.check_page("--report", page, files, force=force or is_page(page))
    beside = items_folder(page)
    if beside.exists() and not beside.is_dir():
        raise WriteError(f"{beside}, for the meshes of the page, is no folder: move it")
    return beside


def write_page(batch: Batch, path: Path | None, interrupted: str = "") -> None:
    """Write the page, if one was asked for; after an interrupt, at once and without drawing."""
    if path is not None:
        from ..batch.page import write_batch_page

        write_batch_page(path, batch, sentence(batch), interrupted)


def print_plan(plan: Batch, as_json: bool) -> None:
    """Print what would be done with each file, and the counts."""
    failed = [(result.row["retry"], _failure(result.row)) for result in plan.failed_before]
    report: dict[str, list[dict[str, Any]]] = {
        "to_do": [_paths(job) for job in plan.waiting],
        "done_before": [_paths(job) for job, _ in plan.done_before],
        "failed_before": [row for retry, row in failed if not retry],
        "refused": [row for retry, row in failed if retry],
        "unread": [{"in": path, "reason": reason} for path, reason in plan.unread],
    }
    if as_json:
        print_stdout(json.dumps({**report, "made_again": plan.made_again()}, indent=2))
    counts = []
    for kind, rows in report.items():
        words = kind.replace("_", " ")
        counts += [f"{len(rows)} {words}"] if rows or kind != "unread" else []
        for row in () if as_json else rows:
            end = row.get("reason") or f"-> {plan.settings.folder / row['out']}"
            line = f"{words}: {os.path.relpath(row['in'])} {end}"
            print_stdout("".join(c if c.isprintable() else ascii(c)[1:-1] for c in line))
    for line in (*made_again_lines(plan), ", ".join(counts)):
        print_stderr(line)


def made_again_lines(batch: Batch) -> list[str]:
    """Return a line that says how much is made again since options changed, if anything is."""
    again = batch.made_again()
    names = ", ".join(name.replace("_", "-") for name in again["options"])
    return [f"Note: {again['outputs']} are made again, since these changed: {names}"] * bool(names)


def _paths(job: Job) -> dict[str, Any]:
    return {"in": os.path.abspath(job.source), "out": job.target}


def _failure(row: dict[str, Any]) -> dict[str, Any]:
    return {name: row[name] for name in ("in", "out", "reason")}


def remarks(batch: Batch, report: Path) -> list[str]:
    """Return notes, and how many of the new meshes have notes and warnings in the report."""
    rows = [result.row for result in batch.done]
    noted = sum(bool(row["inferred"] or row.get("missing")) for row in rows)
    warned = sum(bool(row["warnings"] or row.get("beside")) for row in rows)
    checks = [row["check"] for row in rows if "check" in row]
    means = [check["residual"]["mean"] for check in checks if check.get("residual")]
    counts = {
        "Note: {} have notes": noted,
        "Warning: {} have warnings": warned,
        "Warning: {} have no residual": len(checks) - len(means),
        f"Check: mean residual {max(means, default=0):.4f} voxels at most, of {{}}": len(means),
    }
    lines = [f"{text.format(count)}: see {report}" for text, count in counts.items() if count]
    return [*(f"Note: {note}" for note in batch.notes), *lines]


def sentence(batch: Batch) -> str:
    """Return in one line what was done."""
    facts, seconds = summary(batch), round(batch.seconds)
    if batch.done or batch.failed or batch.waiting:
        counts = [f"{facts['done']} done, {facts['failed']} failed"]
        more = {"done before": facts["done_before"], "not begun": facts["not_begun"]}
    else:
        counts, retry = (
            [f"nothing to do: {facts['done_before']} done before"],
            "--retry tries again",
        )
        more = {f"failed before ({retry})": facts["failed_before"], "refused": facts["refused"]}
    counts += [f"{count} {kind}" for kind, count in more.items() if count]
    time_ = f"{batch.seconds:.1f} s" if seconds < 60 else f"{seconds // 60} min {seconds % 60} s"
    closed = f"{facts['closed']} meshes closed, {facts['open']} open"
    return f"{', '.join(counts)}; {closed}; {time_}"


def summary(batch: Batch) -> dict[str, Any]:
    """Return the counts, and each failure with its reason, as ``--json`` prints them."""
    counts = [(len(row.get("labels", [row])), bool(row["closed"])) for _, row in batch.results()]
    closed = sum(count for count, is_closed in counts if is_closed)
    unread = [{"in": path, "out": None, "reason": reason} for path, reason in batch.unread]
    refused = sum(bool(result.row["retry"]) for result in batch.failed_before)
    return {
        "done": len(batch.done),
        "done_before": len(batch.done_before),
        "failed": len(batch.failures()) + len(batch.unread),
        "failed_before": len(batch.failed_before) - refused,
        "refused": refused,
        "not_begun": len(batch.waiting),
        "closed": closed,
        "open": sum(count for count, _ in counts) - closed,
        "seconds": round(batch.seconds, 3),
        "made_again": batch.made_again(),
        "failures": [*(_failure(row) for _, row in batch.failures()), *unread],
        "report": str(batch.settings.folder / "report.jsonl"),
    }
