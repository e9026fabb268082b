"""Finds the inputs of a batch and names their outputs: files, folders, patterns and lists.

The folders below a given folder, or below the fixed part of a pattern, are mirrored in the output
folder. A list is ``.txt`` with a path per line, or ``.jsonl`` with an object per line:

    {"in": "a.npy", "out": "parts/a.stl", "spacing": 0.5, "inside": "negative"}

Inputs are relative to the list, outputs to the output folder; the other keys are options.
"""

from __future__ import annotations

import glob
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

from ..errors import FileError, OptionError
from ..files.formats import GRID_SUFFIXES, is_grid, mesh_path, split_member
from ..files.meshes import MESH_SUFFIXES, check_mesh_suffix
from ..files.regular import is_store, reason_of
from ..labels.files import Names, with_numbers
from ..options import BATCH_LISTS, GOALS, OPTIONS, Options
from .job import Job
from .record import OWN_NAMES

LIST_SUFFIXES = (".txt", ".jsonl")
USAGE = 'give an object, {"in": "a.npy"}'
LONGEST = 120  # characters of each end of a line that a message quotes

Unread = list[tuple[str, str]]
"""Folders that could not be read, each with the reason."""


def find_jobs(
    arguments: Sequence[str], suffix: str, options: Options, names: Names | None = None
) -> tuple[list[Job], Unread]:
    """Return the jobs that the arguments name, each once: files, folders, patterns, lists.

    ``suffix`` is the mesh file format, such as ".ply"; a list may say otherwise, and it may have
    other options. ``names`` are those of labels, in place of which jobs have numbers. OptionError
    if an argument names no grid, if two inputs would become one output, or if an option does not go
    with labels; FileError if a list, or the only folder, cannot be read.
    """
    unread, by_target = Unread(), dict[str, Job]()
    chosen = with_numbers(options, names)
    for argument in arguments:
        for job in _expand(argument, suffix, chosen, names, unread):
            other = by_target.setdefault(os.path.normcase(job.target), job)
            same = os.path.abspath(other.source) == os.path.abspath(job.source)
            if not (same and other.options == job.options):
                raise OptionError(
                    f"{other.source} and {job.source} would both become {job.target}: rename one, "
                    "or give 'out' in a .jsonl list"
                )
            check_mesh_suffix(Path(job.mesh), job.options.unit)
            if PurePath(job.target).parts[0].casefold() in OWN_NAMES:
                raise OptionError(
                    f"{job.source} would become {job.target}, but the first of these names is the "
                    "batch's own: rename it"
                )
    return list(by_target.values()), list(dict.fromkeys(unread))


def _expand(
    argument: str, suffix: str, options: Options, names: Names | None, unread: Unread
) -> list[Job]:
    """Return the jobs that one argument stands for, and note the folders that cannot be read."""
    path, kinds = Path(argument), ", ".join(GRID_SUFFIXES)
    if path.suffix.lower() in LIST_SUFFIXES and path.is_file():
        return list(_read_list(path, suffix, options, names))
    if argument and path.is_dir() and not is_store(path):
        root, paths = path, list(_files_below(path, unread))
    elif is_grid(path) and os.path.lexists(split_member(path)[0]):
        root, paths = split_member(path)[0].parent, [path]
    elif glob.has_magic(argument):
        fixed = next(i for i, part in enumerate(path.parts) if glob.has_magic(part))
        root, parts = Path(*path.parts[:fixed]), list(path.parts[fixed:])
        parts += ["*"] * (parts[-1] == "**")  # for pathlib, ** are folders alone
        found = root.glob("/".join(parts))  # follows links to folders where they are named
        hidden = any(part.startswith(".") for part in parts)
        shown = (p for p in found if hidden or "/." not in f"/{p.relative_to(root).as_posix()}")
        paths = list(shown)
    elif not argument or not os.path.lexists(path):
        said = f"{argument or repr(argument)} does not exist"
        raise OptionError(f"{said}: give grids, folders, patterns or a list")
    else:
        lists = ", ".join(LIST_SUFFIXES)
        raise OptionError(f"{argument} is neither a grid ({kinds}) nor a list ({lists})")
    # Anything with a grid's suffix counts. If it is no regular file, its job fails and names it.
    grids = sorted({p for p in paths if is_grid(p) and (is_store(p) or not p.is_dir())})
    if not grids and unread:
        raise FileError(" ".join(unread[-1]))
    if not grids:
        raise OptionError(f"{argument} holds no grid ({kinds})")
    targets = (mesh_path(grid.relative_to(root), suffix, options.label) for grid in grids)
    return [Job(grid, target.as_posix(), options) for grid, target in zip(grids, targets)]


