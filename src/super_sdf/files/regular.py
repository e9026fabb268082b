"""Inputs: only regular files are read, and an input may be several.

Opening a named pipe may wait forever, and reading a device may never end. Zarr stores are folders,
and some files name others, which must lie beside them.
"""

from __future__ import annotations

import errno
import glob
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path, PurePath

from ..errors import FileError, seen
from .formats import find_format, split_member

KINDS = {stat.S_IFDIR: "folder", stat.S_IFIFO: "named pipe", stat.S_IFSOCK: "socket"}
KINDS |= {stat.S_IFCHR: "device", stat.S_IFBLK: "device"}
REASONS = {
    errno.ENOENT: "does not exist",
    errno.ENOTDIR: "does not exist: the path before its last / is not a folder",
    errno.EACCES: "cannot be read: permission denied",
}
MARKS = ("zarr.json", ".zarray", ".zgroup")  # one of them makes a folder a Zarr store
HEADERS = (".mhd", ".mha", ".nhdr", ".nrrd")  # text that may name data files, a line each
LONGEST_HEADER = 1 << 20  # bytes, with a list of files
NUMBER = re.compile(r"%0?\d*d")  # in a pattern of names
WEIGHTS = re.compile(rb"\n\x08location\x12([\x01-\x7f])")  # of a network: before a name, its length


def check_regular_file(path: str | Path) -> Path:
    """Return the path if it is a readable regular file, or a link to one, else raise FileError.

    The file is not opened, so this never blocks. An empty file is refused, too.
    """
    try:
        state = os.stat(path)
    except OSError as error:
        raise FileError(f"{path} {reason_of(error)}") from None
    except ValueError:  # a NUL, or a character that the file system's encoding lacks
        raise FileError(f"{str(path)!r} is not a valid file name") from None
    if not stat.S_ISREG(state.st_mode):
        kind = KINDS.get(stat.S_IFMT(state.st_mode), "special file")
        raise FileError(f"{path} is a {kind}: give a file")
    if not os.access(path, os.R_OK):
        raise FileError(f"{path} {REASONS[errno.EACCES]}")
    if not state.st_size:  # such as files in /proc, which the system makes up as they are read
        raise FileError(f"{path} is empty: give a file with something in it")
    return Path(path)


def check_beside(path: Path, name: str) -> Path:
    """Return the file that another one, or a folder, names as part of it: in the folder, or below.

    A file that is a link may have its parts beside the file that it leads to. Raises FileError if
    it is anywhere else, or no regular file.
    """
    homes = (path,) if path.is_dir() else (path.parent, path.resolve().parent)
    other = homes[0] / name
    if not PurePath(name).is_absolute() and ".." not in PurePath(name).parts:
        check_regular_file(other)
        if any(other.resolve().is_relative_to(home.resolve()) for home in homes):
            return other
    said = f"{path} names the file {seen(name)}, which is not in its folder"
    raise FileError(f"{said}: put both into one folder")


def reason_of(error: OSError) -> str:
    """Return why the system refuses to read a file, as the words after its name."""
    return REASONS.get(error.errno or 0) or f"cannot be read: {error.strerror or error}"


def is_store(path: str | Path) -> bool:
    """Return whether a path is a folder whose name is that of a Zarr store."""
    return str(path).lower().endswith(".zarr") and os.path.isdir(path)


def check_grid_file(path: str | Path) -> None:
    """Raise FileError unless the file that ``FILE`` or ``FILE:NAME`` names can be read."""
    file, _ = split_member(path)
    if is_store(file):
        if not any((file / mark).is_file() for mark in MARKS):
            raise FileError(f"{file} is no Zarr store: it holds none of {', '.join(MARKS)}")
    elif find_format(path).key != "dicom":
        check_regular_file(file)


def files_of(path: str | Path) -> list[Path]:
    """Return the files that are read for a grid or a network: itself, and those that it names.

    Of a Zarr folder they are all in it; of a pattern of names, all that fit it. Of what cannot be
    read it is the file itself.
    """
    file, _ = split_member(path)
    if is_store(file):
        return sorted(Path(at, name) for at, _, names in os.walk(file) for name in names)
    try:  # opening a pipe would block
        named = {file.parent / name for name in _names_in(file)} if file.is_file() else set()
        return [file, *sorted(each for each in named - {file} if each.is_file())]
    except (OSError, ValueError):
        return [file]


def _names_in(file: Path) -> Iterator[str]:
    kind = file.suffix.lower()
    if kind == ".hdr":
        yield from (f"{file.stem}.img", f"{file.stem}.img.gz")
    elif kind == ".onnx":
        content = file.read_bytes()
        for match in WEIGHTS.finditer(content):
            yield os.fsdecode(content[match.end() : match.end() + match[1][0]])
    elif kind in HEADERS:
        with file.open("rb") as header:
            text = header.read(LONGEST_HEADER).partition(b"\0")[0]  # then there is data
        for line in os.fsdecode(text).splitlines():
            value = re.split("[=:]", line, maxsplit=1)[-1].strip()
            yield from (line.strip(), value)
            if NUMBER.search(value):
                pattern = NUMBER.sub("*", glob.escape(value.split()[0]))
                yield from glob.glob(pattern, root_dir=file.parent)
