"""Finds the inputs of a batch and names their outputs: files, folders, patterns and lists.

The folders below a given folder, or below the fixed part of a pattern, are mirrored in the output
folder. A list is ``.txt`` with a path per line, or ``.jsonl`` with an object per line.
"""

from __future__ import annotations

import glob
import json
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any

from ..errors import FileError, OptionError, seen
from ..files.formats import GRID_SUFFIXES, is_grid, is_store, mesh_path, reason_of, split_member
from ..files.meshes import MESH_SUFFIXES, check_mesh_suffix, has_parts
from ..labels.files import Names, with_numbers
from ..options import BATCH_LISTS, GOALS, Options
from .record import Row

LIST_SUFFIXES = (".txt", ".jsonl")
EXAMPLE = 'give an object such as {"in": "a.npy"}'


@dataclass
class Job:
    """A grid to convert, and what came of it, in this run or before."""

    source: Path  # as it was given
    mesh: str  # the mesh, below the output folder
    options: Options
    state: str = "to_do"  # or done, failed, done_before, failed_before, refused
    row: Row = field(default_factory=dict)  # its line of the report, once there is one

    @property
    def has_label_files(self) -> bool:
        """Whether each label has its own file, of a name that is known when it is written."""
        return self.options.labels is not None and not has_parts(self.mesh)

    @property
    def target(self) -> str:
        """The name of the output: of the mesh, or for files of labels a pattern, ``a-*.stl``."""
        path = PurePath(self.mesh)
        end = "-*" * self.has_label_files + path.suffix
        return path.with_name(path.stem + end).as_posix()

    def failed(self, reason: str, content: Any = None) -> Row:
        """Return the row of the job if it failed, to be tried again; no path begins the reason."""
        file, source = str(split_member(self.source)[0]), str(self.source)
        reason = re.sub(f"^({re.escape(source)}|{re.escape(file)}):? ", "", reason)
        reason = reason.replace(f"give {file}:", "give --grid ")  # what holds several arrays
        row: Row = {"in": os.path.abspath(source), "out": self.target, "status": "failed"}
        row |= {"reason": reason, "retry": True, "content": content}
        return {**row, "output": None, "seconds": 0.0}


def find_jobs(
    arguments: Sequence[str], suffix: str, options: Options, names: Names | None, member: str = ""
) -> list[Job]:
    """Return the jobs that the arguments name, each once: files, folders, patterns, lists.

    ``suffix`` is the mesh file format, such as ".ply"; a list may say otherwise, and have other
    options. ``names`` are those of labels, ``member`` the array of files for which none is named;
    meshes are not named after it. OptionError if an argument names no grid, or if two inputs would
    become one output; FileError if a list or a folder cannot be read.
    """
    by_target = dict[str, Job]()
    for argument in arguments:
        for job in _expand(argument, suffix, options):
            job.options = with_numbers(job.options, names)
            if member and not split_member(job.source)[1]:
                job.source = Path(f"{job.source}:{member}")
            other = by_target.setdefault(os.path.normcase(job.target), job)
            same = os.path.abspath(other.source) == os.path.abspath(job.source)
            if not (same and other.options == job.options):
                both = f"{other.source} and {job.source} would both become {job.target}"
                raise OptionError(f"{both}: rename one, or give 'out' in a .jsonl list")
            check_mesh_suffix(Path(job.mesh))
    return list(by_target.values())


