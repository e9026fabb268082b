"""OpenVDB level sets and densities: every voxel of the box round those that are not background.

Voxel (i, j, k) is the sample at the grid's transform of (i, j, k). What a file has of a grid:
flags of its compression, metadata, the transform and the tree (``vdb_tree``).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ...grid.planes import InputFile
from ..volume import Box, Request, Volume, from_affine
from .vdb_tree import LEAF, Coding, Cursor, Tree

MAGIC = 0x56444220
OLDEST = 222  # version of the file format, of OpenVDB 3
MARGIN = 2  # voxels of background around the others, so that the border is outside
TYPES: dict[str, np.dtype[Any]] = {
    "Tree_float_5_4_3": np.dtype("<f4"),
    "Tree_double_5_4_3": np.dtype("<f8"),
}
HALF = "_HalfFloat"  # ends the type of a grid whose values are stored in 16 bits
NUMBERS = {"float": "f", "double": "d", "int32": "i", "int64": "q", "bool": "?"}  # of metadata
# How many vectors a map has, and which are the translation and the scale.
MAPS = {
    "TranslationMap": (1, 0, None),
    "ScaleMap": (5, None, 0),
    "UniformScaleMap": (5, None, 0),
    "ScaleTranslateMap": (6, 0, 1),
    "UniformScaleTranslateMap": (6, 0, 1),
}
MATRICES = ("AffineMap", "UnitaryMap")
PICOGK_MM = 1000  # PicoGK states the size of a voxel in metres, and works in millimetres


class _Entry(NamedTuple):
    name: str
    type: str
    parent: str
    place: int


def read_vdb(request: Request) -> Volume:
    """Read a grid of floating-point values of a ``.vdb`` file.

    Every voxel has the value that OpenVDB gives it, inactive ones too. A background of 0 is no
    distance: where values are signed, voxels that have it and are not active are unknown.
    """
    file = InputFile.open(request.path)
    entries = _entries(file)
    usable = [entry for entry in entries if entry.type.removesuffix(HALF) in TYPES]
    names = [entry.name for entry in usable]
    entry = usable[names.index(request.choose(names, "grid of floating-point values"))]
    flags, metadata, affine, place = _read_head(file, entry.place)
    if entry.parent:  # whose tree it shares
        places = [other.place for other in entries if other.name == entry.parent]
        if not places:
            raise FileError(f"{file.name} is damaged: it lacks the grid {entry.parent!r}")
        flags, _, _, place = _read_head(file, places[0])
    dtype = TYPES[entry.type.removesuffix(HALF)]
    stored = np.dtype("<f2") if entry.type.endswith(HALF) else dtype
    tree = Tree(file, place, partial(Coding, dtype, stored, flags))
    stated = metadata.get("file_voxel_count", tree.active_count)
    if stated != tree.active_count:
        raise FileError(
            f"{file.name} is damaged: it has {tree.active_count:,} active voxels and states "
            f"{stated:,}"
        )
    return _volume(file, tree, metadata, affine)


def _entries(file: InputFile) -> list[_Entry]:
    cursor = Cursor(file)
    if file.size < 12 or cursor.number("q") != MAGIC:
        raise FileError(f"{file.name} is no .vdb file: its first bytes are not OpenVDB's")
    version = cursor.number("I")
    if version < OLDEST:
        raise FileError(
            f"{file.name} has version {version} of the format: save it with OpenVDB 3 or later, "
            f"whose files have {OLDEST} at least"
        )
    cursor.skip(8)  # the library's version
    seekable = cursor.number("?")
    cursor.skip(36)  # the file's own number
    _read_metadata(cursor)
    count = cursor.number("I")
    if not seekable and count > 1:
        raise FileError(
            f"{file.name} holds {count} grids one after the other, as a stream: save it with "
            "openvdb.write"
        )
    entries = []
    for _ in range(count):
        name, type_, parent = (cursor.text().replace("\x1e", "#") for _ in range(3))
        _, _, end = cursor.unpack("qqq")
        entries.append(_Entry(name, type_, parent, cursor.place))
        if count > 1:
            cursor.place = end
            cursor.skip(0)
    return entries


def _read_head(file: InputFile, place: int) -> tuple[int, dict[str, Any], NDArray[np.float64], int]:
    """Return compression, metadata and transform of a grid, and where its tree begins."""
    cursor = Cursor(file, place)
    flags = cursor.number("I")
    metadata = _read_metadata(cursor)
    return flags, metadata, _read_transform(cursor), cursor.place


def _read_metadata(cursor: Cursor) -> dict[str, Any]:
    metadata: dict[str, Any] = {}
    for _ in range(cursor.number("I")):
        name, type_ = cursor.text(), cursor.text()
        data = Cursor(cursor.file, cursor.place + 4)
        cursor.skip(cursor.number("I"))
        if type_ == "string":
            metadata[name] = data.take(cursor.place - data.place).decode("utf-8", "replace")
        elif type_ in NUMBERS:
            metadata[name] = data.number(NUMBERS[type_])
    return metadata


def _read_transform(cursor: Cursor) -> NDArray[np.float64]:
    """Return the matrix (3, 4) from indices to world coordinates."""
    kind = cursor.text()
    if kind in MATRICES:
        return cursor.array("<f8", 16).reshape(4, 4).T[:3]  # OpenVDB multiplies rows by it
    if kind not in MAPS:
        raise GridError(
            f"{cursor.file.name} has a transform that is not affine, {kind}: resample the grid to "
            "a linear transform"
        )
    count, translation, scale = MAPS[kind]
    vectors = cursor.array("<f8", 3 * count).reshape(count, 3)
    moved = np.zeros(3) if translation is None else vectors[translation]
    return np.column_stack([np.diag(np.ones(3) if scale is None else vectors[scale]), moved])


def _volume(
    file: InputFile, tree: Tree, metadata: dict[str, Any], affine: NDArray[np.float64]
) -> Volume:
    bounds = tree.bounds()
    if bounds is None:
        raise GridError(f"{file.name} has no active voxel: it holds no surface")
    unknown = not tree.coding.background and tree.is_signed()
    margin = 0 if unknown else MARGIN
    low, high = bounds[0] - margin, bounds[1] + margin
    size = PICOGK_MM * float(metadata.get("PicoGK.VoxelSize", 1 / PICOGK_MM))
    notes = f"voxels of {size:.6g} mm, as PicoGK states: the mesh is in millimetres"

    def read_box(box: Box) -> NDArray[Any]:
        start = low + [part.start for part in box]
        shape = tuple(part.stop - part.start for part in box)
        voxels = tree.read(start, shape, unknown=unknown)
        return voxels if size == 1 else voxels * voxels.dtype.type(size)

    turn = affine[:, :3]
    spacing, origin, direction = from_affine(
        size * np.column_stack([turn, turn @ low + affine[:, 3]])
    )
    return Volume(
        tuple(map(int, high - low)),
        tree.coding.dtype.newbyteorder("="),
        None,
        *(spacing, origin, direction),
        chunks=(LEAF, LEAF, LEAF),
        read_box=read_box,
        notes=(notes,) if "PicoGK.VoxelSize" in metadata else (),
    )
