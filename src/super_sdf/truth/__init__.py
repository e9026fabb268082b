"""Exact distances to meshes, for ``sample``, for measuring and for training; extra ``eval``."""
