"""Folders that are grids: Zarr stores."""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import FileError
from .formats import find_format, split_member
from .regular import check_regular_file, reason_of

MARKS = ("zarr.json", ".zarray", ".zgroup")  # one of them makes a folder a Zarr store


def check_store(path: Path) -> Path:
    """Return the path if it is a readable Zarr folder.

    Raises
    ------
    FileError
        If it does not exist, or holds none of the files that every Zarr store has.
    """
    try:
        names = os.listdir(path)
    except NotADirectoryError:
        raise FileError(f"{path} is a file: a Zarr store is a folder") from None
    except OSError as error:
        raise FileError(f"{path} {reason_of(error)}") from None
    mark = next((name for name in MARKS if name in names), None)
    if mark is None:
        raise FileError(f"{path} is no Zarr store: it holds none of {', '.join(MARKS)}")
    check_regular_file(path / mark)
    return path


def is_store(path: str | Path) -> bool:
    """Return whether a path is a folder whose name is that of a Zarr store."""
    return str(path).lower().endswith(".zarr") and os.path.isdir(path)


def check_grid_file(path: str | Path) -> None:
    """Raise FileError unless the file that ``FILE`` or ``FILE:NAME`` names can be read."""
    file, _ = split_member(path)
    if find_format(path).key == "zarr" and not file.name.lower().endswith(".zip"):
        check_store(file)
    else:
        check_regular_file(file)
