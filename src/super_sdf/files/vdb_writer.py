"""OpenVDB files: numbers of the format, and writing a level set, as ``readers.vdb`` describes it.

Of a node the active values are stored, and the signs of the others. Nothing is packed: zlib would
take long and save about a fifth. OpenVDB 5 and later read the file.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO, Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray
from ..grid.sdf_grid import SdfGrid
from .output import little_endian

MAGIC = 0x56444220
ZIP, ACTIVE_MASK, BLOSC = 1, 2, 4  # flags of a grid's compression
# How the inactive values of a node are stored: the first three have one, and a mask chooses between
# two in the next three; the last stores every value.
MINUS_BACKGROUND, ONE_VALUE, MASKED, MASKED_ONE, MASKED_TWO, ALL = 1, 2, 3, 4, 5, 6
EDGES = (4096, 128)  # voxels along a child of the root, and along a child of that
LEAF = 8
OUTSIDE, INSIDE, MIXED = 0, 1, 2  # a cube of voxels: all background, all minus that, or neither
WIDTHS = EDGES[0] // EDGES[1], EDGES[1] // LEAF  # children along an edge of the two inner nodes
MASK_BYTES = LEAF**3 // 8
VERSION, LIBRARY = 224, (5, 0)  # of the format, and of the first library with it

Sides = NDArray[np.uint8]  # what each cube is, (x, y, z)


@dataclass(frozen=True, eq=False)
class LevelSet:
    """What a file holds."""

    grid: SdfGrid  # where the voxels are
    background: np.float32
    sides: Sides  # of the cubes of 8^3 voxels; the first along each axis is that before voxel 0
    leaf: Callable[[int], bytes]  # returns the leaf of a mixed cube, which are numbered in C order
    active: int  # voxels
    box: tuple[NDArray[np.int64], NDArray[np.int64]]  # first and last of the active voxels
    key: bytes  # 16 bytes that other files do not have

    def metadata(self) -> bytes:
        """Return the metadata, by the names that OpenVDB gives them."""
        entries = (
            ("class", "string", b"level set"),
            ("file_bbox_max", "vec3i", struct.pack("<3i", *self.box[1])),
            ("file_bbox_min", "vec3i", struct.pack("<3i", *self.box[0])),
            ("file_voxel_count", "int64", struct.pack("<q", self.active)),
            ("is_saved_as_half_float", "bool", b"\0"),
            ("name", "string", b"surface"),
        )
        data = [_text(name) + _text(kind) + _sized(value) for name, kind, value in entries]
        return struct.pack("<I", len(data)) + b"".join(data)


def leaf_bytes(values: FloatArray, active: BoolArray) -> bytes:
    """Return a leaf of 512 values, those that are not ``active`` the background or minus it."""
    return _mask(active) + _inactive(values > 0, ~active) + little_endian(values[active])


def write_level_set(file: IO[bytes], tree: LevelSet) -> None:
    """Write a file with one grid, ``surface``."""
    file.write(struct.pack("<qIII?", MAGIC, VERSION, *LIBRARY, True))
    file.write(str(UUID(bytes=tree.key)).encode() + struct.pack("<II", 0, 1))
    file.write(_text("surface") + _text("Tree_float_5_4_3") + _text(""))
    places = file.tell()
    start = places + struct.calcsize("<qqq")
    file.write(bytes(start - places))  # they follow
    file.write(struct.pack("<I", ACTIVE_MASK) + tree.metadata() + _transform(tree.grid))
    leaves = _write_topology(file, tree)
    values = file.tell()
    for leaf in leaves:
        file.write(tree.leaf(leaf))
    end = file.tell()
    file.seek(places)
    file.write(struct.pack("<qqq", start, values, end))


def _write_topology(file: IO[bytes], tree: LevelSet) -> list[int]:
    """Write the nodes without the leaves' values; return the numbers of the leaves in order."""
    leaves = _padded(tree.sides, WIDTHS[1])
    inner = _padded(_joined(leaves, WIDTHS[1]), WIDTHS[0])
    root = _joined(inner, WIDTHS[0])
    numbers = np.cumsum(leaves == MIXED, dtype=np.int32).reshape(leaves.shape) - 1
    order: list[int] = []
    children = np.argwhere(root != OUTSIDE)
    file.write(struct.pack("<IfII", 1, tree.background, 0, len(children)))
    for place in children:
        child = _part(inner, place, WIDTHS[0])
        file.write(struct.pack("<3i", *(EDGES[0] * (place - 1))) + _node(child))
        for within in WIDTHS[0] * (place - 1) + 1 + np.argwhere(child == MIXED):
            node = _part(leaves, within, WIDTHS[1])
            held = _part(numbers, within, WIDTHS[1])[node == MIXED].tolist()
            file.write(_node(node))
            file.write(b"".join(tree.leaf(leaf)[:MASK_BYTES] for leaf in held))
            order += held
    return order


def _transform(grid: SdfGrid) -> bytes:
    """Return the map from indices to the world: a matrix only where it is turned."""
    steps, origin = np.array(grid.spacing), np.array(grid.origin)
    if not grid.is_straight:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[3, :3] = (np.array(grid.direction) * steps).T, origin
        return _text("AffineMap") + little_endian(matrix)
    name = "ScaleTranslateMap" if np.ptp(steps) else "UniformScaleTranslateMap"
    return _text(name) + little_endian(
        np.array([origin, steps, steps, 1 / steps, 1 / steps**2, 0.5 / steps])
    )


def _text(words: str) -> bytes:
    return _sized(words.encode())


def _sized(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def _mask(on: BoolArray) -> bytes:
    return np.packbits(on, bitorder="little").tobytes()


def _node(sides: Sides) -> bytes:
    """Return a node without its children: which there are, no active tile, and the others."""
    child = sides.ravel() == MIXED
    return _mask(child) + bytes(len(child) // 8) + _inactive(sides.ravel() == OUTSIDE, ~child)


def _inactive(outside: BoolArray, which: BoolArray) -> bytes:
    """Return how the inactive values of a node are stored: which are the background."""
    if outside[which].all():
        return bytes(1)
    if not outside[which].any():
        return bytes([MINUS_BACKGROUND])
    return bytes([MASKED]) + _mask(outside)


def _padded(sides: Sides, width: int) -> Sides:
    """Return cubes, of which the first are those before node 0, in whole nodes of ``width``^3."""
    before = width - 1
    return np.pad(sides, [(before, -(before + count) % width) for count in sides.shape])


def _joined(sides: Sides, width: int) -> Sides:
    """Return what nodes of ``width``^3 cubes are."""
    x, y, z = (count // width for count in sides.shape)
    cubes = sides.reshape(x, width, y, width, z, width)
    low, high = cubes.min((1, 3, 5)), cubes.max((1, 3, 5))
    joined: Sides = np.where(low == high, low, np.uint8(MIXED))
    return joined


def _part(cubes: NDArray[Any], place: NDArray[np.int64], width: int) -> NDArray[Any]:
    """Return the cubes of a node of ``width``^3."""
    x, y, z = (slice(width * at, width * (at + 1)) for at in place.tolist())
    return cubes[x, y, z]
