"""Exact distances to meshes, for ``sample``, ``evaluate`` and training; needs the extra ``eval``.

It may import ``grid``, ``mesh`` and ``machine``.
"""
