"""Renderings of meshes, cross-sections of grids, and the pages that they are laid out on.

It may import ``pipeline`` and what lies below; it needs the extra ``view``.
"""
