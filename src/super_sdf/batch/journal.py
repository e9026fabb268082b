"""What a batch is about to do in its folder, noted before it does it: ``.super-sdf-batch``.

A line is a JSON string, an output that is begun; or an object, the SHA-256 of a mesh that is about
to take its name. Should the process be killed then, the next one knows what may be half written,
and which meshes are a batch's own though no row of the report tells of them.
"""

from __future__ import annotations

from pathlib import Path, PurePath
from typing import Any, NamedTuple

from ..errors import WriteError
from ..machine.records import append_shared_line, parse_line

NAME = ".super-sdf-batch"


class Journal(NamedTuple):
    """Outputs that were begun, and the SHA-256 of those that were made, by output."""

    begun: set[str]
    made: dict[str, set[str]]


def read_journal(folder: Path) -> Journal:
    """Return what stands in a folder's journal; lines without meaning are passed over."""
    journal = Journal(set(), {})
    try:
        lines = (folder / NAME).read_bytes().split(b"\n")
    except OSError:
        return journal
    for found in map(parse_line, lines):
        if isinstance(found, str) and _is_within(found):
            journal.begun.add(found)
        elif isinstance(found, dict):
            target, digest = found.get("out"), found.get("sha256")
            if isinstance(target, str) and isinstance(digest, str):
                journal.made.setdefault(target, set()).add(digest)
    return journal


def note_begun(folder: Path, target: str) -> None:
    """Note that an output is about to be written."""
    _note(folder / NAME, target)


def note_made(folder: Path, target: str, digest: str) -> None:
    """Note the SHA-256 of a mesh that is about to take its name; any process may."""
    _note(folder / NAME, {"out": target, "sha256": digest})


def _note(path: Path, record: Any) -> None:
    try:
        append_shared_line(path, record)
    except OSError as error:
        raise WriteError(f"{path} cannot be written: {error.strerror}") from error


def _is_within(target: str) -> bool:
    """Say whether an output lies in its folder: unfinished files are removed nowhere else."""
    return not PurePath(target).is_absolute() and ".." not in PurePath(target).parts
