"""OpenVDB files: numbers of the format, and refined fields as level sets; see ``readers.vdb``.

Node (i, j, k) of the fine lattice is voxel (i, j, k). Active are the voxels nearer to the surface
than three spacings of the lattice. All others have the background, which is those three spacings,
or minus the background inside. A level set is closed: a solid that leaves the lattice is cut off at
its border, so no node is deeper inside than the border is away, and voxels beyond are outside.

Of a node of the tree the active values are stored, and the signs of the others. Nothing is packed:
zlib would take long and save about a fifth. OpenVDB 5 and later read the file.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from uuid import NAMESPACE_OID, uuid5

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray
from ..errors import NoSurfaceError, OptionError
from ..grid.sdf_grid import SdfGrid
from ..refine.field import FineField, FineLattice, fine_grid

MAGIC = 0x56444220
ZIP, ACTIVE_MASK, BLOSC = 1, 2, 4  # flags of a grid's compression
# How the inactive values of a node are stored: 0 to 2 have one; in 3 to 5 a mask chooses between
# two (in 3 the background, where it is set, and minus that); the last stores every value.
ONE_VALUE, MASKED, MASKED_ONE, MASKED_TWO, ALL = 2, 3, 4, 5, 6
EDGES = (4096, 128)  # voxels along a child of the root, and along a child of that
LEAF = 8
OUTSIDE, INSIDE, MIXED = 0, 1, 2  # a cube of voxels: all background, all minus that, or neither
WIDTHS = EDGES[0] // EDGES[1], EDGES[1] // LEAF  # children along an edge of the two inner nodes
MASK_BYTES = LEAF**3 // 8
VERSION, LIBRARY = 224, (5, 0)  # of the format, and of the first library with it
HALF_WIDTH = 3  # voxels of the narrow band to either side of the surface; OpenVDB's tools want 3
SIZES = 2e-5, 1e30  # of a voxel: OpenVDB refuses transforms with a determinant below 3e-15

Sides = NDArray[np.uint8]  # what each cube is, (x, y, z)


@dataclass(frozen=True, eq=False)
class LevelSet:
    """What a file holds."""

    grid: SdfGrid  # where the voxels are
    background: np.float32
    sides: Sides  # of the cubes of 8^3 voxels; the first along each axis is that before voxel 0
    leaves: list[bytes]  # of the mixed cubes, in C order
    active: int  # voxels


def write_level_set(field: FineField, path: Path) -> None:
    """Write a refined field as a file with one level set, ``surface``.

    OptionError if OpenVDB does not take voxels of this size; NoSurfaceError.
    """
    grid = fine_grid(field)
    if not SIZES[0] <= grid.voxel_size <= SIZES[1]:
        raise OptionError(
            f"the voxels of the field are {grid.voxel_size:.3g}, and OpenVDB takes {SIZES[0]:g} to "
            f"{SIZES[1]:g}: multiply distances, spacing and origin of the grid, or write .npz"
        )
    background = np.float32(HALF_WIDTH * grid.voxel_size)
    sides: list[Sides] = []
    leaves: list[bytes] = []
    count = 0
    for values in _slabs(field, background):
        cubes = values.reshape(LEAF, values.shape[1] // LEAF, LEAF, -1, LEAF)
        side = np.full(cubes.shape[1:4:2], MIXED, np.uint8)
        side[cubes.min((0, 2, 4)) >= background] = OUTSIDE
        side[cubes.max((0, 2, 4)) <= -background] = INSIDE
        inner = cubes.transpose(1, 3, 0, 2, 4)[side == MIXED]  # (n, 8, 8, 8)
        active = np.abs(inner) < background
        count += int(np.count_nonzero(active))
        leaves += map(leaf_bytes, inner.reshape(-1, LEAF**3), active.reshape(-1, LEAF**3))
        sides.append(side)
    if not count:
        raise NoSurfaceError("the field has no surface: there is no level set to write")
    with path.open("wb") as file:
        write_tree(file, LevelSet(grid, background, np.stack(sides), leaves, count))


def _slabs(field: FineField, background: np.float32) -> Iterator[FloatArray]:
    """Yield eight planes of voxels after the other, (8, y, z), from voxel (-8, -8, -8) on.

    Beyond the lattice are the distances from a surface of which its border is the nearest part.
    """
    lattice = FineLattice(field)
    least, beyond, pads = [], [], []  # along each axis
    for n in lattice.shape:
        end = LEAF * -(-(n + HALF_WIDTH - 1) // LEAF)  # what is beyond is all background
        at, inner = np.arange(-LEAF, end), np.arange(n)
        depth = np.minimum(inner, n - 1 - inner)  # no node is deeper inside than the border is away
        least.append((depth * -background / HALF_WIDTH).astype(np.float32) + np.float32(0))
        beyond.append(np.maximum(np.maximum(-at, at - n + 1), 0) * background / HALF_WIDTH)
        pads.append((LEAF, end - n))
    least_across = np.maximum(least[1][:, None], least[2])
    beyond_across = np.hypot(beyond[1][:, None], beyond[2])
    count = lattice.shape[0]
    for first in range(-LEAF, count + pads[0][1], LEAF):
        x = np.arange(first, first + LEAF).clip(0, count - 1)
        planes = lattice[int(x[0]) : int(x[-1]) + 1]
        floor = np.maximum(least[0][x[0] : x[-1] + 1, None, None], least_across)
        planes = np.maximum(planes, floor)
        values = np.pad(planes[x - x[0]], [(0, 0), *pads[1:]], mode="edge")
        away = np.hypot(beyond[0][first + LEAF : first + 2 * LEAF, None, None], beyond_across)
        np.hypot(values, away.astype(np.float32), out=values, where=away > 0)
        yield values


def leaf_bytes(values: FloatArray, active: BoolArray) -> bytes:
    """Return a leaf of 512 values, those that are not ``active`` the background or minus it."""
    stored = values[active].astype("<f4", copy=False).tobytes()
    return _mask(active) + bytes([MASKED]) + _mask(values > 0) + stored


def write_tree(file: IO[bytes], tree: LevelSet) -> None:
    """Write a file with one grid, ``surface``."""
    file.write(struct.pack("<qIII?", MAGIC, VERSION, *LIBRARY, True))
    own = uuid5(NAMESPACE_OID, f"{tree.grid!r} {tree.active}")  # the file's own number
    file.write(str(own).encode() + struct.pack("<II", 0, 1))
    file.write(_text("surface") + _text("Tree_float_5_4_3") + _text(""))
    places = file.tell()
    start = places + struct.calcsize("<qqq")
    file.write(bytes(start - places))  # they follow
    entries = (
        ("class", "string", b"level set"),
        ("file_voxel_count", "int64", struct.pack("<q", tree.active)),
        ("is_saved_as_half_float", "bool", b"\0"),
        ("name", "string", b"surface"),
    )
    file.write(struct.pack("<II", ACTIVE_MASK, len(entries)))
    file.writelines(_text(name) + _text(kind) + _text(value) for name, kind, value in entries)
    file.write(_transform(tree.grid))
    leaves = _write_topology(file, tree)
    values = file.tell()
    file.writelines(tree.leaves[leaf] for leaf in leaves)
    end = file.tell()
    file.seek(places)
    file.write(struct.pack("<qqq", start, values, end))


def _write_topology(file: IO[bytes], tree: LevelSet) -> list[int]:
    """Write the nodes without the leaves' values; return the numbers of the leaves in order."""
    leaves, inner = _nodes(tree.sides, WIDTHS[1])
    inner, root = _nodes(inner, WIDTHS[0])
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
            file.write(b"".join(tree.leaves[leaf][:MASK_BYTES] for leaf in held))
            order += held
    return order


