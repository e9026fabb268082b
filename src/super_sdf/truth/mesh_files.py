"""Reading mesh files with trimesh: regular files only, and one-line errors."""

from __future__ import annotations

import logging
import math
import os
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, MeshError, OutOfMemoryError, SuperSdfError
from ..files.regular import check_regular_file
from ..surface.mesh import Mesh
from ..threads import held_memory, in_words, memory_bound

# Products and squares of larger coordinates overflow.
LARGEST_COORDINATE = 1e30
MERGE_DISTANCE = 1e-8  # vertices closer than this are merged
SMALLEST_STEP = 1e-18  # of the largest coordinate, so that multiples of it fit in 64 bits
XML_BYTES = 20  # of memory that trimesh takes for each byte of XML in a .3mf


def read_mesh(path: str | Path, max_memory: int | None = None) -> Mesh:
    """Read any mesh file that trimesh reads, with merged float64 vertices.

    ``max_memory`` is how many bytes this process may hold, by default a share of the free memory.
    FileError if no mesh can be read from the file; OutOfMemoryError if it is an archive, such as
    ``.3mf``, that unpacks to more than fits in memory; MeshError if it has no triangles, faces with
    missing vertices, or coordinates that are not finite or larger than ``LARGEST_COORDINATE``.
    """
    path = check_regular_file(path)
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                size = sum(info.file_size for info in archive.infolist())
            need = XML_BYTES * size
            left = (memory_bound(max_memory) or math.inf) - (held_memory() or 0)
            if need > left:
                raise OutOfMemoryError(
                    f"{path} unpacks to {in_words(size)}, and to read it takes {in_words(need)} of "
                    f"memory, {in_words(int(max(left, 0)))} are left; save it as .ply or .stl"
                )
        vertices, faces = _load(path)
    except OutOfMemoryError:
        raise
    except SuperSdfError as error:  # in a file that this one refers to
        raise FileError(f"{path} refers to another file: {error}") from error
    except Exception as error:  # the readers of trimesh raise all kinds of errors
        reason = str(error).strip().splitlines()
        first = reason[0][:200] if reason else type(error).__name__
        raise FileError(f"{path} cannot be read as a mesh: {first}") from error
    if not len(faces):
        raise MeshError(f"{path} holds no triangle: give a surface mesh")
    if faces.min() < 0 or faces.max() >= len(vertices):
        wrong = faces.min() if faces.min() < 0 else faces.max()
        raise MeshError(f"{path} has a face of vertex {wrong}, of {len(vertices):,}: repair it")
    mesh = without_unused(vertices, faces)
    if not np.isfinite(mesh.vertices).all():
        raise MeshError(f"{path} holds coordinates that are not finite: repair it first")
    largest = np.abs(mesh.vertices).max()
    if largest > LARGEST_COORDINATE:
        raise MeshError(f"{path} reaches to {largest:.3g}: scale it to coordinates under 1e30")
    return merged(mesh)


def without_unused(vertices: NDArray[Any], faces: NDArray[Any]) -> Mesh:
    """Return a mesh of these faces, and of the vertices that are corners of them, in order."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    return Mesh(vertices[used], (np.cumsum(used, dtype=np.int32) - 1)[faces])


def merged(mesh: Mesh) -> Mesh:
    """Merge vertices within ``MERGE_DISTANCE``, for meshes under 1 that share of their size.

    Unlike in trimesh, normals and textures do not keep vertices separate: a mesh is not open along
    its seams. Unused vertices are dropped.
    """
    from trimesh.grouping import unique_rows

    mesh = without_unused(mesh.vertices, mesh.faces)
    vertices, faces = mesh.vertices, mesh.faces
    step = MERGE_DISTANCE * min(1.0, float(np.ptp(vertices, axis=0).max()))
    step = max(step, float(np.abs(vertices).max()) * SMALLEST_STEP) or 1.0
    places = np.round(vertices / step).astype(np.int64)
    first, place = unique_rows(places, keep_order=True)
    if len(first) == len(vertices):
        return Mesh(vertices, faces)
    return Mesh(vertices[first], place.astype(np.int32)[faces])


def _load(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return vertices (n, 3) and faces (m, 3) as they stand, without warnings on the way."""
    import trimesh
    from trimesh.resolvers import FilePathResolver

    class RegularFileResolver(FilePathResolver):
        """Opens materials and buffers if they are regular files: a pipe would never end."""

        def get(self, name: str) -> Any:
            for candidate in (name.strip(), name.strip().lstrip("/"), os.path.basename(name)):
                if os.path.exists(beside := os.path.join(self.parent, candidate)):
                    check_regular_file(beside)
            return super().get(name)

    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # else Python prints them
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # unprocessed: otherwise faces with non-finite vertices would be dropped silently
        found = trimesh.load_mesh(path, process=False, resolver=RegularFileResolver(str(path)))
        vertices = np.array(getattr(found, "vertices", ()), np.float64).reshape(-1, 3)
        faces = np.array(getattr(found, "faces", ()), np.int64).reshape(-1, 3)
    return vertices, faces
