"""Evaluation: quality of meshes against the truth, the baselines and other people's methods.

It needs the extra ``eval`` (libigl, SciPy, scikit-image, matplotlib), and for pictures of meshes
the extra ``view`` (PyVista). The command is ``super-sdf evaluate``.

    scope -> tasks -> runner -> measuring (cases, methods, peers, metrics) -> store -> results
    -> tables, plots -> report

Grids that are not exact distances: field_kinds makes them, field_methods meshes them, and
field_tables has their tables.
"""
