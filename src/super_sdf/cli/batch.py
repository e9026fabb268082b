"""Convert many grids to meshes in the folder DIR, each as upsample would.

Each IN is a grid file as for upsample, a folder (searched with its subfolders), a pattern such as
'**/*.npy', or a list of inputs: .txt with one path per line, or .jsonl with one object per line
such as {"in": "a.npy", "out": "a.ply", "spacing": 0.5}. Inputs are relative to the list.

A file that fails is reported and does not stop the batch. Run the command again to resume after an
interruption, or with more inputs or other options: only missing and outdated meshes are made.

  super-sdf batch grids/ --out meshes/
  super-sdf batch 'scans/**/*.npz' more.txt --out meshes/ --format stl --factor 2
  super-sdf batch cases/ --out meshes/ --format stl --labels all --names organs.ctbl
"""

from __future__ import annotations

import os
import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from click import Argument, Choice, Option

from ..batch.inputs import Job, find_jobs
from ..options import MESH_FORMATS, OPTIONS
from . import main

if TYPE_CHECKING:
    from ..batch.run import Batch
    from ..batch.work import Settings

MOST_FAILURES = 20  # printed; the report has all
FAILED = ("failed", "failed_before", "refused")
STATES = ("done", "done_before", *FAILED, "to_do")  # each input is in one of them

TAKES = (
    Argument(["sources"], metavar="IN...", nargs=-1, required=True, type=main.NAME),
    Option(["--out", "folder"], metavar="DIR", required=True, type=main.FILE,
        help="Folder for the meshes and report.jsonl; subfolders of IN are kept."),
    Option(["--grid"], metavar="NAME", default="",
        help="Name of the array to take from files with several arrays, as in FILE:NAME."),
    Option(["--format", "kind"], type=Choice(MESH_FORMATS), default=MESH_FORMATS[0],
        show_default=True, help="Mesh file format."),
    *OPTIONS,
    "names", "cluster", "jobs",
    Option(["--retry"], is_flag=True, help="Retry inputs that failed before and have not changed."),
    Option(["--dry-run"], is_flag=True, help="Show what would be done; write nothing."),
    "check", "report",
    Option(["--force"], is_flag=True,
        help="Convert everything again, and replace files that were changed by hand."),
    "json", "quiet",
)  # fmt: skip


def command(folder: Path, **given: Any) -> None:
    """Find the inputs, convert what is not done yet, print a summary."""
    start, page, quiet = time.perf_counter(), given["report"], given["quiet"]
    jobs, settings = planned(folder, given)
    from ..batch.record import folder_lock
    from ..batch.run import Batch

    if given["dry_run"]:
        print_plan(Batch(jobs, settings), folder, given["as_json"])
        return
    with folder_lock(folder):
        batch = Batch(jobs, settings)
        try:
            with main.progress_bar("converting", quiet or not batch.of("to_do")) as progress:
                batch.run(progress)
            facts = summary(batch, time.perf_counter() - start)
            if page:
                batch.write_page(page, sentence(facts))
        except KeyboardInterrupt:
            facts = summary(batch, time.perf_counter() - start)
            raise KeyboardInterrupt(f"{sentence(facts)}; run it again to go on", facts) from None
    if given["as_json"]:
        main.print_stdout(facts)
    failures = [f"Failed: {job.source}: {job.row['reason']}" for job in batch.of(*FAILED)]
    more = len(failures) - MOST_FAILURES
    failures[MOST_FAILURES:] = [f"and {more} more, see {facts['report']}"] * (more > 0)
    kinds = ", ".join(f"{kind} ({count})" for kind, count in facts["notes"].items())
    notes = [f"Notes: {kinds}; see {facts['report']}"] * bool(kinds)
    main.print_stderr(*failures, *[*notes, sentence(facts)] * (not quiet))
    if failures:
        sys.exit(1)


def planned(folder: Path, given: dict[str, Any]) -> tuple[list[Job], Settings]:
    """Check what is given; return the jobs, and how they are to be run."""
    options, page, drawn = main.chosen_options(given), given["report"], None
    from ..batch.work import Settings
    from ..labels.files import check_options

    jobs = find_jobs(given["sources"], f".{given['kind']}", options, given["names"], given["grid"])
    for job in jobs:
        if job.options.labels is not None:
            check_options(job.options, [name for name in ("check", "report") if given[name]])
    if page:
        from ..pages import html, items

        sources, meshes = zip(*((job.source, folder / job.target) for job in jobs))
        may_replace = given["force"] or html.is_page(page)
        main.check_page("--report", page, sources, meshes, force=may_replace)
        drawn = items.items_folder(page)
    some = {name: given[name] for name in ("cluster", "force", "retry", "check", "names")}
    return jobs, Settings(folder, options, given["jobs"], items=drawn, **some)


def summary(batch: Batch, seconds: float) -> dict[str, Any]:
    """Return the counts, and each failure with its reason, as ``--json`` prints them."""
    rows = [job.row for job in batch.of("done", "done_before")]
    meshes = [bool(row["closed"]) for row in rows for _ in row.get("labels", [row])]
    heads = (re.split(" ?[:;(]|, ", note)[0] for row in rows for note in row["inferred"])
    kinds = [re.sub(r"\d[\d,.]*", "N", head) for head in heads]
    return {
        **{state: len(batch.of(state)) for state in STATES},
        "warned": sum(bool(row["warnings"] or row.get("beside")) for row in rows),
        "notes": {kind: kinds.count(kind) for kind in sorted(set(kinds))},
        "closed": meshes.count(True),
        "open": meshes.count(False),
        "seconds": round(seconds, 3),
        "failures": batch.listed(*FAILED),
        "report": str(batch.record.path),
    }


def sentence(facts: dict[str, Any]) -> str:
    """Return in one line what was done."""
    words = {state: state.replace("_", " ") for state in STATES}
    words |= {"failed_before": "failed before (--retry tries again)", "warned": "with warnings"}
    counts = [f"{facts[key]} {said}" for key, said in words.items() if facts[key]]
    meshes = f"meshes: {facts['closed']} closed, {facts['open']} open"
    return f"{', '.join(counts)}; {meshes}; {facts['seconds']:.1f} s"


def print_plan(batch: Batch, folder: Path, as_json: bool) -> None:
    """Print what would be done with each file, and the counts."""
    plan = {state: batch.listed(state) for state in ("to_do", "done_before", *FAILED[1:])}
    if as_json:
        main.print_stdout(plan)
    for state, row in ((state, row) for state, rows in plan.items() if not as_json for row in rows):
        end = f": {row['reason']}" if "reason" in row else f" -> {folder / row['out']}"
        main.print_stdout(f"{state.replace('_', ' ')}: {os.path.relpath(row['in'])}{end}")
    counts = [f"{len(rows)} {kind.replace('_', ' ')}" for kind, rows in plan.items() if rows]
    main.print_stderr(", ".join(counts) or "nothing to do")
