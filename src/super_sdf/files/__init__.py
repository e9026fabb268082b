"""Grids from files, meshes to files. It may import ``grid``, ``mesh`` and ``machine``."""
