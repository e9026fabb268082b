"""The output of ``batch``: its progress, its plan (``--dry-run``) and its summary."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from .common import print_stderr, print_stdout

if TYPE_CHECKING:
    from ..batch.job import Job
    from ..batch.plan import Batch
    from ..batch.run import OnFile

MOST_FAILURES = 20  # printed; the report has all
REDRAW_SECONDS = 0.1  # between two drawings of the progress line


@contextmanager
def progress_line(total: int, quiet: bool) -> Iterator[OnFile | None]:
    """Keep a progress line on stderr up to date; None if stderr is no terminal."""
    if quiet or not total or sys.stderr is None or not sys.stderr.isatty():
        yield None
        return
    shown = 0.0

    def draw(batch: Batch) -> None:
        nonlocal shown
        if time.perf_counter() - shown > REDRAW_SECONDS:
            shown = time.perf_counter()
            click.echo(f"\r{describe_progress(batch, total)}\x1b[K", err=True, nl=False)

    click.echo(f"0/{total}", err=True, nl=False)
    try:
        yield draw
    finally:
        click.echo("\r\x1b[K", err=True, nl=False)


def describe_progress(batch: Batch, total: int) -> str:
    """Return the files finished, the rate, and the remaining time in one line."""
    finished = len(batch.done) + len(batch.failed)
    rate = finished / batch.seconds
    left = batch.seconds * (batch.work / batch.work_done - 1)
    failed = f", {len(batch.failed)} failed" if batch.failed else ""
    return f"{finished}/{total}, {rate:.2g} files/s, {duration(left)} left{failed}"


def duration(seconds: float) -> str:
    """Return a time in seconds, or in minutes and hours."""
    if seconds < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def print_plan(plan: Batch, as_json: bool) -> None:
    """Print what would be done with each file, and the counts."""
    if as_json:
        print_stdout(json.dumps(plan_report(plan), indent=2), "nothing was written")
    else:
        for line in plan_lines(plan):
            print_stdout(line, "nothing was written")
    kinds = {kind: len(found) for kind, found in plan_report(plan).items()}
    if not kinds["unread"]:
        del kinds["unread"]
    counts = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in kinds.items())
    print_stderr(counts)


def plan_lines(plan: Batch) -> Iterator[str]:
    """Yield a line per file: what would be done with it."""
    from ..batch.job import one_line

    folder = plan.settings.folder
    for job in plan.waiting:
        yield one_line(f"to do: {job.source} -> {folder / job.target}")
    for job, _ in plan.done_before:
        yield one_line(f"done before: {job.source} -> {folder / job.target}")
    for result in plan.failed_before:
        yield f"{failure_kind(result.row).replace('_', ' ')}: {result.failure()}"
    for path, reason in plan.unread:
        yield one_line(f"unread: {path} {reason}")


def plan_report(plan: Batch) -> dict[str, Any]:
    """Return what would be done with each file, by kind, as ``--json`` prints it."""
    failed: dict[str, list[dict[str, Any]]] = {"failed_before": [], "refused": []}
    for _, row in plan.failed_before:
        failed[failure_kind(row)].append(failure_entry(row))
    return {
        "to_do": [entry(job) for job in plan.waiting],
        "done_before": [entry(job) for job, _ in plan.done_before],
        **failed,
        "unread": [{"in": path, "reason": reason} for path, reason in plan.unread],
    }


def entry(job: Job) -> dict[str, str]:
    """Return the JSON entry of a file that is done or to be done."""
    return {"in": os.path.abspath(job.source), "out": job.target}


def failure_entry(row: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON entry of a file that failed."""
    return {"in": row["in"], "out": row["out"], "reason": row["reason"]}


def failure_kind(row: dict[str, Any]) -> str:
    """Return why a failed file is not tried again: its output exists, or it failed before."""
    return "refused" if row["retry"] else "failed_before"


def print_summary(batch: Batch, options: dict[str, Any]) -> None:
    """Print counts and failures to stderr, and with ``--json`` JSON to stdout."""
    if options["as_json"]:
        report = batch.settings.folder / "report.jsonl"
        print_stdout(json.dumps(summary(batch), indent=2), f"all is in {report}")
    failed = [result.failure() for result in batch.failures()]
    failed += [f"{path} {reason}" for path, reason in batch.unread]
    for line in failed[:MOST_FAILURES]:
        print_stderr(f"Failed: {line}")
    more = len(failed) - MOST_FAILURES
    if more > 0:
        print_stderr(f"and {more} more, see {batch.settings.folder / 'report.jsonl'}")
    if not options["quiet"]:
        for remark in (*remarks(batch), sentence(batch)):
            print_stderr(remark)


