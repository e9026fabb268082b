"""Which files a batch converts, and to which: files, folders, patterns and manifests.

Below a folder, and below the fixed part of a pattern, the folders of the inputs are those of the
outputs. Everything that can be refused is refused here, before the work starts.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePath

from ..convert import ConvertOptions
from ..errors import OptionError
from ..files.grids import GRID_SUFFIXES
from ..files.meshes import check_mesh_suffix
from .job import Job
from .manifest import read_manifest

MANIFEST_SUFFIXES = (".txt", ".jsonl")


def find_jobs(arguments: Sequence[str], suffix: str, options: ConvertOptions) -> list[Job]:
    """Return what the arguments name, each once.

    Parameters
    ----------
    arguments : sequence of str
        Files, folders, glob patterns, manifests.
    suffix : str
        Of the meshes, ".ply" say.
    options : ConvertOptions
        For all files, unless a manifest says otherwise.

    Raises
    ------
    OptionError
        If an argument names no grid, or if two inputs would become one output.
    FileError
        If a manifest cannot be read.
    """
    found = [job for argument in arguments for job in _expand(argument, suffix, options)]
    for kind in {PurePath(job.target).suffix for job in found}:
        check_mesh_suffix(Path(f"*{kind}"))
    return _each_once(found)


def _expand(argument: str, suffix: str, options: ConvertOptions) -> list[Job]:
    """Return the jobs that one argument stands for."""
    path = Path(argument)
    if path.is_dir():
        return _below(path, path.rglob("*"), suffix, options, argument)
    if path.suffix.lower() in MANIFEST_SUFFIXES and path.is_file():
        return read_manifest(path, suffix, options)
    if path.suffix.lower() in GRID_SUFFIXES and path.exists():
        return _below(path.parent, [path], suffix, options, argument)
    if glob.has_magic(argument):
        matches = map(Path, glob.iglob(argument, recursive=True))
        return _below(_fixed_part(path), matches, suffix, options, argument)
    if not path.exists():
        raise OptionError(f"{argument} does not exist: give grids, folders, patterns or a manifest")
    raise OptionError(
        f"{argument} is neither a grid ({', '.join(GRID_SUFFIXES)}) nor a manifest "
        f"({', '.join(MANIFEST_SUFFIXES)})"
    )


def _below(
    root: Path, paths: Iterable[Path], suffix: str, options: ConvertOptions, argument: str
) -> list[Job]:
    """Return a job for every grid among the paths; the outputs mirror the folders below root."""
    grids = sorted(p for p in paths if p.suffix.lower() in GRID_SUFFIXES and not p.is_dir())
    if not grids:
        raise OptionError(f"{argument} holds no {' or '.join(GRID_SUFFIXES)} file")
    return [Job(p, p.relative_to(root).with_suffix(suffix).as_posix(), options) for p in grids]


def _fixed_part(pattern: Path) -> Path:
    """Return the folder above the first part of a pattern that is one."""
    parts = pattern.parts
    first = next(i for i, part in enumerate(parts) if glob.has_magic(part))
    return Path(*parts[:first])


def _each_once(jobs: Iterable[Job]) -> list[Job]:
    """Return the jobs without repetitions; refuse two inputs for one output."""
    by_target: dict[str, Job] = {}
    for job in jobs:
        other = by_target.setdefault(os.path.normcase(job.target), job)
        if _what(other) != _what(job):
            raise OptionError(
                f"{other.source} and {job.source} would both become {job.target}: rename one, or "
                "give 'out' in a .jsonl manifest"
            )
    return list(by_target.values())


def _what(job: Job) -> tuple[str, ConvertOptions]:
    return os.path.abspath(job.source), job.options