def _files_below(folder: Path, unread: Unread) -> Iterator[Path]:
    """Yield the files below a folder, and the folders that are grids."""

    def note(error: OSError) -> None:
        unread.append((str(error.filename), reason_of(error)))

    for path, folders, names in os.walk(folder, onerror=note):
        stores = [name for name in folders if is_store(Path(path, name))]
        folders[:] = [name for name in folders if name not in stores]
        yield from (Path(path, name) for name in (*stores, *names))


def _read_list(path: Path, suffix: str, options: Options, names: Names | None) -> Iterator[Job]:
    """Yield a job for each line of a list; OptionError with the number of one that is not valid.

    Blank lines, and in ``.txt`` lines that start with ``#``, are skipped. The text is UTF-8; a byte
    order mark and CRLF line ends are accepted.
    """
    try:
        lines = path.read_text("utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from None
    is_text = path.suffix.lower() == ".txt"
    if not any(map(str.strip, lines)):
        raise OptionError(f"{path} names no file: give a path a line")
    for number, line in enumerate(map(str.strip, lines), 1):
        if line and not (is_text and line.startswith("#")):
            try:
                entry = {"in": line} if is_text else json.loads(line)
                if not isinstance(entry, dict):
                    raise OptionError(f"{line}: {USAGE}")
                yield _job(entry, path.parent, suffix, options, names)
            except (ValueError, RecursionError) as error:
                kind = "" if isinstance(error, OptionError) else "no JSON: "
                said = f"{kind}{error}"
                if len(said) > 2 * LONGEST:
                    said = f"{said[:LONGEST]}...{said[-LONGEST:]}"
                raise OptionError(f"{path}, line {number}: {said}") from None


def _job(
    entry: dict[str, Any], home: Path, suffix: str, options: Options, names: Names | None
) -> Job:
    """Return the job that a line describes."""
    source, target = entry.pop("in", None), entry.pop("out", None)
    if not isinstance(source, str) or PurePath(source).name in ("", "..") or "\0" in source:
        raise OptionError(f"'in' is {source!r}: give the path of a grid")
    if unknown := sorted(entry.keys() - set(BATCH_LISTS)):
        raise OptionError(f"{unknown[0]!r} is unknown: give in, out, {', '.join(BATCH_LISTS)}")
    asked = {name: OPTIONS[name].check(value, repr(name)) for name, value in entry.items()}
    if asked.keys() & set(GOALS):  # one of them replaces the others
        asked = {**dict.fromkeys(GOALS), **asked}
    chosen = with_numbers(replace(options, **asked), names)
    if target is None:
        path = mesh_path(PurePath(source), suffix, chosen.label)
        inside = not path.is_absolute() and ".." not in path.parts
        return Job(home / source, path.as_posix() if inside else path.name, chosen)
    path = PurePath(target) if isinstance(target, str) else PurePath()
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise OptionError(f"'out' is {target!r}: give a file, one of {', '.join(MESH_SUFFIXES)}")
    if path.is_absolute() or ".." in path.parts:
        raise OptionError(f"'out' is {target!r}: give a path within the output folder")
    return Job(home / source, path.as_posix(), chosen)
