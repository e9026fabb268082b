"""The output of ``batch``: its progress, its plan (``--dry-run``) and its summary."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from .common import print_stderr, print_stdout

if TYPE_CHECKING:
    from ..batch.record import Row
    from ..batch.run import Batch

MOST_FAILURES = 20  # printed; the report has all
REDRAW_SECONDS = 0.1  # between two drawings of the progress line


@contextmanager
def progress_line(total: int, quiet: bool) -> Iterator[Callable[[Batch], None] | None]:
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
    left = batch.seconds * (batch.work / batch.work_done - 1)
    failed = f", {len(batch.failed)} failed" if batch.failed else ""
    rate = f"{finished / batch.seconds:.2g} files/s"
    return f"{finished}/{total}, {rate}, {duration(left)} left{failed}"


def duration(seconds: float) -> str:
    """Return a time in seconds, or in minutes and hours."""
    if seconds < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def print_plan(plan: Batch, as_json: bool) -> None:
    """Print what would be done with each file, and the counts."""
    from ..batch.job import one_line

    report: dict[str, list[dict[str, Any]]] = {
        kind: [] for kind in ("to_do", "done_before", "failed_before", "refused", "unread")
    }
    lines = []

    def note(kind: str, entry: dict[str, Any], said: str) -> None:
        report[kind].append(entry)
        lines.append(one_line(f"{kind.replace('_', ' ')}: {said}"))

    done = [job for job, _ in plan.done_before]
    for kind, jobs in (("to_do", plan.waiting), ("done_before", done)):
        for job in jobs:
            entry = {"in": os.path.abspath(job.source), "out": job.target}
            note(kind, entry, f"{job.source} -> {plan.settings.folder / job.target}")
    for result in sorted(plan.failed_before, key=lambda result: result.row["retry"]):
        kind = "refused" if result.row["retry"] else "failed_before"
        note(kind, _failure(result.row), result.failure())
    for path, reason in plan.unread:
        note("unread", {"in": path, "reason": reason}, f"{path} {reason}")
    told = {**report, "made_again": plan.made_again()}
    for text in [json.dumps(told, indent=2)] if as_json else lines:
        print_stdout(text, "nothing was written")
    for line in made_again_lines(plan):
        print_stderr(line)
    counted = {
        kind: len(entries) for kind, entries in report.items() if entries or kind != "unread"
    }
    print_stderr(", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in counted.items()))


def made_again_lines(batch: Batch) -> list[str]:
    """Return a line that says how much is made again since options changed, if anything is."""
    again = batch.made_again()
    names = ", ".join(name.replace("_", "-") for name in again["options"])
    return [f"Note: {again['outputs']} are made again, since these changed: {names}"] * bool(names)


def _failure(row: Row) -> dict[str, Any]:
    return {"in": row["in"], "out": row["out"], "reason": row["reason"]}


def print_summary(batch: Batch, options: dict[str, Any]) -> None:
    """Print counts and failures to stderr, and with ``--json`` JSON to stdout."""
    report = batch.settings.folder / "report.jsonl"
    if options["as_json"]:
        print_stdout(json.dumps(summary(batch), indent=2), f"all is in {report}")
    failed = [result.failure() for result in batch.failures()]
    failed += [f"{path} {reason}" for path, reason in batch.unread]
    for line in failed[:MOST_FAILURES]:
        print_stderr(f"Failed: {line}")
    if len(failed) > MOST_FAILURES:
        print_stderr(f"and {len(failed) - MOST_FAILURES} more, see {report}")
    for remark in () if options["quiet"] else (*remarks(batch), sentence(batch)):
        print_stderr(remark)


def remarks(batch: Batch) -> list[str]:
    """Return notes on the run, and how many new meshes have notes or warnings in the report.

    Open meshes are left out: the summary counts them.
    """
    rows, report = [result.row for result in batch.done], batch.settings.folder / "report.jsonl"
    simplified = [row for row in rows if "simplified" in row]
    inferred = sum(bool(row["inferred"]) for row in rows)
    unreached = sum(bool(row["simplified"]["warnings"]) for row in simplified)
    warned = 0
    for row in rows:  # with warnings that are neither of an open mesh nor of its simplification
        others = (not row["closed"]) + len(row.get("simplified", {}).get("warnings", []))
        warned += len(row["warnings"]) > others
    lines = [f"Note: {note}" for note in batch.notes]
    if inferred:
        lines.append(f"Note: {inferred} have notes on how they were read: see {report}")
    if lacking := sum(bool(row.get("missing")) for row in rows):
        lines.append(f"Note: {lacking} lack labels that were asked for: see {report}")
    if beside := sum(bool(row.get("beside")) for row in rows):
        lines.append(f"Warning: {beside} have files of labels from other runs: see {report}")
    if warned:
        lines.append(f"Warning: {warned} are from noisy or contradictory values: see {report}")
    if simplified:
        lines.append(f"Simplified: {_describe_simplified(simplified)}; see the report")
    if unreached:
        lines.append(f"Warning: {unreached} were not simplified as asked: see {report}")
    return lines + _check_lines([row for row in rows if "check" in row])


def _describe_simplified(rows: list[Row]) -> str:
    figures = [row["simplified"] for row in rows]
    before, after = (sum(f[key] for f in figures) for key in ("triangles_before", "triangles"))
    distances = [
        (max(f["deviation"]["largest"], f["deviation"]["largest_back"]), row["out"])
        for f, row in zip(figures, rows)
    ]
    distance, worst = max(distances, key=lambda pair: pair[0])
    counts = f"from {before:,} to {after:,} triangles"
    return f"{counts}; largest distance {distance:.4f} voxels, of {worst}"


def _check_lines(rows: list[Row]) -> list[str]:
    checked = [row for row in rows if row["check"].get("residual")]
    means = [(row["check"]["residual"]["mean"], row["out"]) for row in checked]
    lines, missing = [], len(rows) - len(means)
    if means:
        mean, worst = max(means, key=lambda pair: pair[0])
        lines.append(f"Check: mean residual {mean:.4f} voxels at most, of {worst}; see the report")
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
    counts = [(len(row.get("labels", [row])), bool(row["closed"])) for _, row in batch.results()]
    closed = sum(count for count, is_closed in counts if is_closed)
    unread = [{"in": path, "out": None, "reason": reason} for path, reason in batch.unread]
    return {
        "done": len(batch.done),
        "done_before": len(batch.done_before),
        "failed": len(batch.failures()) + len(batch.unread),
        "not_begun": len(batch.waiting),
        "closed": closed,
        "open": sum(count for count, _ in counts) - closed,
        "seconds": round(batch.seconds, 3),
        "made_again": batch.made_again(),
        "failures": [*(_failure(row) for _, row in batch.failures()), *unread],
        "report": str(batch.settings.folder / "report.jsonl"),
    }
