"""What ``batch`` says: how far it is, what it would do, what it did."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from .batch.plan import Batch
    from .batch.run import Progress

SHOWN = 20  # failures on the screen; all are in the report
REDRAW = 0.1  # seconds between two drawings of the progress line


@contextmanager
def progress_line(total: int, quiet: bool) -> Iterator[Progress | None]:
    """Keep a line on stderr up to date, if somebody is there to see it."""
    if quiet or not total or not sys.stderr.isatty():
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


def tell_plan(plan: Batch) -> None:
    """Print what would be done with each file, and how many there are of each kind."""
    for job in plan.waiting:
        click.echo(f"to do: {job.source} -> {plan.settings.folder / job.target}")
    for job, _ in plan.done_before:
        click.echo(f"done before: {job.source} -> {plan.settings.folder / job.target}")
    for result in plan.failed_before:
        click.echo(f"{kind_of(result.row)}: {result.failure()}")
    refused = sum(bool(result.row["retry"]) for result in plan.failed_before)
    counts = f"{len(plan.waiting)} to do, {len(plan.done_before)} done before, "
    counts += f"{len(plan.failed_before) - refused} failed before, {refused} refused"
    click.echo(counts, err=True)


def kind_of(row: dict[str, Any]) -> str:
    """Say why nothing is to be done with a file that has no mesh."""
    return "refused" if row["retry"] else "failed before"


def tell_summary(batch: Batch, options: dict[str, Any]) -> None:
    """Print counts and failures: sentences on stderr, JSON on stdout."""
    if options["as_json"]:
        click.echo(json.dumps(summary(batch), indent=2))
    for result in batch.failures()[:SHOWN]:
        click.echo(f"Failed: {result.failure()}", err=True)
    more = len(batch.failures()) - SHOWN
    if more > 0:
        click.echo(f"and {more} more, see {batch.settings.folder / 'report.jsonl'}", err=True)
    if not options["quiet"]:
        for remark in (*remarks(batch), sentence(batch)):
            click.echo(remark, err=True)


def remarks(batch: Batch) -> list[str]:
    """Say of how many new meshes the report tells more; that one is open is counted anyhow."""
    rows = [result.row for result in batch.done]
    inferred = sum(bool(row["inferred"]) for row in rows)
    warned = sum(len(row["warnings"]) > (not row["closed"]) for row in rows)
    report = batch.settings.folder / "report.jsonl"
    said = []
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
        "failed": len(batch.failures()),
        "not_begun": len(batch.waiting),
        "closed": closed,
        "open": len(batch.results()) - closed,
        "seconds": round(batch.seconds, 3),
        "failures": [
            {"in": row["in"], "out": row["out"], "reason": row["reason"]}
            for _, row in batch.failures()
        ],
        "report": str(batch.settings.folder / "report.jsonl"),
    }
