"""Meshes from files, by trimesh: regular files alone, and whatever is wrong with one in a line."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, MeshError, SuperSdfError
from ..files.regular import check_regular_file
from ..mesh import Mesh

# Coordinates beyond have products and squares that no number holds.
FARTHEST = 1e30
SAME_PLACE = 1e-8  # vertices nearer than that are one
SMALLEST_STEP = 1e-18  # of the farthest coordinate, so that whole numbers of it fit in 64 bits


def read_mesh(path: str | Path) -> Mesh:
    """Read any mesh file that trimesh reads, vertices merged, float64.

    Raises
    ------
    FileError
        If the file is missing or no mesh can be read from it.
    MeshError
        If it holds no triangle, faces of vertices that are not there, or coordinates that are not
        finite or beyond ``FARTHEST``.
    """
    path = check_regular_file(path)
    vertices, faces = _load(path)
    if not len(faces):
        raise MeshError(f"{path} holds no triangle: give a surface mesh")
    if faces.min() < 0 or faces.max() >= len(vertices):
        wrong = faces.min() if faces.min() < 0 else faces.max()
        raise MeshError(f"{path} has a face of vertex {wrong}, of {len(vertices):,}: repair it")
    drawn = vertices[faces.ravel()]
    if not np.isfinite(drawn).all():
        raise MeshError(f"{path} holds coordinates that are not finite: repair it first")
    farthest = np.abs(drawn).max()
    if farthest > FARTHEST:
        raise MeshError(f"{path} reaches to {farthest:.3g}: scale it to coordinates under 1e30")
    return merged(Mesh(vertices, faces.astype(np.int32)))


def merged(mesh: Mesh) -> Mesh:
    """Merge vertices at the same place and drop those that no face uses.

    One place is ``SAME_PLACE`` wide, of small meshes that share of their size. Normals and textures
    do not keep vertices apart, as they do in trimesh: a mesh is not open along its seams.
    """
    from trimesh.grouping import unique_rows

    used, faces = np.unique(mesh.faces, return_inverse=True)
    vertices = mesh.vertices[used]
    step = SAME_PLACE * min(1.0, float(np.ptp(vertices, axis=0).max()))
    step = max(step, float(np.abs(vertices).max()) * SMALLEST_STEP) or 1.0
    first, place = unique_rows(np.round(vertices / step).astype(np.int64), keep_order=True)
    return Mesh(vertices[first], place[faces].reshape(-1, 3).astype(np.int32))


def _load(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return vertices (n, 3) and faces (m, 3) as trimesh reads them, not checked."""
    import trimesh

    try:
        with _quiet():
            # as it is: else faces of vertices that are not finite would be dropped unsaid
            found = trimesh.load_mesh(path, process=False, resolver=_file_resolver(path))
            vertices = np.array(getattr(found, "vertices", ()), np.float64).reshape(-1, 3)
            faces = np.array(getattr(found, "faces", ()), np.int64).reshape(-1, 3)
    except SuperSdfError as error:  # of a file that this one names
        raise FileError(f"{path} names another file: {error}") from error
    except Exception as error:  # trimesh's readers raise whatever their format makes them
        reason = str(error).strip().splitlines()
        said = reason[0][:200] if reason else type(error).__name__
        raise FileError(f"{path} cannot be read as a mesh: {said}") from error
    return vertices, faces


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep warnings of NumPy and trimesh to themselves: what matters is checked afterwards."""
    log = logging.getLogger("trimesh")
    handler = logging.NullHandler()  # without any, Python prints warnings on stderr
    log.addHandler(handler)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.removeHandler(handler)


def _file_resolver(path: Path) -> Any:
    """Return what finds the files that a mesh file names, materials and buffers, for trimesh."""
    from trimesh.resolvers import FilePathResolver

    class RegularFileResolver(FilePathResolver):
        """Opens regular files alone: a mesh may name a pipe, which never ends."""

        def get(self, name: str) -> Any:
            """Return a file's content."""
            for candidate in (name.strip(), name.strip().lstrip("/"), os.path.split(name)[-1]):
                named = os.path.join(self.parent, candidate)
                if os.path.exists(named):
                    check_regular_file(named)
            return super().get(name)

    return RegularFileResolver(str(path))
