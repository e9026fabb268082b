"""The page of one conversion: all that it shows is within it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..certificate.check import Certificate, CheckOptions
from .entries import entry_of_report, tiles
from .html import make_page, write_page
from .items import item_of_files


def write_single(
    path: Path,
    report: Mapping[str, Any],
    options: CheckOptions,
    certificate: Certificate | None = None,
    *,
    force: bool = False,
) -> None:
    """Write the page of a conversion.

    Parameters
    ----------
    path : Path
        The page.
    report : dict
        As ``upsample --json`` prints it: with ``input`` and ``output``.
    options : CheckOptions
        How the grid is read again.
    certificate : Certificate, optional
        If there is one already.
    force : bool
        Replace the page if it exists.

    Raises
    ------
    WriteError
        If it cannot be written.
    """
    item = item_of_files(report["output"], report["input"], options, certificate)
    name = Path(report["output"]).name
    entry = entry_of_report(name, report, item) | {"id": "0"}
    entry["meshes"] = "page" if item.meshes else None
    facts = {
        "title": name,
        "lead": "",
        "alert": "",
        "summary": tiles(entry),
        "notes": [],
        "files": [entry],
    }
    write_page(make_page(facts, {"0": item.meshes}), path, force=force)
