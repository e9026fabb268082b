"""Meshes as another program finds them in their files: what is wrong with them, in words."""

from __future__ import annotations

from pathlib import Path

import numpy as np

SUFFIXES = (".ply", ".stl", ".obj", ".off", ".glb", ".3mf")


def faults_of_mesh(path: Path, *, may_be_open: bool) -> list[str]:
    """Return what is wrong with a mesh: vertices not finite or not distinct, edges open."""
    import trimesh

    try:
        found = trimesh.load(path, process=False)
        parts = list(getattr(found, "geometry", {"": found}).values())
        vertices, faces = np.asarray(parts[0].vertices), np.asarray(parts[0].faces, np.int64)
    except Exception as error:  # whatever a reader makes of the file, others would meet it too
        return [f"cannot be read back: {type(error).__name__}: {error}"]
    if len(parts) != 1 or not len(faces):
        return ["holds no triangle" if len(parts) == 1 else f"holds {len(parts)} meshes"]
    if not np.isfinite(vertices).all():
        return [f"{int((~np.isfinite(vertices)).any(1).sum())} vertices are not finite"]
    return list(_faults(vertices, faces, path.suffix == ".stl", may_be_open))


def _faults(vertices: np.ndarray, faces: np.ndarray, is_soup: bool, may_be_open: bool):
    """Yield what is wrong with the geometry; a soup of triangles has each corner as a vertex."""
    used, at = np.unique(vertices + 0.0, axis=0, return_inverse=True)
    if len(used) < len(vertices) and not is_soup:
        yield "vertices at the same position"
    faces = at.ravel()[faces]
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    if (start == end).any():
        yield "triangles that have collapsed"
    forward, times = np.unique(start * len(used) + end, return_counts=True)
    if (times > 1).any():
        yield "edges that two triangles run along in one direction"
    if not may_be_open and len(np.setxor1d(forward, end * len(used) + start)):
        yield "open edges that nothing was said of"


def count(path: Path) -> tuple[int, int]:
    """Return how many distinct vertices and how many triangles a mesh file holds."""
    import trimesh

    found = trimesh.load(path, process=False)
    part = next(iter(getattr(found, "geometry", {"": found}).values()))
    return len(np.unique(np.asarray(part.vertices) + 0.0, axis=0)), len(part.faces)
