"""Names and colours of labels, from the tables that programs write.

3D Slicer, FreeSurfer   1 liver 221 130 101 255
ITK-SNAP                1 221 130 101 1 1 1 "liver"
JSON                    {"1": "liver"} or {"liver": 1}; also below "labels", as of nnU-Net
CSV, TSV                1,liver
"""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import FileError, OptionError, seen
from ..files.regular import check_regular_file

LONGEST = 80  # characters of a name
LARGEST = 10_000_000  # bytes of a table


class LabelName(NamedTuple):
    """A name, and a colour in red, green and blue from 0 to 255 if the table has one."""

    name: str
    colour: tuple[int, int, int] | None = None


Names = dict[int, LabelName]


def read_names(path: str | Path) -> Names:
    """Return the names of labels in a table; FileError if it is none."""
    path = check_regular_file(Path(path))
    if path.stat().st_size > LARGEST:
        raise FileError(f"{path} has more than {LARGEST:,} bytes: give a table of labels")
    try:
        text = path.read_text(encoding="utf-8-sig")
        names = _of_json(text) if path.suffix.lower() == ".json" else _of_lines(text)
    except (OSError, ValueError, csv.Error) as error:
        raise FileError(f"{path} cannot be read as a table of labels: {error}") from error
    if not names:
        raise FileError(f"{path} names no label: give lines such as '1 liver'")
    return names


def _of_json(text: str) -> Names:
    """Return the names of an object that maps numbers to names, or names to numbers."""
    found = json.loads(text)
    found = found.get("labels", found) if isinstance(found, dict) else found
    if not isinstance(found, dict):
        raise ValueError("it is no object of names")
    names = {}
    for key, value in found.items():
        number, name = (key, value) if _is_whole(key) else (value, key)
        if not _is_whole(number) or not isinstance(name, str):
            raise ValueError(f"{seen(key)}: {seen(value)} is no label and name")
        if name.strip():
            names[int(number)] = _named(name, [])
    return names


def _of_lines(text: str) -> Names:
    """Return the names of lines that begin with a number; others are headings or comments."""
    names = {}
    for line in text.splitlines():
        mark = next((mark for mark in "\t,;" if mark in line), " ")
        (fields,) = csv.reader([line.strip()], delimiter=mark, skipinitialspace=True) or [[]]
        fields = [field.strip() for field in fields]
        if mark == " ":
            fields = [*filter(None, fields[:-1]), *fields[-1:]]
        if len(fields) < 2 or not _is_whole(fields[0]) or "" in (fields[1], fields[-1]):
            continue
        if len(fields) >= 5 and all(map(_is_whole, fields[1:4])) and not _is_whole(fields[-1]):
            names[int(fields[0])] = _named(fields[-1], fields[1:4])  # ITK-SNAP
        else:
            names[int(fields[0])] = _named(fields[1], fields[2:5])
    return names


def _is_whole(value: Any) -> bool:
    is_number = isinstance(value, int) and not isinstance(value, bool)
    return is_number or (isinstance(value, str) and bool(re.fullmatch(r"[-+]?\d{1,20}", value)))


def _named(name: str, colour: list[str]) -> LabelName:
    text = "".join(letter if letter.isprintable() else " " for letter in name)[:LONGEST].strip()
    if len(colour) == 3 and all(re.fullmatch(r"\d{1,3}", each) for each in colour):
        red, green, blue = map(int, colour)
        return LabelName(text, (red, green, blue) if max(red, green, blue) <= 255 else None)
    return LabelName(text)


def numbers_of(labels: Any, names: Names) -> Any:
    """Return labels with the numbers in place of names; OptionError if the table has no such."""
    if isinstance(labels, str) or not hasattr(labels, "__iter__"):
        return labels
    by_name = {entry.name: number for number, entry in names.items()}
    chosen = []
    for label in labels:
        if isinstance(label, str) and label not in by_name:
            some = ", ".join(list(by_name)[:10]) or "none without --names"
            raise OptionError(f"labels has {label!r}: give numbers, or names of the table ({some})")
        chosen.append(by_name[label] if isinstance(label, str) else label)
    return chosen


def in_file_name(name: str) -> str:
    """Return a name as a part of a file's name: letters, digits, dots and dashes, not too many."""
    plain = re.sub(r"[^\w.-]+", "_", name).strip("._") or "label"
    return plain.encode()[:LONGEST].decode(errors="ignore")
