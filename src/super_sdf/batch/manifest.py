"""Manifests, lists of inputs: ``.txt`` with a path per line, ``.jsonl`` with an object per line.

    {"in": "a.npy", "out": "parts/a.stl", "spacing": 0.5, "inside": "negative"}

Inputs are relative to the manifest, outputs to the output folder. Blank lines, and in ``.txt``
lines that start with ``#``, are skipped. Options are those of ``ConvertOptions``. The text is
UTF-8; a byte order mark and CRLF line ends are accepted.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

from ..convert import ConvertOptions
from ..errors import FileError, OptionError
from ..files.formats import AXES, mesh_path
from ..files.meshes import MESH_SUFFIXES
from ..grid.field import FIELDS, check_label
from ..grid.sides import INSIDE
from ..options import check_error, check_goal, check_triangles
from ..steps.mesher_names import MESHERS
from ..steps.nodes import check_factor
from .job import Job

Entry = dict[str, Any]
USAGE = 'give an object, {"in": "a.npy"}'
LONGEST = 240  # characters of a line or an error that a message quotes


def read_manifest(path: Path, suffix: str, options: ConvertOptions) -> list[Job]:
    """Return a job for each line.

    Raises
    ------
    FileError
        If the file cannot be read.
    OptionError
        If a line is not valid; the message has its number.
    """
    jobs = []
    for number, entry in _entries(path):
        try:
            jobs.append(_job(entry, path.parent, suffix, options))
        except OptionError as error:
            raise OptionError(f"{path}, line {number}: {shorten(str(error))}") from None
    if not jobs:
        raise OptionError(f"{path} names no file: give a path a line")
    return jobs


def _entries(path: Path) -> Iterator[tuple[int, Entry]]:
    """Yield the number and the entry of each line that is not blank or a comment."""
    try:
        lines = path.read_text("utf-8-sig").split("\n")
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
        entry = json.loads(line, object_pairs_hook=_unique_keys, parse_constant=_refuse_constant)
    except OptionError as error:
        raise OptionError(f"{where}: {shorten(str(error))}") from None
    except ValueError as error:
        raise OptionError(f"{where} is no JSON: {error}") from None
    except RecursionError:
        raise OptionError(f"{where} is nested too deeply: {USAGE}") from None
    if not isinstance(entry, dict):
        raise OptionError(f"{where} is {shorten(line)}: {USAGE}")
    return entry


def _unique_keys(pairs: list[tuple[str, Any]]) -> Entry:
    """Return an object of JSON; raise OptionError if it has a key twice."""
    entry = dict(pairs)
    if len(entry) < len(pairs):
        names = [name for name, _ in pairs]
        double = next(name for name in names if names.count(name) > 1)
        raise OptionError(f"{double!r} is there twice: give it once")
    return entry


def _refuse_constant(name: str) -> float:
    """Raise OptionError for NaN and infinities: Python's parser accepts them, JSON has none."""
    raise OptionError(f"{name} is no number: give a finite one")


def shorten(text: str) -> str:
    """Return a text for a message; the middle of a long one is left out."""
    half = LONGEST // 2
    return text if len(text) <= LONGEST else f"{text[:half]}...{text[-half:]}"


def _job(entry: Entry, home: Path, suffix: str, options: ConvertOptions) -> Job:
    """Return the job that a line describes."""
    source, target = entry.pop("in", None), entry.pop("out", None)
    if not isinstance(source, str) or not source:
        raise OptionError(f"'in' is {source!r}: give the path of a grid")
    _check_name("in", source)
    unknown = sorted(entry.keys() - CHECKS.keys())
    if unknown:
        raise OptionError(f"{unknown[0]!r} is unknown: give in, out, {', '.join(CHECKS)}")
    asked = {name: CHECKS[name](name, value) for name, value in entry.items()}
    label = asked.get("label", options.label)
    name = _default_target(source, suffix, label) if target is None else _check_target(target)
    if asked.keys() & {"simplify", "triangles"}:  # one of them replaces the other
        asked = {"simplify": None, "triangles": None, **asked}
        check_goal(asked["simplify"], asked["triangles"], ("'simplify'", "'triangles'"))
    return Job(home / source, name.as_posix(), replace(options, **asked))


def _default_target(source: str, suffix: str, label: int | None) -> PurePath:
    """Return the path of a mesh in the output folder: that of the grid below the manifest."""
    if PurePath(source).name in ("", ".."):
        raise OptionError(f"'in' is {source!r}: give the path of a grid")
    path = mesh_path(PurePath(source), suffix, label)
    return PurePath(path.name) if path.is_absolute() or ".." in path.parts else path


def _check_target(target: Any) -> PurePath:
    """Return the path given for a mesh; raise OptionError if it leaves the output folder, say."""
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


def _factor(name: str, value: Any) -> int:
    if type(value) is not int:
        raise OptionError(f"{name!r} is {value!r}: give a whole number")
    check_factor(value)
    return value


def _number(name: str, value: Any) -> float:
    if type(value) not in (int, float):
        raise OptionError(f"{name!r} is {value!r}: give a number")
    try:
        number = float(value)
    except OverflowError:  # a whole number beyond 1.8e308
        number = math.inf
    if not math.isfinite(number):
        raise OptionError(f"{name!r} is {value!r}: give a finite number")
    return number


def _numbers(name: str, value: Any) -> tuple[float, ...]:
    numbers = value if isinstance(value, list) else [value]
    if len(numbers) not in (1, 3):
        raise OptionError(f"{name!r} is {value!r}: give one number, or a list of three")
    return tuple(_number(name, number) for number in numbers)


def _direction(name: str, value: Any) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != 9:
        raise OptionError(f"{name!r} is {value!r}: give a list of nine numbers, row by row")
    return tuple(_number(name, number) for number in value)


def _inside(name: str, value: Any) -> str:
    if value not in INSIDE:
        raise OptionError(f"{name!r} is {value!r}: give one of {', '.join(INSIDE)}")
    return str(value)


def _axes(name: str, value: Any) -> str:
    if value not in AXES:
        raise OptionError(f"{name!r} is {value!r}: give one of {', '.join(AXES)}")
    return str(value)


def _field(name: str, value: Any) -> str:
    if value not in FIELDS:
        raise OptionError(f"{name!r} is {value!r}: give one of {', '.join(FIELDS)}")
    return str(value)


def _scale(name: str, value: Any) -> float:
    number = _number(name, value)
    if number <= 0:
        raise OptionError(f"{name!r} is {value!r}: give a number greater than 0")
    return number


def _flag(name: str, value: Any) -> bool:
    if type(value) is not bool:
        raise OptionError(f"{name!r} is {value!r}: give true or false")
    return value


def _mesher(name: str, value: Any) -> str:
    if value not in MESHERS:
        raise OptionError(f"{name!r} is {value!r}: give one of {', '.join(MESHERS)}")
    return str(value)


def _error(name: str, value: Any) -> float:
    return check_error(_number(name, value), repr(name))


def _label(name: str, value: Any) -> int:
    return check_label(value, repr(name))


def _triangles(name: str, value: Any) -> int:
    return check_triangles(value, repr(name))


CHECKS: dict[str, Callable[[str, Any], Any]] = {
    "factor": _factor,
    "spacing": _numbers,
    "origin": _numbers,
    "direction": _direction,
    "axes": _axes,
    "inside": _inside,
    "field": _field,
    "label": _label,
    "level": _number,
    "scale": _scale,
    "offset": _number,
    "cap": _flag,
    "mesher": _mesher,
    "simplify": _error,
    "triangles": _triangles,
}
