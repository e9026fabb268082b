"""How far 32-bit numbers go: vertices of a mesh, whose files hold such, and nodes of a field.

A number that wraps would be another's, so what is numbered is counted first, in Python's integers.
"""

from __future__ import annotations

from ..errors import OptionError

LARGEST = 2**31 - 1


def check_count(count: int, what: str) -> int:
    """Return ``count``, the number of ``what``, or raise if it exceeds 32-bit numbers."""
    if count > LARGEST:
        raise OptionError(
            f"there are {count:,} {what}, and {LARGEST:,} can be numbered: use a smaller factor, "
            "or fewer samples"
        )
    return count