def _transform(grid: SdfGrid) -> bytes:
    """Return the map from indices to the world: a matrix only where it is turned."""
    steps, origin = np.array(grid.spacing), np.array(grid.origin)
    if not grid.is_straight:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[3, :3] = (np.array(grid.direction) * steps).T, origin
        return _text("AffineMap") + matrix.astype("<f8").tobytes()
    name = "ScaleTranslateMap" if np.ptp(steps) else "UniformScaleTranslateMap"
    numbers = np.array([origin, steps, steps, 1 / steps, 1 / steps**2, 0.5 / steps], "<f8")
    return _text(name) + numbers.tobytes()


def _text(words: str | bytes) -> bytes:
    data = words.encode() if isinstance(words, str) else words
    return struct.pack("<I", len(data)) + data


def _mask(on: BoolArray) -> bytes:
    return np.packbits(on, bitorder="little").tobytes()


def _node(sides: Sides) -> bytes:
    """Return a node without its children: which there are, no active tile, and the others."""
    outside = _mask(sides.ravel() == OUTSIDE)
    return _mask(sides.ravel() == MIXED) + bytes(len(outside)) + bytes([MASKED]) + outside


def _nodes(sides: Sides, width: int) -> tuple[Sides, Sides]:
    """Return cubes in whole nodes of ``width``^3, and what the nodes are.

    The first cubes are those before node 0.
    """
    before = width - 1
    padded = np.pad(sides, [(before, -(before + count) % width) for count in sides.shape])
    x, y, z = (count // width for count in padded.shape)
    cubes = padded.reshape(x, width, y, width, z, width)
    low, high = cubes.min((1, 3, 5)), cubes.max((1, 3, 5))
    return padded, np.where(low == high, low, np.uint8(MIXED))


def _part(cubes: NDArray[Any], place: NDArray[np.int64], width: int) -> NDArray[Any]:
    """Return the cubes of a node of ``width``^3."""
    x, y, z = (slice(width * at, width * (at + 1)) for at in place.tolist())
    return cubes[x, y, z]
