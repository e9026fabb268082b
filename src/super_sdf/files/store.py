"""Inputs of several files: Zarr stores, which are folders, and files that name others."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from ..errors import FileError
from .formats import find_format, split_member
from .regular import check_regular_file, reason_of

MARKS = ("zarr.json", ".zarray", ".zgroup")  # one of them makes a folder a Zarr store
HEADERS = (".mhd", ".mha", ".nhdr", ".nrrd")  # text that may name data files, a line each
LONGEST_HEADER = 1 << 20  # bytes, with a list of files
NUMBER = re.compile(r"%0?\d*d")  # in a pattern of names
WEIGHTS = re.compile(rb"\n\x08location\x12([\x01-\x7f])")  # of a network: before a name, its length


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
    key = find_format(path).key
    if key == "zarr" and not file.name.lower().endswith(".zip"):
        check_store(file)
    elif key != "dicom":
        check_regular_file(file)


def files_of(path: str | Path) -> list[Path]:
    """Return the files that are read for a grid or a network: itself, and those that it names.

    Of a Zarr folder they are all in it; of a pattern of names, all that fit it. Of what cannot be
    read it is the file itself.
    """
    file, _ = split_member(path)
    if is_store(file):
        return sorted(Path(at, name) for at, _, names in os.walk(file) for name in names)
    named: set[Path] = set()
    with suppress(OSError):
        if file.is_file():  # opening a pipe would block
            named = {file.parent / name for name in _names_in(file)}
    return [file, *sorted(each for each in named - {file} if os.path.isfile(each))]


def _names_in(file: Path) -> Iterator[str]:
    """Yield what may be the names of other files in a header or a network."""
    kind = file.suffix.lower()
    if kind == ".hdr":
        yield from (f"{file.stem}.img", f"{file.stem}.img.gz")
    if kind == ".onnx":
        content = file.read_bytes()
        for found in WEIGHTS.finditer(content):
            yield os.fsdecode(content[found.end() : found.end() + found[1][0]])
    elif kind in HEADERS:
        with file.open("rb") as header:
            lines = header.read(LONGEST_HEADER).split(b"\n")
        for line in lines:
            if b"\0" in line:  # the data
                break
            text = os.fsdecode(line).strip()
            value = re.split("[=:]", text, maxsplit=1)[-1].strip()
            yield from (text, value)
            if NUMBER.search(value):
                pattern = NUMBER.sub("*", glob.escape(value.split()[0]))
                yield from glob.glob(pattern, root_dir=file.parent)
