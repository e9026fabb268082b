"""What ``batch`` says: how far it is, what it would do, what it did."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from .common import print_result, tell

if TYPE_CHECKING:
    from ..batch.job import Job
    from ..batch.plan import Batch
    from ..batch.run import OnFile

SHOWN = 20  # failures on the screen; all are in the report
REDRAW = 0.1  # seconds between two drawings of the progress line


@contextmanager
def progress_line(total: int, quiet: bool) -> Iterator[OnFile | None]:
    """Keep a line on stderr up to date, if somebody is there to see it."""
    if quiet or not total or sys.stderr is None or not sys.stderr.isatty():
        yield None
        return
    shown = 0.0

    def draw(batch: Batch) -> None:
        nonlocal shown
        if time.perf_counter() - shown > REDRAW:
            shown = time.perf_counter()
            click.echo(f"\r{describe_progress(batch, total)}\x1b[K", err=True, nl=False)

    click.echo(f"0/{total}", err=True, nl=False)
    try:
        yield draw
    finally:
        click.echo("\r\x1b[K", err=True, nl=False)


def describe_progress(batch: Batch, total: int) -> str:
    """Say how far it is, how fast, and how long it will take."""
    finished = len(batch.done) + len(batch.failed)
    rate = finished / batch.seconds
    left = batch.seconds * (batch.work / batch.work_done - 1)
    failed = f", {len(batch.failed)} failed" if batch.failed else ""
    return f"{finished}/{total}, {rate:.2g} files/s, {duration(left)} left{failed}"


def duration(seconds: float) -> str:
    """Return a time in words."""
    if seconds < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def tell_plan(plan: Batch, as_json: bool) -> None:
    """Print what would be done with each file, and how many there are of each kind."""
    if as_json:
        print_result(json.dumps(plan_report(plan), indent=2), "nothing was written")
    else:
        for line in plan_lines(plan):
            print_result(line, "nothing was written")
    kinds = {kind: len(found) for kind, found in plan_report(plan).items()}
    if not kinds["unread"]:
        del kinds["unread"]
    counts = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in kinds.items())
    tell(counts)


def plan_lines(plan: Batch) -> Iterator[str]:
    """Yield what would be done with each file, a line each."""
    from ..batch.job import one_line

    folder = plan.settings.folder
    for job in plan.waiting:
        yield one_line(f"to do: {job.source} -> {folder / job.target}")
    for job, _ in plan.done_before:
        yield one_line(f"done before: {job.source} -> {folder / job.target}")
    for result in plan.failed_before:
        yield f"{kind_of(result.row).replace('_', ' ')}: {result.failure()}"
    for path, reason in plan.unread:
        yield one_line(f"unread: {path} {reason}")


def plan_report(plan: Batch) -> dict[str, Any]:
    """Return what would be done with each file, by kind, as it stands in JSON."""
    failed: dict[str, list[dict[str, Any]]] = {"failed_before": [], "refused": []}
    for _, row in plan.failed_before:
        failed[kind_of(row)].append(failure_entry(row))
    return {
        "to_do": [entry(job) for job in plan.waiting],
        "done_before": [entry(job) for job, _ in plan.done_before],
        **failed,
        "unread": [{"in": path, "reason": reason} for path, reason in plan.unread],
    }


def entry(job: Job) -> dict[str, str]:
    """Return what JSON tells of a file that has a mesh, or may have one."""
    return {"in": os.path.abspath(job.source), "out": job.target}


def failure_entry(row: dict[str, Any]) -> dict[str, Any]:
    """Return what JSON tells of a file that has no mesh."""
    return {"in": row["in"], "out": row["out"], "reason": row["reason"]}


def kind_of(row: dict[str, Any]) -> str:
    """Say why nothing is to be done with a file that has no mesh."""
    return "refused" if row["retry"] else "failed_before"


def tell_summary(batch: Batch, options: dict[str, Any]) -> None:
    """Print counts and failures: sentences on stderr, JSON on stdout."""
    if options["as_json"]:
        report = batch.settings.folder / "report.jsonl"
        print_result(json.dumps(summary(batch), indent=2), f"all is in {report}")
    failed = [result.failure() for result in batch.failures()]
    failed += [f"{path} {reason}" for path, reason in batch.unread]
    for line in failed[:SHOWN]:
        tell(f"Failed: {line}")
    more = len(failed) - SHOWN
    if more > 0:
        tell(f"and {more} more, see {batch.settings.folder / 'report.jsonl'}")
    if not options["quiet"]:
        for remark in (*remarks(batch), sentence(batch)):
            tell(remark)


def remarks(batch: Batch) -> list[str]:
    """Say how it was run, and of how many new meshes the report tells more.

    That one is open is counted anyhow.
    """
    rows = [result.row for result in batch.done]
    inferred = sum(bool(row["inferred"]) for row in rows)
    warned = sum(len(row["warnings"]) > (not row["closed"]) for row in rows)
    report = batch.settings.folder / "report.jsonl"
    said = [f"Note: {note}" for note in batch.notes]
    if inferred:
        said.append(f"Note: spacing, origin or sign of {inferred} was inferred: see {report}")
    if warned:
        said.append(f"Warning: {warned} are from noisy or contradictory values: see {report}")
    return said


def sentence(batch: Batch) -> str:
    """Say in a line what was done."""
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
    """Return the counts, and the failures each with its reason."""
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
