"""Reading mesh files: regular files only, and one-line errors.

The plainest of PLY files, as this package and most others write them, are read here: little-endian
triangles, ``property list uchar int``, after vertices whose properties are numbers. Everything else
is left to trimesh, which takes twice the time and memory.
"""

from __future__ import annotations

import logging
import os
import re
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, MeshError, OutOfMemoryError, SuperSdfError
from ..files.regular import check_regular_file
from ..threads import held_memory, in_words, memory_bound
from ..surface.mesh import Mesh, row_keys

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
    _check_archive(path, max_memory)
    vertices, faces = _load(path)
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
    if are_distinct(places):
        return Mesh(vertices, faces)
    first, place = unique_rows(places, keep_order=True)
    return Mesh(vertices[first], place.astype(np.int32)[faces])


def are_distinct(rows: NDArray[np.int64]) -> bool:
    """Return whether the rows, (n, 3), are certainly distinct: their hashes differ."""
    keys = np.sort(row_keys(rows.astype(np.float64)))
    return not bool((keys[1:] == keys[:-1]).any())


def _check_archive(path: Path, max_memory: int | None) -> None:
    """Raise OutOfMemoryError if a zip file, by its entries, unpacks to more than fits in memory."""
    bound = memory_bound(max_memory)
    if bound is None or not zipfile.is_zipfile(path):
        return
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(info.file_size for info in archive.infolist())
    except Exception as error:  # zipfile raises many kinds of error on damaged fields
        raise FileError(f"{path} cannot be read as a mesh: {error}") from None
    need, left = XML_BYTES * size, max(bound - (held_memory() or 0), 0)
    if need > left:
        raise OutOfMemoryError(
            f"{path} unpacks to {in_words(size)}, and to read it takes {in_words(need)} of memory, "
            f"{in_words(left)} are left; save it as binary .ply or .stl"
        )


def _load(path: Path) -> tuple[NDArray[np.float64], NDArray[Any]]:
    """Return vertices (n, 3) and faces (m, 3) as they stand."""
    try:
        plain = read_plain_ply(path) if path.suffix.lower() == ".ply" else None
        return plain or _load_with_trimesh(path)
    except SuperSdfError as error:  # in a file that this one refers to
        raise FileError(f"{path} refers to another file: {error}") from error
    except Exception as error:  # the readers of trimesh raise all kinds of errors
        reason = str(error).strip().splitlines()
        first = reason[0][:200] if reason else type(error).__name__
        raise FileError(f"{path} cannot be read as a mesh: {first}") from error


def _load_with_trimesh(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    import trimesh

    with _quiet():
        # unprocessed: otherwise faces with non-finite vertices would be dropped silently
        found = trimesh.load_mesh(path, process=False, resolver=_file_resolver(path))
        vertices = np.array(getattr(found, "vertices", ()), np.float64).reshape(-1, 3)
        faces = np.array(getattr(found, "faces", ()), np.int64).reshape(-1, 3)
    return vertices, faces


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence warnings of NumPy and trimesh: what matters is checked afterwards."""
    log = logging.getLogger("trimesh")
    handler = logging.NullHandler()  # without a handler, Python prints warnings to stderr
    log.addHandler(handler)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.removeHandler(handler)


def _file_resolver(path: Path) -> Any:
    """Return a resolver for trimesh that opens the materials and buffers of a mesh file."""
    from trimesh.resolvers import FilePathResolver

    class RegularFileResolver(FilePathResolver):
        """Opens regular files only: a mesh may refer to a pipe, which never ends."""

        def get(self, name: str) -> Any:
            """Return the content of a file."""
            for candidate in (name.strip(), name.strip().lstrip("/"), os.path.split(name)[-1]):
                named = os.path.join(self.parent, candidate)
                if os.path.exists(named):
                    check_regular_file(named)
            return super().get(name)

    return RegularFileResolver(str(path))


# PLY

HEADER_LINES = 60  # at most, of a plain file
LINE_BYTES = 400
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
HEADER = re.compile(
    r"ply\nformat binary_little_endian 1.0\n"
    r"element vertex (\d{1,10})\n((?:property [a-z]+\d* \w+\n)+)"
    r"element face (\d{1,10})\n"
    r"property list (?:uchar|uint8) (?:int|int32) vertex_ind(?:ices|ex)\nend_header\n"
)


def read_plain_ply(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]] | None:
    """Return vertices, (n, 3), and faces, (m, 3), as they stand; None if the file is not plain."""
    with path.open("rb") as file:
        plain = HEADER.fullmatch(_header(file))
        if not plain:
            return None
        words = [line.split()[1:] for line in plain[2].splitlines()]
        names = [name for _, name in words]
        if not set("xyz") <= set(names) or len(set(names)) < len(names):
            return None
        if not {kind for kind, _ in words} <= TYPES.keys():
            return None
        row = np.dtype([(name, TYPES[kind]) for kind, name in words])
        counts = int(plain[1]), int(plain[3])
        size = counts[0] * row.itemsize + counts[1] * FACE.itemsize
        if path.stat().st_size != file.tell() + size:
            return None
        vertices = np.fromfile(file, row, counts[0])
        faces = np.fromfile(file, FACE, counts[1])
    if not (faces["count"] == 3).all():
        return None
    corners = np.ascontiguousarray(faces["corners"])
    del faces
    return np.stack([vertices[axis] for axis in "xyz"], axis=1, dtype=np.float64), corners


def _header(file: BinaryIO) -> str:
    """Return the header of a PLY file without comments, or what stands in its place."""
    lines = []
    for _ in range(HEADER_LINES):
        line = file.readline(LINE_BYTES)
        lines += [] if line.startswith((b"comment ", b"obj_info ")) else [line]
        if line in (b"end_header\n", b"") or (len(lines) == 1 and line != b"ply\n"):
            break
    return b"".join(lines).decode("latin-1")
