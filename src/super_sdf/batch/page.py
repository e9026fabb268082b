"""The page of a batch: all files of its report, those that failed first.

The meshes are beside the page and loaded when a file is opened, or within it if they are few.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

from ..errors import SuperSdfError
from ..pages import items
from ..pages.html import is_page, make_page, write_page
from ..pages.items import entry_of, item_path
from .record import is_unchanged
from .run import Batch

MOST_WITHIN = 5_000_000  # bytes of meshes that a page may hold itself


def write_batch_page(path: Path, batch: Batch, lead: str, interrupted: str = "") -> None:
    """Write the page of a batch as it stands, whose first sentence is ``lead``.

    It has the rows of the report, also of runs with other inputs; those of labels are left out. If
    the batch was interrupted, which is then said, nothing is made that is missing of the meshes.
    """
    folder, outputs = items.items_folder(path), batch.settings.folder
    failed = {job.target: row for job, row in batch.failures()}
    finished = {job.target for job, _ in batch.results()} | failed.keys()
    jobs = {job.target: job for job in batch.jobs}
    unfinished = [name for name in jobs if name not in finished]
    entries = [entry_of(file, "failed", reason=why) for file, why in batch.unread]
    entries += [entry_of(name, "waiting", line="not finished") for name in unfinished]
    shown = {}  # items with meshes, by the files that they are in
    for name, row in (batch.record.rows | failed).items():
        if name in unfinished or (row.get("asked") or {}).get("labels") is not None:
            continue
        if row["status"] != "ok":
            facts, why = [["grid", row["in"]], ["mesh", name]], row["reason"]
            entries.append(entry_of(name, "failed", reason=why, facts=facts))
        elif is_unchanged(outputs / name, row["output"]):
            digest, job, file = row["output"]["sha256"], jobs.get(name), item_path(folder, name)
            item = items.find_item(folder, name, digest)
            if item is None and job and not interrupted:
                with suppress(SuperSdfError):  # then it is not shown
                    made = items.item_of_files(outputs / name, job.source, job.options)
                    items.keep_item(made, folder, name, digest)
                item = items.find_item(folder, name, digest)
            report = {**row, "input": row["in"], "output": name}
            entries.append(items.entry_of_report(name, report, item) | {"id": file.stem})
            if item and item.size:
                shown[file] = item
                entries[-1]["meshes"] = quote(f"{folder.name}/{file.name}")
    within = not interrupted and sum(item.size for item in shown.values()) <= MOST_WITHIN
    for entry in entries if within else ():
        entry["meshes"] = "page" if entry["meshes"] else None
    doubtful = [entry for entry in entries if entry["faults"] or entry["warnings"]]
    kinds = {"failed": 0, "waiting": 1, "ok": 3}
    entries.sort(key=lambda e: (2 if e in doubtful else kinds[e["status"]], e["name"]))
    counts = {
        "files": len(entries),
        "failed": sum(entry["status"] == "failed" for entry in entries),
        "not finished": len(unfinished),
        "with faults": sum(bool(entry["faults"]) for entry in entries),
        "with warnings": sum(bool(entry["warnings"]) for entry in entries),
    }
    summary = [[k, f"{count:,}"] for k, count in counts.items() if count or k == "files"]
    alert = f"Incomplete{f', {interrupted}' if interrupted else ''}: {len(unfinished)} not finished"
    said = {
        "title": f"Batch: {outputs}",
        "lead": lead,
        "alert": f"{alert}; run it again to go on" if unfinished or interrupted else "",
        "notes": batch.notes,
    }
    packed = {file.stem: items.read_meshes(file) for file in shown if within}
    page = make_page({**said, "summary": summary, "files": entries}, packed, beside=not within)
    write_page(page, path, force=batch.settings.force or is_page(path))
    if within:
        items.remove_items(folder, batch.record.rows)
