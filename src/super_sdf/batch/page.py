"""The page of a batch: all files of its ledger, those that failed first.

The meshes are beside the page and loaded when a file is opened, or within it if they are few.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

from ..errors import SuperSdfError
from ..pages.html import make_page, write_page
from ..pages.items import (
    Entry,
    Item,
    entry_of,
    entry_of_report,
    find_item,
    item_of_files,
    item_path,
    items_folder,
    keep_item,
    read_meshes,
    remove_items,
)
from .job import Job
from .record import is_unchanged
from .run import Batch

MOST_WITHIN = 5_000_000  # bytes of meshes that a page may hold itself


class BatchPage:
    """The page of a batch as it stands, at its end or interrupted.

    It has the rows of the report, also of runs with other inputs; those of labels are left out.
    """

    def __init__(self, path: Path, batch: Batch) -> None:
        self.path, self.batch, self.folder = path, batch, items_folder(path)
        failed = {result.job.target: result.row for result in batch.failures()}
        rows = batch.record.rows | failed
        finished = {result.job.target for result in batch.results()} | failed.keys()
        self.unfinished = [job for job in batch.jobs if job.target not in finished]
        for job in self.unfinished:
            rows.pop(job.target, None)
        of_labels = {name for name, row in rows.items() if (row.get("asked") or {}).get("labels")}
        self.rows = {name: row for name, row in rows.items() if name not in of_labels}

    def write(
        self, title: str, lead: str, alert: str = "", *, force: bool = False, draw: bool = True
    ) -> None:
        """Write the page; with ``draw``, make first what is missing of the meshes of this run."""
        meshes, jobs = self.batch.settings.folder, {job.target: job for job in self.batch.jobs}
        items = {
            name: self._item(name, row["output"]["sha256"], jobs.get(name) if draw else None)
            for name, row in self.rows.items()
            if row["status"] == "ok" and is_unchanged(meshes / name, row["output"])
        }
        drawn = {name: item for name, item in items.items() if item and item.size}
        within = draw and sum(item.size for item in drawn.values()) <= MOST_WITHIN
        entries = [entry_of(path, "failed", reason=why) for path, why in self.batch.unread]
        entries += [entry_of(job.target, "waiting", line="not finished") for job in self.unfinished]
        for name, row in self.rows.items():
            if row["status"] != "ok":
                facts, seconds = [["grid", row["in"]], ["mesh", name]], row.get("seconds")
                entries.append(
                    entry_of(name, "failed", reason=row["reason"], facts=facts, seconds=seconds)
                )
            elif name in items:
                report = {**row, "input": row["in"], "output": name}
                path = item_path(self.folder, name)
                entry = entry_of_report(name, report, items[name]) | {"id": path.stem}
                if name in drawn:
                    beside = quote(f"{self.folder.name}/{path.name}")
                    entry["meshes"] = "page" if within else beside
                entries.append(entry)
        entries.sort(key=lambda entry: (_rank(entry), entry["name"]))
        packed = {
            path.stem: read_meshes(path)
            for path in (item_path(self.folder, name) for name in drawn if within)
        }
        counts = {
            "files": len(entries),
            "failed": sum(entry["status"] == "failed" for entry in entries),
            "not finished": sum(entry["status"] == "waiting" for entry in entries),
            "with faults": sum(bool(entry["faults"]) for entry in entries),
            "with warnings": sum(bool(entry["warnings"]) for entry in entries),
        }
        summary = [[k, f"{count:,}"] for k, count in counts.items() if count or k == "files"]
        said = {"title": title, "lead": lead, "alert": alert, "notes": self.batch.notes}
        page = make_page({**said, "summary": summary, "files": entries}, packed, beside=not within)
        write_page(page, self.path, force=force)
        if within:
            remove_items(self.folder, items)

    def _item(self, name: str, digest: str, job: Job | None) -> Item | None:
        """Return the item of a mesh without its meshes; made for the job if there is none."""
        if not (found := find_item(self.folder, name, digest)) and job:
            with suppress(SuperSdfError):  # then it is not shown
                mesh = self.batch.settings.folder / name
                item = item_of_files(mesh, job.source, job.options)
                keep_item(item, self.folder, name, digest)
            found = find_item(self.folder, name, digest)
        return found


def _rank(entry: Entry) -> int:
    """Return where an entry stands in the list: failed, not finished, doubtful, good."""
    if entry["status"] != "ok":
        return 0 if entry["status"] == "failed" else 1
    return 2 if entry["faults"] or entry["warnings"] else 3
