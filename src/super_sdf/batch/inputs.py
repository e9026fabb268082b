"""Finds the inputs of a batch and names their outputs: files, folders, patterns and manifests.

The folders below a given folder, or below the fixed part of a pattern, are mirrored in the output
folder. Links to folders are followed where a pattern names them, but not below a folder or by
``**``, so circular links do no harm. All arguments are checked here, before the work starts.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path, PurePath
from typing import NamedTuple

from ..errors import FileError, OptionError
from ..files.formats import GRID_SUFFIXES, is_grid, mesh_path, split_member
from ..files.meshes import check_mesh_suffix
from ..files.regular import is_store, reason_of
from ..labels.files import with_numbers
from ..labels.names import Names
from ..options import ConvertOptions
from .job import Job
from .ledger import LOCK_NAME, NAME, STARTED_NAME
from .manifest import read_manifest

MANIFEST_SUFFIXES = (".txt", ".jsonl")


class Inputs(NamedTuple):
    """The jobs, and the folders that could not be read, each with the reason."""

    jobs: list[Job]
    unread: list[tuple[str, str]]


def find_jobs(
    arguments: Sequence[str], suffix: str, options: ConvertOptions, names: Names | None = None
) -> Inputs:
    """Return the jobs that the arguments name, each once: files, folders, patterns, manifests.

    ``suffix`` is the mesh file format, such as ".ply"; a manifest may say otherwise, and it may
    have other options. ``names`` are those of labels, in place of which jobs have numbers.
    OptionError if an argument names no grid, if two inputs would become one output, or if an option
    does not go with labels; FileError if a manifest, or the only folder, cannot be read.
    """
    search = _Search(suffix, with_numbers(options, names), names)
    jobs = _each_once([job for argument in arguments for job in search.expand(argument)])
    for kind, unit in {(PurePath(job.target).suffix, job.options.unit) for job in jobs}:
        check_mesh_suffix(Path(f"*{kind}"), unit)
    for job in jobs:
        if PurePath(job.target).parts[0].casefold() in (LOCK_NAME, NAME, STARTED_NAME):
            raise OptionError(
                f"{job.source} would become {job.target}, but the first of these names is the "
                "batch's own: rename it"
            )
    return Inputs(jobs, list(dict.fromkeys(search.unread)))


def _each_once(jobs: Iterable[Job]) -> list[Job]:
    """Return the jobs without repetitions; raise OptionError for two inputs of one output."""
    by_target: dict[str, Job] = {}
    for job in jobs:
        other = by_target.setdefault(os.path.normcase(job.target), job)
        same = os.path.abspath(other.source) == os.path.abspath(job.source)
        if not (same and other.options == job.options):
            raise OptionError(
                f"{other.source} and {job.source} would both become {job.target}: rename one, or "
                "give 'out' in a .jsonl manifest"
            )
    return list(by_target.values())


class _Search:
    """Expands arguments into jobs; ``unread`` lists the folders that could not be read."""

    def __init__(self, suffix: str, options: ConvertOptions, names: Names | None) -> None:
        self.suffix, self.options, self.names = suffix, options, names
        self.unread: list[tuple[str, str]] = []

    def expand(self, argument: str) -> list[Job]:
        """Return the jobs that one argument stands for."""
        path, suffix = Path(argument), Path(argument).suffix.lower()
        if is_store(path):
            return self._below(path.parent, [path], argument)
        if argument and os.path.isdir(path):
            return self._below(path, self._files_below(path), argument)
        if suffix in MANIFEST_SUFFIXES and os.path.isfile(path):
            return read_manifest(path, self.suffix, self.options, self.names)
        if is_grid(path) and os.path.lexists(file := split_member(path)[0]):
            return self._below(file.parent, [path], argument)
        if glob.has_magic(argument):
            first = next(i for i, part in enumerate(path.parts) if glob.has_magic(part))
            root = Path(*path.parts[:first])
            return self._below(root, self._matches(root, path.parts[first:]), argument)
        if not argument or not os.path.lexists(path):
            raise OptionError(
                f"{argument or repr(argument)} does not exist: give grids, folders, patterns or a "
                "manifest"
            )
        raise OptionError(
            f"{argument} is neither a grid ({', '.join(GRID_SUFFIXES)}) nor a manifest "
            f"({', '.join(MANIFEST_SUFFIXES)})"
        )

    def _below(self, root: Path, paths: Iterable[Path], argument: str) -> list[Job]:
        """Return a job for every grid among the paths; outputs mirror the folders below root.

        Anything with a grid's suffix counts. If it is no regular file, its job fails and names it.
        """
        grids = sorted(
            path for path in paths if is_grid(path) and (is_store(path) or not path.is_dir())
        )
        if not grids:
            if self.unread:
                raise FileError(" ".join(self.unread[-1]))
            raise OptionError(f"{argument} holds no grid ({', '.join(GRID_SUFFIXES)})")
        label = self.options.label
        targets = (mesh_path(path.relative_to(root), self.suffix, label) for path in grids)
        return [Job(p, target.as_posix(), self.options) for p, target in zip(grids, targets)]

    def _walk(self, folder: Path) -> Iterator[tuple[Path, list[str], list[str]]]:
        """Walk down a folder as ``os.walk``, noting what cannot be read; nothing for a file."""

        def note(error: OSError) -> None:
            if not isinstance(error, (NotADirectoryError, FileNotFoundError)):
                self.unread.append((str(error.filename), reason_of(error)))

        for path, folders, names in os.walk(folder, onerror=note):
            yield Path(path), folders, names

    def _files_below(self, folder: Path) -> Iterator[Path]:
        """Yield what is below a folder and no folder itself, or a folder that is a grid."""
        for path, folders, names in self._walk(folder):
            stores = [name for name in folders if is_store(path / name)]
            folders[:] = [name for name in folders if name not in stores]
            yield from (path / name for name in (*stores, *names))

    def _matches(self, root: Path, parts: Sequence[str]) -> list[Path]:
        """Return the paths that the parts of a glob pattern match below a folder, each once."""
        paths = [root]
        for part in parts:
            paths = list(dict.fromkeys(path for s in paths for path in self._step(s, part)))
        return paths

    def _step(self, path: Path, part: str) -> Iterator[Path]:
        """Yield the paths in a folder that match one part of a pattern, as in a shell."""
        if part == "**":
            yield from self._visible_below(path)
        elif glob.has_magic(part):
            _, folders, names = next(self._walk(path), (path, [], []))
            for name in (*folders, *names):
                if fnmatch(name, part) and (part.startswith(".") or not name.startswith(".")):
                    yield path / name
        elif os.path.lexists(path / part):
            yield path / part

    def _visible_below(self, path: Path) -> Iterator[Path]:
        """Yield a path, and everything below it that is not hidden."""
        yield path
        for folder, folders, names in self._walk(path):
            kept = [folder / name for name in folders if not name.startswith(".")]
            kept = [below for below in kept if not below.is_symlink()]
            folders[:] = [below.name for below in kept if not is_store(below)]
            yield from kept
            yield from (folder / name for name in names if not name.startswith("."))
