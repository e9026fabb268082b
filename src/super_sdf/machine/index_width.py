"""The limit of 32-bit indices, for the vertices of a mesh (as in its files) and nodes of a field.

An index that overflows would refer to another vertex, so the number of vertices or nodes is checked
first, in Python's integers.
"""

from __future__ import annotations

from ..errors import OptionError

MAX_INDEX = 2**31 - 1


def check_count(count: int, what: str) -> int:
    """Return ``count``, the number of ``what``; OptionError if 32-bit numbers are too few."""
    if count > MAX_INDEX:
        raise OptionError(
            f"there are {count:,} {what}, but 32-bit indices allow only {MAX_INDEX:,}: use a "
            "smaller factor, or fewer samples"
        )
    return count
