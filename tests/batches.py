"""What tests of batches share."""

import json
from pathlib import Path

FAST = ("--quality", "fast")
PLAIN = ("--jobs", 1, "--factor", 2, "--spacing", 1, "--origin", 0)
LONE = (*PLAIN, *FAST)
CONSTANT = "every value is 1: a constant field has no surface"


def rows(folder="out"):
    """Return the report's rows."""
    return [json.loads(line) for line in Path(folder, "report.jsonl").read_text().splitlines()]


def files(folder="out"):
    """Return what is in a folder and not hidden, with the times of change."""
    found = sorted(path for path in Path(folder).rglob("[!.]*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.stat().st_mtime_ns for path in found}
