"""The names of the meshers, for the command's choices and the evaluation's tables.

Nothing is imported here, so they are known without loading NumPy.
"""

from __future__ import annotations

MARCHING = "marching"
SHARP = "sharp"
MESHERS: tuple[str, ...] = (MARCHING, SHARP)
DEFAULT_MESHER = MARCHING
