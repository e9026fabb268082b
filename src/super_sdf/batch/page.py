"""The page of a batch: all files of its ledger, those that failed first.

The meshes are beside the page and loaded when a file is opened, or within it if they are few.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ..certificate.check import CheckOptions
from ..errors import SuperSdfError
from ..pages.entries import Entry, entry_of, entry_of_report
from ..pages.html import make_page, write_page
from ..pages.items import Item, item_of_files, read_meshes
from .fingerprint import is_unchanged
from .items import Items, item_name, items_folder
from .job import Job, Row
from .plan import Batch

MOST_WITHIN = 5_000_000  # bytes of meshes that a page may hold itself
FAILED, WAITING, DOUBTFUL, GOOD = range(4)  # in this order


@dataclass(frozen=True)
class Words:
    """What the page says above the list: title, a sentence, an alert or "", and notes."""

    title: str
    lead: str
    alert: str = ""
    notes: Sequence[str] = ()


class BatchPage:
    """The page of a batch as it stands.

    Parameters
    ----------
    path : Path
        The page.
    batch : Batch
        The batch, at its end or interrupted.
    jobs : list of Job
        All jobs of the run.
    rows : dict
        The rows of the ledger by output, also of runs with other inputs.
    """

    def __init__(self, path: Path, batch: Batch, jobs: Sequence[Job], rows: dict[str, Row]) -> None:
        self.path, self.batch = path, batch
        self.kept, self.meshes = Items(items_folder(path)), batch.settings.folder
        self.jobs = {job.target: job for job in jobs}
        refused = {result.job.target: result.row for result in batch.failures()}
        self.rows = {**rows, **refused}
        finished = {result.job.target for result in (*batch.results(), *batch.failures())}
        self.unfinished = [job for job in jobs if job.target not in finished]

    def write(self, words: Words, *, force: bool = False, draw: bool = True) -> None:
        """Write the page; with ``draw``, make first what is missing of the meshes of this run."""
        for job in self.unfinished:
            self.rows.pop(job.target, None)
        items = {name: self.item(row, draw) for name, row in self.made().items()}
        within = draw and sum(item.size for item in items.values() if item) <= MOST_WITHIN
        entries = self.entries(items, within)
        packed = self.packed(items) if within else {}
        entries.sort(key=lambda entry: (rank(entry), entry["name"]))
        facts = {**asdict(words), "summary": tiles(entries), "files": entries}
        write_page(make_page(facts, packed, beside=not within), self.path, force=force)
        if within:
            self.kept.remove(items)

    def made(self) -> dict[str, Row]:
        """Return the rows of meshes that are there as they were made."""
        good = {name: row for name, row in self.rows.items() if row["status"] == "ok"}
        return {
            name: row
            for name, row in good.items()
            if is_unchanged(self.meshes / name, row["output"])
        }

    def item(self, row: Row, draw: bool) -> Item | None:
        """Return the item of a mesh without its meshes; made now if there is none and it can be."""
        found, job = self.kept.find(row["out"], row["output"]), self.jobs.get(row["out"])
        if found or not draw or job is None:
            return found
        options = CheckOptions.of(job.options)
        with suppress(SuperSdfError):  # then it is not shown
            made = item_of_files(self.meshes / row["out"], job.source, options)
            self.kept.add(made, row["out"], row["output"])
        return self.kept.find(row["out"], row["output"])

    def entries(self, items: dict[str, Item | None], within: bool) -> list[Entry]:
        """Return the entries of all files, in no order."""
        source = "page" if within else f"{quote(self.kept.folder.name)}/"
        return [
            *(entry_of_item(self.rows[name], item, source) for name, item in items.items()),
            *(entry_of_failure(row) for row in self.rows.values() if row["status"] != "ok"),
            *(entry_of(path, "failed", reason=why) for path, why in self.batch.unread),
            *(entry_of(job.target, "waiting", line="not finished") for job in self.unfinished),
        ]

    def packed(self, items: dict[str, Item | None]) -> dict[str, list[dict[str, Any]]]:
        """Return the meshes that are to be within the page, by the id of their entry."""
        drawn = [target for target, item in items.items() if item and item.size]
        return {item_name(target): read_meshes(self.kept.path(target)) for target in drawn}


def entry_of_item(row: Row, item: Item | None, source: str) -> Entry:
    """Return the entry of a mesh; its meshes are in the folder ``source``, or in the page."""
    name = item_name(row["out"])
    report = {**row, "input": row["in"], "output": row["out"]}
    entry = entry_of_report(row["out"], report, item) | {"id": name}
    if item and item.size:
        entry["meshes"] = source if source == "page" else f"{source}{name}.js"
    return entry


def entry_of_failure(row: Row) -> Entry:
    """Return the entry of a file that failed."""
    facts = [["grid", row["in"]], ["mesh", row["out"]]]
    return entry_of(
        row["out"], "failed", reason=row["reason"], facts=facts, seconds=row.get("seconds")
    )


def rank(entry: Entry) -> int:
    """Return where an entry stands in the list."""
    if entry["status"] != "ok":
        return FAILED if entry["status"] == "failed" else WAITING
    return DOUBTFUL if entry["faults"] or entry["warnings"] else GOOD


def tiles(entries: Sequence[Entry]) -> list[list[str]]:
    """Return counts for the head of the page."""
    counts = {
        "files": len(entries),
        "failed": sum(entry["status"] == "failed" for entry in entries),
        "not finished": sum(entry["status"] == "waiting" for entry in entries),
        "with faults": sum(bool(entry["faults"]) for entry in entries),
        "with warnings": sum(bool(entry["warnings"]) for entry in entries),
    }
    return [[label, f"{count:,}"] for label, count in counts.items() if count or label == "files"]
