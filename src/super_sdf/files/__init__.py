"""Grids from files, meshes to files, and what an array says of where it lies."""
