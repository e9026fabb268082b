"""Lists of inputs: ``.txt``, a path a line, or ``.jsonl``, a JSON object a line.

    {"in": "a.npy", "out": "parts/a.stl", "spacing": 0.5, "inside": "negative"}

Inputs are relative to the manifest, outputs to the output folder. Blank lines, and in ``.txt``
those that start with ``#``, are passed over. Options are those of ``ConvertOptions``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

from ..convert import ConvertOptions
from ..errors import FileError, OptionError
from ..files.meshes import MESH_SUFFIXES
from ..nodes import check_factor
from ..sides import INSIDE
from .job import Job

Entry = dict[str, Any]


def read_manifest(path: Path, suffix: str, options: ConvertOptions) -> list[Job]:
    """Return a job a line.

    Raises
    ------
    FileError
        If the file cannot be read.
    OptionError
        If a line has no meaning; it is named.
    """
    jobs = []
    for number, entry in _entries(path):
        try:
            jobs.append(_job(entry, path.parent, suffix, options))
        except OptionError as error:
            raise OptionError(f"{path}, line {number}: {error}") from None
    if not jobs:
        raise OptionError(f"{path} names no file: give a path a line")
    return jobs


def _entries(path: Path) -> Iterator[tuple[int, Entry]]:
    """Yield the number and the content of each line that has one."""
    try:
        lines = path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from None
    for number, line in enumerate(map(str.strip, lines), 1):
        if path.suffix.lower() == ".txt" and line and not line.startswith("#"):
            yield number, {"in": line}
        elif path.suffix.lower() == ".jsonl" and line:
            yield number, _parse(line, f"{path}, line {number}")


def _parse(line: str, where: str) -> Entry:
    """Return a line's JSON object."""
    try:
        entry = json.loads(line)
    except ValueError as error:
        raise OptionError(f"{where} is no JSON: {error}") from None
    if not isinstance(entry, dict):
        raise OptionError(f'{where} is {line}: give an object, {{"in": "a.npy"}}')
    return entry


def _job(entry: Entry, home: Path, suffix: str, options: ConvertOptions) -> Job:
    """Return what a line asks for."""
    source, target = entry.pop("in", None), entry.pop("out", None)
    if not isinstance(source, str) or not source:
        raise OptionError(f"'in' is {source!r}: give the path of a grid")
    unknown = sorted(entry.keys() - CHECKS.keys())
    if unknown:
        raise OptionError(f"{unknown[0]!r} is unknown: give in, out, {', '.join(CHECKS)}")
    asked = {name: CHECKS[name](name, value) for name, value in entry.items()}
    name = _default_target(source, suffix) if target is None else _check_target(target)
    return Job(home / source, name.as_posix(), replace(options, **asked))


def _default_target(source: str, suffix: str) -> PurePath:
    """Return where a mesh goes: below the output folder as the grid is below the manifest."""
    path = PurePath(source).with_suffix(suffix)
    return PurePath(path.name) if path.is_absolute() or ".." in path.parts else path


def _check_target(target: Any) -> PurePath:
    """Return a path that stays within the output folder and has a mesh's suffix."""
    path = PurePath(target) if isinstance(target, str) else PurePath()
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise OptionError(f"'out' is {target!r}: give a file, one of {', '.join(MESH_SUFFIXES)}")
    if path.is_absolute() or ".." in path.parts:
        raise OptionError(f"'out' is {target!r}: give a path within the output folder")
    return path


def _factor(name: str, value: Any) -> int:
    if type(value) is not int:
        raise OptionError(f"{name!r} is {value!r}: give a whole number")
    check_factor(value)
    return value


def _number(name: str, value: Any) -> float:
    if type(value) not in (int, float):
        raise OptionError(f"{name!r} is {value!r}: give a number")
    return float(value)


def _numbers(name: str, value: Any) -> tuple[float, ...]:
    numbers = value if isinstance(value, list) else [value]
    if len(numbers) not in (1, 3):
        raise OptionError(f"{name!r} is {value!r}: give one number, or a list of three")
    return tuple(_number(name, number) for number in numbers)


def _inside(name: str, value: Any) -> str:
    if value not in INSIDE:
        raise OptionError(f"{name!r} is {value!r}: give one of {', '.join(INSIDE)}")
    return str(value)


def _flag(name: str, value: Any) -> bool:
    if type(value) is not bool:
        raise OptionError(f"{name!r} is {value!r}: give true or false")
    return value


CHECKS: dict[str, Callable[[str, Any], Any]] = {
    "factor": _factor,
    "spacing": _numbers,
    "origin": _numbers,
    "inside": _inside,
    "offset": _number,
    "cap": _flag,
}
