"""The procedural generator of closed solids: training without mesh data.

`random_solid` draws from the families of ``families``, which live in modules by kind and share what
is in ``draws``.
"""

from export.shapes.solid import random_solid

__all__ = ["random_solid"]
