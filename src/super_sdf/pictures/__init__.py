"""Renderings of meshes, sections through fields, and the pages that they stand on.

It may import ``pipeline`` and what lies below; it needs the extra ``view``.
"""
