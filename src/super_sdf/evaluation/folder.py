"""The folder of a report: new, empty, or made by an earlier evaluation.

Files that no evaluation wrote are never replaced.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from ..errors import FileError
from ..files.output import replacing

ROWS, REPORT, SHAPES = "results.jsonl", "report.md", "shapes.md"
ROW_START = b'{"shape": '
# How these pages begin, in every version.
PAGE_STARTS = {REPORT: rb"# Quality of super-sdf on ", SHAPES: rb"## \d+\^3"}


def check_folder(out: Path) -> None:
    """Raise FileError unless a folder is new, empty or made by an evaluation."""
    if not os.path.lexists(out):
        return
    if not out.is_dir():
        raise FileError(f"{out} is no folder: give a new one")
    names = sorted(os.listdir(out))
    if names and ROWS not in names:
        raise FileError(
            f"{out} holds {names[0]!r} and no {ROWS}, so no evaluation made it: give a new or an "
            "empty folder"
        )
    for name in {ROWS, REPORT, SHAPES} & set(names):
        check_ours(out / name)


def check_ours(path: Path) -> None:
    """Raise FileError if a file exists that no evaluation wrote."""
    if os.path.lexists(path) and not is_ours(path):
        raise FileError(f"{path} was not written by an evaluation: move it or use another folder")


def is_ours(path: Path) -> bool:
    """Return whether an evaluation wrote a file: a page, or rows, the last maybe unfinished."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        if path.name != ROWS:
            return re.match(PAGE_STARTS[path.name], file.read(100)) is not None
        head = file.read(len(ROW_START))
        if ROW_START.startswith(head):  # empty, or killed while writing the first row
            return True
        file.seek(0)
        return any(line.startswith(ROW_START) for line in file)


def make_folder(path: Path) -> Path:
    """Make a folder if it does not exist; return it.

    Raises
    ------
    FileError
        If it cannot be made, or is not writable.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"{path} cannot be made: {error.strerror}") from error
    if not os.access(path, os.W_OK):
        raise FileError(f"{path} cannot be written to: no permission")
    return path


def write_page(path: Path, text: str) -> Path:
    """Write a page of Markdown, whole or not at all; return its path.

    File names may hold bytes that are not valid text: they are escaped.

    Raises
    ------
    FileError
        If a file exists there that no evaluation wrote.
    """
    check_ours(path)  # again, for it may have appeared during the work
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8", errors="backslashreplace")
    return path
