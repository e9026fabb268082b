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
from typing import Any, NamedTuple

from ..errors import FileError, OptionError
from ..files.formats import GRID_SUFFIXES, is_grid, mesh_path, split_member
from ..files.meshes import MESH_SUFFIXES, check_mesh_suffix
from ..files.regular import is_store, reason_of
from ..labels.files import with_numbers
from ..labels.names import Names
from ..options import BATCH_LISTS, GOALS, OPTIONS, ConvertOptions
from .job import Job
from .record import OWN_NAMES

LIST_SUFFIXES = (".txt", ".jsonl")
USAGE = 'give an object, {"in": "a.npy"}'
LONGEST = 240  # characters of a line or an error that a message quotes


class Inputs(NamedTuple):
    """The jobs, and the folders that could not be read, each with the reason."""

    jobs: list[Job]
    unread: list[tuple[str, str]]


def find_jobs(
    arguments: Sequence[str], suffix: str, options: ConvertOptions, names: Names | None = None
) -> Inputs:
    """Return the jobs that the arguments name, each once: files, folders, patterns, lists.

    ``suffix`` is the mesh file format, such as ".ply"; a list may say otherwise, and it may have
    other options. ``names`` are those of labels, in place of which jobs have numbers. OptionError
    if an argument names no grid, if two inputs would become one output, or if an option does not go
    with labels; FileError if a list, or the only folder, cannot be read.
    """
    unread: list[tuple[str, str]] = []
    chosen, by_target = with_numbers(options, names), dict[str, Job]()
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
    return Inputs(list(by_target.values()), list(dict.fromkeys(unread)))


def _expand(
    argument: str,
    suffix: str,
    options: ConvertOptions,
    names: Names | None,
    unread: list[tuple[str, str]],
) -> list[Job]:
    """Return the jobs that one argument stands for, and note the folders that cannot be read."""
    path = Path(argument)
    if argument and path.suffix.lower() in LIST_SUFFIXES and os.path.isfile(path):
        return _read_list(path, suffix, options, names)
    if is_store(path):
        root, paths = path.parent, [path]
    elif argument and os.path.isdir(path):
        root, paths = path, list(_files_below(path, unread))
    elif is_grid(path) and os.path.lexists(split_member(path)[0]):
        root, paths = split_member(path)[0].parent, [path]
    elif glob.has_magic(argument):
        fixed = next(i for i, part in enumerate(path.parts) if glob.has_magic(part))
        root, pattern = Path(*path.parts[:fixed]), str(Path(*path.parts[fixed:]))
        hidden = pattern.startswith(".") or f"{os.sep}." in pattern
        if pattern.endswith("**"):  # for pathlib the folders alone
            pattern = str(Path(pattern, "*"))
        found = root.glob(pattern)  # follows links to folders in a named part, but not for **
        paths = [p for p in found if hidden or not _is_hidden(p.relative_to(root))]
    elif not argument or not os.path.lexists(path):
        raise OptionError(
            f"{argument or repr(argument)} does not exist: give grids, folders, patterns or a list"
        )
    else:
        raise OptionError(
            f"{argument} is neither a grid ({', '.join(GRID_SUFFIXES)}) nor a list "
            f"({', '.join(LIST_SUFFIXES)})"
        )
    # Anything with a grid's suffix counts. If it is no regular file, its job fails and names it.
    grids = sorted({p for p in paths if is_grid(p) and (is_store(p) or not p.is_dir())})
    if not grids:
        if unread:
            raise FileError(" ".join(unread[-1]))
        raise OptionError(f"{argument} holds no grid ({', '.join(GRID_SUFFIXES)})")
    targets = (mesh_path(grid.relative_to(root), suffix, options.label) for grid in grids)
    return [Job(grid, target.as_posix(), options) for grid, target in zip(grids, targets)]


