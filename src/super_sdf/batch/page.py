"""The page of a batch: all files of its ledger, those that failed first.

The meshes are beside the page and loaded when a file is opened, or within it if they are few.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

from ..errors import SuperSdfError
from ..pages.html import make_page, write_page
from ..pages.items import (Entry, Item, entry_of, entry_of_report, find_item, item_name, item_of_files, item_path, items_folder, keep_item, read_meshes, remove_items)
from .job import Job
from .record import Row, is_unchanged
from .run import Batch

MOST_WITHIN = 5_000_000  # bytes of meshes that a page may hold itself


class BatchPage:
    """The page of a batch as it stands, at its end or interrupted.

    It has the rows of the report, also of runs with other inputs; those of labels are left out.
    """

    def __init__(self, path: Path, batch: Batch) -> None:
        self.path, self.batch, self.folder = path, batch, items_folder(path)
        jobs, rows = batch.jobs, batch.record.rows
        self.jobs = {job.target: job for job in jobs}
        rows = rows | {result.job.target: result.row for result in batch.failures()}
        self.rows = {name: row for name, row in rows.items() if (row.get("asked") or {}).get("labels") is None}
        finished = {result.job.target for result in (*batch.results(), *batch.failures())}
        self.unfinished = [job for job in jobs if job.target not in finished]

    def write(
        self, title: str, lead: str, alert: str = "", *, force: bool = False, draw: bool = True
    ) -> None:
        """Write the page; with ``draw``, make first what is missing of the meshes of this run."""
        for job in self.unfinished:
            self.rows.pop(job.target, None)
        meshes = self.batch.settings.folder
        items = {
            name: self.item(row, draw)
            for name, row in self.rows.items()
            if row["status"] == "ok" and is_unchanged(meshes / name, row["output"])
        }
        drawn = {name: item for name, item in items.items() if item and item.size}
        within = draw and sum(item.size for item in drawn.values()) <= MOST_WITHIN
        entries = self._entries(items, within)
        entries.sort(key=lambda entry: (_rank(entry), entry["name"]))
        packed = {
            item_name(name): read_meshes(item_path(self.folder, name)) for name in drawn if within
        }
        said = {"title": title, "lead": lead, "alert": alert, "notes": self.batch.notes}
        facts = {**said, "summary": _tiles(entries), "files": entries}
        write_page(make_page(facts, packed, beside=not within), self.path, force=force)
        if within:
            remove_items(self.folder, items)

    def item(self, row: Row, draw: bool) -> Item | None:
        """Return the item of a mesh without its meshes; made now if there is none and it can be."""
        name, digest = row["out"], row["output"]["sha256"]
        found, job = find_item(self.folder, name, digest), self.jobs.get(name)
        if found or not draw or job is None:
            return found
        with suppress(SuperSdfError):  # then it is not shown
            made = item_of_files(self.batch.settings.folder / name, job.source, job.options)
            keep_item(made, self.folder, name, digest)
        return find_item(self.folder, name, digest)

    def _entries(self, items: dict[str, Item | None], within: bool) -> list[Entry]:
        """Return the entries of all files, in no order."""
        folder = None if within else f"{quote(self.folder.name)}/"
        return [
            *(_entry_of_item(self.rows[name], item, folder) for name, item in items.items()),
            *(_entry_of_failure(row) for row in self.rows.values() if row["status"] != "ok"),
            *(entry_of(path, "failed", reason=why) for path, why in self.batch.unread),
            *(entry_of(job.target, "waiting", line="not finished") for job in self.unfinished),
        ]


def _entry_of_item(row: Row, item: Item | None, folder: str | None) -> Entry:
    """Return the entry of a mesh; its meshes are in a folder beside the page, or within it."""
    name = item_name(row["out"])
    report = {**row, "input": row["in"], "output": row["out"]}
    entry = entry_of_report(row["out"], report, item) | {"id": name}
    if item and item.size:
        entry["meshes"] = f"{folder}{name}.js" if folder else "page"
    return entry


def _entry_of_failure(row: Row) -> Entry:
    facts = [["grid", row["in"]], ["mesh", row["out"]]]
    why, seconds = row["reason"], row.get("seconds")
    return entry_of(row["out"], "failed", reason=why, facts=facts, seconds=seconds)


def _rank(entry: Entry) -> int:
    """Return where an entry stands in the list: failed, not finished, doubtful, good."""
    if entry["status"] != "ok":
        return 0 if entry["status"] == "failed" else 1
    return 2 if entry["faults"] or entry["warnings"] else 3


def _tiles(entries: Sequence[Entry]) -> list[list[str]]:
    """Return counts for the head of the page."""
    counts = {
        "files": len(entries),
        "failed": sum(entry["status"] == "failed" for entry in entries),
        "not finished": sum(entry["status"] == "waiting" for entry in entries),
        "with faults": sum(bool(entry["faults"]) for entry in entries),
        "with warnings": sum(bool(entry["warnings"]) for entry in entries),
    }
    return [[label, f"{count:,}"] for label, count in counts.items() if count or label == "files"]
