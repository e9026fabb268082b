"""How far 32-bit numbers go: nodes of a slab, and vertices of a mesh, whose files hold such, too.

A number that wraps would be another node's, so whatever is numbered is counted first, in Python's
integers or 64 bits.
"""

from __future__ import annotations

from ..errors import OptionError

LARGEST = 2**31 - 1


def check_count(count: int, what: str, factor: int) -> int:
    """Return ``count``, the number of ``what``, or raise if it exceeds 32-bit indices."""
    if count > LARGEST:
        raise OptionError(
            f"factor {factor} makes {count:,} {what}, and {LARGEST:,} can be numbered; use a "
            "smaller factor, or fewer samples"
        )
    return count