def _is_hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def _files_below(folder: Path, unread: list[tuple[str, str]]) -> Iterator[Path]:
    """Yield the files below a folder, and the folders that are grids."""

    def note(error: OSError) -> None:
        unread.append((str(error.filename), reason_of(error)))

    for path, folders, names in os.walk(folder, onerror=note):
        stores = [name for name in folders if is_store(Path(path, name))]
        folders[:] = [name for name in folders if name not in stores]
        yield from (Path(path, name) for name in (*stores, *names))


def _read_list(
    path: Path, suffix: str, options: ConvertOptions, names: Names | None
) -> list[Job]:
    """Return a job for each line of a list; OptionError with the number of one that is not valid.

    Blank lines, and in ``.txt`` lines that start with ``#``, are skipped. The text is UTF-8; a byte
    order mark and CRLF line ends are accepted.
    """
    try:
        lines = path.read_text("utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from None
    is_text, jobs = path.suffix.lower() == ".txt", []
    for number, line in enumerate(map(str.strip, lines), 1):
        if line and not (is_text and line.startswith("#")):
            try:
                entry = {"in": line} if is_text else _parse(line)
                jobs.append(_job(entry, path.parent, suffix, options, names))
            except OptionError as error:
                said = _shorten(str(error))
                raise OptionError(f"{path}, line {number}: {said}") from None
    if not jobs:
        raise OptionError(f"{path} names no file: give a path a line")
    return jobs


def _parse(line: str) -> dict[str, Any]:
    """Return the JSON object of a line."""
    try:
        entry = json.loads(line)
    except ValueError as error:
        raise OptionError(f"no JSON: {error}") from None
    except RecursionError:
        raise OptionError(f"nested too deeply: {USAGE}") from None
    if not isinstance(entry, dict):
        raise OptionError(f"{_shorten(line)}: {USAGE}")
    return entry


def _shorten(text: str) -> str:
    """Return a text for a message; the middle of a long one is left out."""
    half = LONGEST // 2
    return text if len(text) <= LONGEST else f"{text[:half]}...{text[-half:]}"


def _job(
    entry: dict[str, Any], home: Path, suffix: str, options: ConvertOptions, names: Names | None
) -> Job:
    """Return the job that a line describes."""
    source, target = entry.pop("in", None), entry.pop("out", None)
    if not isinstance(source, str) or PurePath(source).name in ("", ".."):
        raise OptionError(f"'in' is {source!r}: give the path of a grid")
    if unknown := sorted(entry.keys() - set(BATCH_LISTS)):
        raise OptionError(f"{unknown[0]!r} is unknown: give in, out, {', '.join(BATCH_LISTS)}")
    asked = {name: OPTIONS[name].check(value, repr(name)) for name, value in entry.items()}
    if asked.keys() & set(GOALS):  # one of them replaces the others
        asked = {**dict.fromkeys(GOALS), **asked}
    chosen = with_numbers(replace(options, **asked), names)
    if target is None:
        path = mesh_path(PurePath(source), suffix, chosen.label)
        path = PurePath(path.name) if _is_outside(path) else path
    else:
        path = PurePath(target) if isinstance(target, str) else PurePath()
        if path.suffix.lower() not in MESH_SUFFIXES:
            kinds = ", ".join(MESH_SUFFIXES)
            raise OptionError(f"'out' is {target!r}: give a file, one of {kinds}")
        if _is_outside(path):
            raise OptionError(f"'out' is {target!r}: give a path within the output folder")
    for name, given in (("in", source), ("out", str(path))):
        if not _is_possible(given):
            raise OptionError(f"{name!r} is {given!r}: no file can have this name")
    return Job(home / source, path.as_posix(), chosen)


def _is_outside(path: PurePath) -> bool:
    return path.is_absolute() or ".." in path.parts


def _is_possible(name: str) -> bool:
    """Return whether a file can have a name: without NUL and halves of surrogate pairs."""
    try:
        return b"\0" not in os.fsencode(name)
    except UnicodeEncodeError:
        return False