def _expand(argument: str, suffix: str, options: Options) -> list[Job]:
    """Return the jobs that one argument stands for."""
    path, kinds, paths = Path(argument), ", ".join(GRID_SUFFIXES), list[Path]()
    if path.suffix.lower() in LIST_SUFFIXES and path.is_file():
        return list(_read_list(path, suffix, options))
    if argument and path.is_dir() and not is_store(path):
        root = path
        for at, folders, files in os.walk(path, onerror=_refuse_folder):
            stores = [name for name in folders if is_store(Path(at, name))]
            folders[:] = [name for name in folders if name not in stores]
            paths += [Path(at, n) for n in (*stores, *files) if not n.lower().endswith(".dcm")]
    elif is_grid(path) and os.path.lexists(split_member(path)[0]):
        root, paths = split_member(path)[0].parent, [path]
    elif glob.has_magic(argument):
        fixed = next(i for i, part in enumerate(path.parts) if glob.has_magic(part))
        root, parts = Path(*path.parts[:fixed]), list(path.parts[fixed:])
        parts += ["*"] * (parts[-1] == "**")  # for pathlib, ** are folders alone
        hidden = any(part.startswith(".") for part in parts)
        found = root.glob("/".join(parts))  # follows links to folders where they are named
        paths = [p for p in found if hidden or "/." not in f"/{p.relative_to(root).as_posix()}"]
    else:
        said = f"{argument} is neither a grid ({kinds}) nor a list ({', '.join(LIST_SUFFIXES)})"
        if not argument or not os.path.lexists(path):
            said = f"{argument or repr(argument)} does not exist: give grids, folders or lists"
        raise OptionError(said)
    # Anything with a grid's suffix counts, but slices. What is no regular file fails and is named.
    grids = sorted({p for p in paths if is_grid(p) and (is_store(p) or not p.is_dir())})
    if not grids:
        raise OptionError(f"{argument} holds no grid ({kinds})")
    targets = (mesh_path(grid.relative_to(root), suffix, options.label) for grid in grids)
    return [Job(grid, target.as_posix(), options) for grid, target in zip(grids, targets)]


def _refuse_folder(error: OSError) -> None:
    raise FileError(f"{error.filename} {reason_of(error)}")


def _read_list(path: Path, suffix: str, options: Options) -> Iterator[Job]:
    """Yield a job for each line of a list; OptionError with the number of one that is not valid."""
    try:
        lines = path.read_text("utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from None
    is_text = path.suffix.lower() == ".txt"
    if not any(map(str.strip, lines)):
        raise OptionError(f"{path} names no file: give a path a line")
    for number, line in enumerate(map(str.strip, lines), 1):
        if not line or (is_text and line.startswith("#")):
            continue
        try:
            entry = {"in": line} if is_text else json.loads(line)
            if not isinstance(entry, dict):
                raise OptionError(f"it is {seen(entry)}: {EXAMPLE}")
            yield _job_of(entry, path.parent, suffix, options)
        except (OptionError, json.JSONDecodeError, RecursionError) as error:
            said = str(error)
            if not isinstance(error, OptionError):
                at = getattr(error, "pos", 0)
                said = f"no JSON from character {at + 1} on, {seen(line[at:])}: {EXAMPLE}"
            raise OptionError(f"{path}, line {number}: {said}") from None


def _job_of(entry: dict[str, Any], home: Path, suffix: str, options: Options) -> Job:
    """Return the job that a line describes."""
    source, target = entry.pop("in", None), entry.pop("out", None)
    if not isinstance(source, str) or PurePath(source).name in ("", "..") or "\0" in source:
        raise OptionError(f"'in' is {seen(source)}: give the path of a grid")
    if unknown := sorted(entry.keys() - set(BATCH_LISTS)):
        raise OptionError(f"{seen(unknown[0])} is unknown: give in, out, {', '.join(BATCH_LISTS)}")
    if entry.keys() & set(GOALS):  # one of them replaces the others
        entry = {**dict.fromkeys(GOALS), **entry}
    chosen = replace(options, **entry)
    if target is None:
        path = mesh_path(PurePath(source), suffix, chosen.label)
        inside = not path.is_absolute() and ".." not in path.parts
        return Job(home / source, path.as_posix() if inside else path.name, chosen)
    path = PurePath(target) if isinstance(target, str) else PurePath()
    give = f"a file, one of {', '.join(MESH_SUFFIXES)}"
    if path.suffix.lower() in MESH_SUFFIXES:
        give = "a path within the output folder" * (path.is_absolute() or ".." in path.parts)
    if give:
        raise OptionError(f"'out' is {seen(target)}: give {give}")
    return Job(home / source, path.as_posix(), chosen)
