"""How well a mesh fits the samples of its grid, and whether it is valid; needs libigl.

No true surface is needed. It may import ``convert``, ``truth``, ``steps``, ``files``, ``mesh``,
``grid`` and ``machine``.
"""
