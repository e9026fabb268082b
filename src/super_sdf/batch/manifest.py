"""Manifests, lists of inputs: ``.txt`` with a path per line, ``.jsonl`` with an object per line.

    {"in": "a.npy", "out": "parts/a.stl", "spacing": 0.5, "inside": "negative"}

Inputs are relative to the manifest, outputs to the output folder. Blank lines, and in ``.txt``
lines that start with ``#``, are skipped. Options are those of ``options.BATCH_LISTS``. The text is
UTF-8; a byte order mark and CRLF line ends are accepted.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

from ..errors import FileError, OptionError
from ..files.formats import mesh_path
from ..files.meshes import MESH_SUFFIXES
from ..labels.files import with_numbers
from ..labels.names import Names
from ..options import BATCH_LISTS, GOALS, OPTIONS, ConvertOptions
from .job import Job

Entry = dict[str, Any]
USAGE = 'give an object, {"in": "a.npy"}'
LONGEST = 240  # characters of a line or an error that a message quotes


def read_manifest(
    path: Path, suffix: str, options: ConvertOptions, names: Names | None = None
) -> list[Job]:
    """Return a job for each line; OptionError with the number of one that is not valid."""
    jobs = []
    for number, line in _lines(path):
        where = f"{path}, line {number}"
        entry = {"in": line} if path.suffix.lower() == ".txt" else _parse(line, where)
        try:
            jobs.append(_job(entry, path.parent, suffix, options, names))
        except OptionError as error:
            raise OptionError(f"{where}: {_shorten(str(error))}") from None
    if not jobs:
        raise OptionError(f"{path} names no file: give a path a line")
    return jobs


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of each line that is not blank or a comment."""
    try:
        lines = path.read_text("utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from None
    comment = "#" if path.suffix.lower() == ".txt" else "\n"
    for number, line in enumerate(map(str.strip, lines), 1):
        if line and not line.startswith(comment):
            yield number, line


def _parse(line: str, where: str) -> Entry:
    """Return a line's JSON object."""
    try:
        entry = json.loads(line, object_pairs_hook=_unique_keys, parse_constant=_refuse_constant)
    except OptionError as error:
        raise OptionError(f"{where}: {_shorten(str(error))}") from None
    except ValueError as error:
        raise OptionError(f"{where} is no JSON: {error}") from None
    except RecursionError:
        raise OptionError(f"{where} is nested too deeply: {USAGE}") from None
    if not isinstance(entry, dict):
        raise OptionError(f"{where} is {_shorten(line)}: {USAGE}")
    return entry


def _unique_keys(pairs: list[tuple[str, Any]]) -> Entry:
    entry: Entry = {}
    for name, value in pairs:
        if name in entry:
            raise OptionError(f"{name!r} is there twice: give it once")
        entry[name] = value
    return entry


def _refuse_constant(name: str) -> float:
    """Raise OptionError for NaN and infinities: Python's parser accepts them, JSON has none."""
    raise OptionError(f"{name} is no number: give a finite one")


def _shorten(text: str) -> str:
    """Return a text for a message; the middle of a long one is left out."""
    half = LONGEST // 2
    return text if len(text) <= LONGEST else f"{text[:half]}...{text[-half:]}"


def _job(
    entry: Entry, home: Path, suffix: str, options: ConvertOptions, names: Names | None
) -> Job:
    """Return the job that a line describes."""
    source, target = entry.pop("in", None), entry.pop("out", None)
    if not isinstance(source, str) or not source:
        raise OptionError(f"'in' is {source!r}: give the path of a grid")
    _check_name("in", source)
    unknown = sorted(entry.keys() - set(BATCH_LISTS))
    if unknown:
        raise OptionError(f"{unknown[0]!r} is unknown: give in, out, {', '.join(BATCH_LISTS)}")
    asked = {name: OPTIONS[name].check(value, repr(name)) for name, value in entry.items()}
    if asked.keys() & set(GOALS):  # one of them replaces the others
        asked = {**dict.fromkeys(GOALS), **asked}
    chosen = with_numbers(replace(options, **asked), names)
    named = target is not None
    name = _given_target(target) if named else _target_of(source, suffix, chosen.label)
    return Job(home / source, name.as_posix(), chosen)


def _target_of(source: str, suffix: str, label: int | None) -> PurePath:
    """Return the path of a mesh in the output folder: that of the grid below the manifest."""
    if PurePath(source).name in ("", ".."):
        raise OptionError(f"'in' is {source!r}: give the path of a grid")
    path = mesh_path(PurePath(source), suffix, label)
    return PurePath(path.name) if path.is_absolute() or ".." in path.parts else path


def _given_target(target: Any) -> PurePath:
    path = PurePath(target) if isinstance(target, str) else PurePath()
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise OptionError(f"'out' is {target!r}: give a file, one of {', '.join(MESH_SUFFIXES)}")
    if path.is_absolute() or ".." in path.parts:
        raise OptionError(f"'out' is {target!r}: give a path within the output folder")
    _check_name("out", target)
    return path


def _check_name(name: str, path: str) -> None:
    """Raise OptionError for impossible file names: with a NUL, or half a surrogate pair."""
    try:
        is_impossible = b"\0" in os.fsencode(path)
    except UnicodeEncodeError:
        is_impossible = True
    if is_impossible:
        raise OptionError(f"{name!r} is {path!r}: no file can have this name")
