"""Choosing one array of a file that may hold several."""

from __future__ import annotations

from collections.abc import Sequence

from ...errors import FileError
from ..volume import Request

MOST_NAMED = 10  # arrays that an error lists


def choose_member(request: Request, names: Sequence[str], what: str) -> str:
    """Return the name of the array to read: the one asked for, else the only one.

    Parameters
    ----------
    request : Request
        With the name, or None.
    names : sequence of str
        Those of all arrays that could be meant.
    what : str
        What they are called in the format, such as "3D dataset".

    Raises
    ------
    FileError
        If there is none, none of this name, or several and none is named.
    """
    path, asked = request.path, request.member
    listed = ", ".join(names[:MOST_NAMED])
    listed += f" and {len(names) - MOST_NAMED:,} more" if len(names) > MOST_NAMED else ""
    if not names:
        raise FileError(f"{path} holds no {what}")
    if asked is not None:
        found = [name for name in names if name.strip("/") == asked.strip("/")]
        if not found:
            raise FileError(f"{path} has no {what} {asked!r}: it holds {listed}")
        return found[0]
    if len(names) > 1:
        raise FileError(f"{path} holds several arrays, {listed}: give {path}:{names[0]}, say")
    return names[0]