def remarks(batch: Batch) -> list[str]:
    """Return notes on the run, and how many new meshes have notes or warnings in the report.

    Open meshes are left out: the summary counts them.
    """
    rows = [result.row for result in batch.done]
    inferred = sum(bool(row["inferred"]) for row in rows)
    simplified = [row for row in rows if "simplified" in row]
    unreached = sum(bool(row["simplified"]["warnings"]) for row in simplified)
    warned = sum(_warnings_of_values(row) > 0 for row in rows)
    report = batch.settings.folder / "report.jsonl"
    lines = [f"Note: {note}" for note in batch.notes]
    if inferred:
        lines.append(f"Note: spacing, origin or sign of {inferred} was inferred: see {report}")
    if warned:
        lines.append(f"Warning: {warned} are from noisy or contradictory values: see {report}")
    if simplified:
        lines.append(f"Simplified: {describe_simplified(simplified)}; see the report")
    if unreached:
        lines.append(f"Warning: {unreached} were not simplified as asked: see {report}")
    return lines + check_lines([row for row in rows if "check" in row])


def _warnings_of_values(row: dict[str, Any]) -> int:
    """Return how many warnings of a row are neither of an open mesh nor of its simplification."""
    others = (not row["closed"]) + len(row.get("simplified", {}).get("warnings", []))
    return len(row["warnings"]) - others


def describe_simplified(rows: list[dict[str, Any]]) -> str:
    """Describe in one line how much simpler meshes are in all, and the largest distance."""
    figures = {row["out"]: row["simplified"] for row in rows}
    before, after = (
        sum(found[key] for found in figures.values()) for key in ("triangles_before", "triangles")
    )
    worst = max(figures, key=lambda name: largest_distance(figures[name]))
    distance = largest_distance(figures[worst])
    counts = f"from {before:,} to {after:,} triangles"
    return f"{counts}; largest distance {distance:.4f} voxels, of {worst}"


def largest_distance(simplified: dict[str, Any]) -> float:
    """Return the larger one of the largest distances both ways, in voxels."""
    off = simplified["deviation"]
    return float(max(off["largest"], off["largest_back"]))


def check_lines(rows: list[dict[str, Any]]) -> list[str]:
    """Return in a line what the certificates of new meshes say, and in one how many are missing."""
    if not rows:
        return []
    residuals = {row["out"]: row["check"].get("residual") for row in rows}
    known = {name: found for name, found in residuals.items() if found}
    lines = []
    if known:
        worst = max(known, key=lambda name: float(known[name]["mean"]))
        mean = f"{known[worst]['mean']:.4f}"
        lines.append(f"Check: mean residual {mean} voxels at most, of {worst}; see the report")
    missing = len(rows) - len(known)
    return lines + [f"Warning: {missing} without a residual: see the report"] * (missing > 0)


def sentence(batch: Batch) -> str:
    """Return in one line what was done."""
    facts = summary(batch)
    if not batch.done and not batch.failed and not batch.waiting:
        words = f"nothing to do: {facts['done_before']} done before"
        refused = sum(bool(result.row["retry"]) for result in batch.failed_before)
        failed = len(batch.failed_before) - refused
        words += f", {failed} failed before (--retry tries again)" if failed else ""
        words += f", {refused} refused" if refused else ""
        words += f", {len(batch.unread)} folders unread" if batch.unread else ""
    else:
        words = f"{facts['done']} done, {facts['failed']} failed"
        words += f", {facts['done_before']} done before" if facts["done_before"] else ""
        words += f", {facts['not_begun']} not begun" if facts["not_begun"] else ""
    meshes = f"{facts['closed']} meshes closed, {facts['open']} open"
    return f"{words}; {meshes}; {duration(batch.seconds)}"


def summary(batch: Batch) -> dict[str, Any]:
    """Return the counts, and each failure with its reason, as ``--json`` prints them."""
    closed = sum(bool(result.row["closed"]) for result in batch.results())
    return {
        "done": len(batch.done),
        "done_before": len(batch.done_before),
        "failed": len(batch.failures()) + len(batch.unread),
        "not_begun": len(batch.waiting),
        "closed": closed,
        "open": len(batch.results()) - closed,
        "seconds": round(batch.seconds, 3),
        "failures": [
            *(failure_entry(row) for _, row in batch.failures()),
            *({"in": path, "out": None, "reason": reason} for path, reason in batch.unread),
        ],
        "report": str(batch.settings.folder / "report.jsonl"),
    }
