"""OpenVDB: level sets and densities in, refined fields out as level sets.

Voxel (i, j, k) is the sample at the grid's transform of (i, j, k); of a field it is node (i, j, k)
of the fine lattice. A file has of each grid flags of its compression, metadata, the transform and
the tree, as OpenVDB's source describes them (versions 222 and later). The root of a tree maps
corners to nodes of 4096^3 voxels, those hold nodes of 128^3, and those leaves of 8^3. Where a node
has no child it has a tile: one value for the whole cube. The file has the topology first, then the
values of the leaves, packed one by one.

In a file that is written here, the voxels nearer to the surface than three spacings are active. All
others have the background, which is those three spacings, or minus the background inside. A level
set is closed: a solid that leaves the lattice is cut off at its border. OpenVDB 5 reads the file.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_OID, uuid5

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray, FloatArray
from ...errors import FileError, GridError, NoSurfaceError
from ...grid.sdf_grid import SdfGrid
from ...refine.field import FineField, FineLattice, fine_grid
from . import DISTANCE, Request, Volume, from_affine

Ints = NDArray[np.int64]

MAGIC = 0x56444220
OLDEST = 222  # version of the file format that is read, of OpenVDB 3
VERSION, LIBRARY = 224, (5, 0)  # that is written, and the first library with it
ZIP, ACTIVE_MASK, BLOSC = 1, 2, 4  # flags of a grid's compression
# How the inactive values of a node are stored: 0 to 2 have one; in 3 to 5 a mask chooses between
# two (in 3 the background, where it is set, and minus that); the last stores every value.
MASKED, ALL = 3, 6
STATED = (0, 0, 1, 0, 1, 2, 0)  # how many inactive values a node has itself
EDGES = (4096, 128, 8)  # voxels along a node below the root, along one below that, and a leaf
LEAF = EDGES[2]
CUBE = (LEAF,) * 3
WIDTHS = EDGES[0] // EDGES[1], EDGES[1] // LEAF  # children along an edge of the two inner nodes
F4, F8 = np.dtype("<f4"), np.dtype("<f8")
TYPES: dict[str, np.dtype[Any]] = {"Tree_float_5_4_3": F4, "Tree_double_5_4_3": F8}
HALF = "_HalfFloat"  # ends the type of a grid whose values are stored in 16 bits
NUMBERS = {"float": "f", "double": "d"}  # of metadata
# How many vectors a map has: the translation, and five of the scale
MAPS = {"TranslationMap": 1, "ScaleMap": 5, "ScaleTranslateMap": 6}
PICOGK_MM = 1000  # PicoGK states the size of a voxel in metres, and works in millimetres
MARGIN = 2  # voxels of background around the others, so that the border is outside
OUTSIDE, INSIDE, MIXED = 0, 1, 2  # a cube of voxels: all background, all minus that, or neither
HALF_WIDTH = 3  # voxels of the narrow band to either side of the surface; OpenVDB's tools want 3

# Reading


def read_vdb(request: Request) -> Volume:
    """Read a grid of floating-point values of a ``.vdb`` file.

    Every voxel has the value that OpenVDB gives it, inactive ones too. A background of 0 is no
    distance: where values are signed, voxels that have it and are not active are unknown.
    """
    file = _Bytes(request.path.read_bytes())
    grids = _grids_in(file)
    kind, file.place = grids[request.choose(list(grids), "grid of floating-point values")]
    (flags,), metadata, matrix = file.numbers("I"), file.metadata(), _transform(file)
    tree = _Tree(file, kind, flags)
    if not tree.ends:
        raise GridError("it has no active voxel: it holds no surface")
    margin = 0 if np.isnan(tree.empty) else MARGIN
    low, high = np.min(tree.ends, 0) - margin, np.max(tree.ends, 0) + margin
    size = PICOGK_MM * float(metadata.get("PicoGK.VoxelSize", 1 / PICOGK_MM))
    matrix = size * np.column_stack([matrix[:, :3], matrix[:, :3] @ low + matrix[:, 3]])
    return Volume(
        lambda _: tree.voxels(low, high) * tree.dtype.type(size),
        *(tuple((high - low).tolist()), tree.dtype),
        **from_affine(matrix),
        hint=DISTANCE if metadata.get("class") == "level set" else "",
        notes=("lengths are in millimetres, as PicoGK states",) * (size != 1),
    )


def _grids_in(file: _Bytes) -> dict[str, tuple[str, int]]:
    """Return type and place of those grids by their names that can be read."""
    magic, version, *_ = file.numbers("qIII?36s")  # the library's version, the file's own number
    if magic != MAGIC or version < OLDEST:
        raise FileError("it is no .vdb file of OpenVDB 3 or later: save it with openvdb.write")
    file.metadata()
    (count,), grids = file.numbers("I"), {}
    for _ in range(count):
        name, kind, parent = (file.text().replace("\x1e", "#") for _ in range(3))
        *_, end = file.numbers("qqq")
        if kind.removesuffix(HALF) in TYPES and not parent:  # whose tree it would share
            grids[name] = kind, file.place
        file.place = end
    return grids


class _Bytes:
    """The bytes of a file, one after the other."""

    def __init__(self, data: bytes) -> None:
        self.data, self.place = data, 0

    def take(self, count: int) -> bytes:
        self.place += count
        if not 0 <= self.place - count <= self.place <= len(self.data):
            raise FileError("it is truncated or damaged")
        return self.data[self.place - count : self.place]

    def numbers(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack(f"<{layout}", self.take(struct.calcsize(f"<{layout}")))

    def text(self) -> str:
        return self.take(*self.numbers("I")).decode("utf-8", "replace")

    def array(self, dtype: Any, *shape: int) -> NDArray[Any]:
        data = self.take(np.dtype(dtype).itemsize * prod(shape))
        return np.frombuffer(data, dtype).reshape(shape)

    def mask(self, count: int) -> BoolArray:
        return np.unpackbits(self.array("u1", count // 8), bitorder="little").astype(bool)

    def metadata(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for _ in range(*self.numbers("I")):
            name, kind, data = self.text(), self.text(), self.take(*self.numbers("I"))
            found[name] = data.decode("utf-8", "replace")
            if kind in NUMBERS:
                (found[name],) = struct.unpack(f"<{NUMBERS[kind]}", data)
        return found


def _transform(file: _Bytes) -> NDArray[np.float64]:
    """Return the matrix (3, 4) from indices to world coordinates."""
    kind = file.text()
    if kind in ("AffineMap", "UnitaryMap"):  # OpenVDB multiplies rows by it
        return file.array(F8, 4, 4).T[:3]
    kind = kind.removeprefix("Uniform")
    if kind not in MAPS:
        raise GridError(f"its transform is a {kind}: resample the grid to a linear transform")
    vectors = file.array(F8, MAPS[kind], 3)
    moved = vectors[0] if "Translat" in kind else np.zeros(3)
    return np.column_stack([np.diag(vectors[-5] if "Scale" in kind else np.ones(3)), moved])


class _Tree:
    """What a tree holds besides inactive background, whose value is ``empty``, NaN if unknown.

    ``cubes`` are tiles and leaves: corner, edge, values (a tile has one), and which of them count.
    ``ends`` are the first voxel, and the one after the last, of each.
    """

    def __init__(self, file: _Bytes, kind: str, flags: int) -> None:
        self.file, self.flags = file, flags
        self.dtype = TYPES[kind.removesuffix(HALF)]
        self.stored = np.dtype("<f2") if kind.endswith(HALF) else self.dtype
        file.numbers("I")  # of buffers, which is 1
        self.background = float(file.array(self.dtype, 1)[0])
        self.cubes: list[tuple[Ints, int, Any, Any]] = []
        self.ends: list[Ints] = []
        tiles, children = file.numbers("II")
        row = np.dtype([("corner", "<i4", 3), ("value", self.dtype), ("active", "u1")])
        rows = file.array(row, tiles)
        corners = rows["corner"].astype(np.int64)
        self._add_tiles(corners, EDGES[0], rows["value"], rows["active"] & 1 > 0)
        leaves = list[Ints]()
        for _ in range(children):
            for node in self._children(file.array("<i4", 3).astype(np.int64), 0):
                for corner in self._children(node, 1):
                    file.mask(LEAF**3)  # there again before the leaf's values
                    leaves.append(corner)
        for corner in leaves:  # after the topology, each after its mask
            active = file.mask(LEAF**3)
            values = self._values(active)
            shown = (active | (values != self.background)).reshape(CUBE)
            if len(places := np.argwhere(shown)):
                self.cubes.append((corner, LEAF, values.reshape(CUBE), shown))
                self.ends += [corner + places.min(0), corner + places.max(0) + 1]
        is_signed = any(np.min(values) < 0 for _, _, values, _ in self.cubes)
        self.empty = np.nan if is_signed and not self.background else self.background

    def _add_tiles(self, corners: Ints, edge: int, values: Any, active: BoolArray) -> None:
        """Take those tiles that are no inactive background."""
        for n in np.flatnonzero(active | (values != self.background)):
            self.cubes.append((corners[n], edge, values[n], True))
            self.ends += [corners[n], corners[n] + edge]

    def _children(self, corner: Ints, depth: int) -> Iterator[Ints]:
        """Take the tiles of a node, and yield the corners of its children, which are next."""
        edge, count = EDGES[depth + 1], WIDTHS[depth]
        child, active = self.file.mask(count**3), self.file.mask(count**3)
        values = self._values(active)
        corners = corner + edge * np.argwhere(np.ones((count,) * 3, bool))
        self._add_tiles(corners[~child], edge, values[~child], active[~child])
        yield from corners[child]

    def _values(self, active: BoolArray) -> NDArray[Any]:
        """Return the next values of a node."""
        file, count = self.file, len(active)
        (state,) = file.numbers("B")
        values = [-self.background if state else self.background, self.background]
        stated = STATED[min(state, ALL)]
        values[:stated] = file.array(self.dtype, stated).tolist()
        selection = file.mask(count) if MASKED <= state < ALL else np.zeros(count, bool)
        if state >= ALL or not self.flags & ACTIVE_MASK:
            return self._numbers(count)
        filled = np.where(selection, *np.array(values[::-1], self.dtype))
        filled[active] = self._numbers(int(active.sum()))
        return filled

    def _numbers(self, count: int) -> NDArray[Any]:
        """Return the next numbers, which are a zlib stream, a Blosc buffer, or as they are."""
        size, is_blosc = count * self.stored.itemsize, self.flags & BLOSC
        is_packed = (self.flags & ZIP or is_blosc) and (count or self.stored == self.dtype)
        (length,) = self.file.numbers("q") if is_packed else (-size,)
        data = self.file.take(abs(length))
        if length > 0 and not is_blosc:
            data = zlib.decompressobj().decompress(data, size + 1)
        # the header of Blosc: four bytes, then the sizes unpacked, of a block, and packed
        elif length >= 16 and struct.unpack_from("<I4xI", data, 4) == (size, length):
            from numcodecs import blosc

            data = bytes(blosc.decompress(data)) if size else b""
        if len(data) != size:
            raise FileError("it is damaged: the values of a node cannot be unpacked")
        return np.frombuffer(data, self.stored).astype(self.dtype)

    def voxels(self, low: Ints, high: Ints) -> NDArray[Any]:
        """Return all voxels from ``low`` to before ``high``, between which all cubes are."""
        first = low // LEAF * LEAF
        box = np.full(-(-high // LEAF) * LEAF - first, self.empty, self.dtype)
        for corner, edge, values, shown in self.cubes:
            at = corner - first
            box[tuple(map(slice, at, at + edge))] = np.where(shown, values, self.empty)
        return box[tuple(map(slice, low - first, high - first))]


# Writing


def write_level_set(field: FineField, path: Path) -> None:
    """Write a refined field as a file with one level set, ``surface``."""
    grid = fine_grid(field)
    background = np.float32(HALF_WIDTH * grid.voxel_size)
    sides: list[NDArray[np.uint8]] = []  # of the cubes of 8^3 voxels, from that before voxel 0 on
    leaves: dict[tuple[int, ...], bytes] = {}  # by the place of their cube in ``sides``
    count = 0
    for values in _slabs(field, background):
        cubes = values.reshape(LEAF, values.shape[1] // LEAF, LEAF, -1, LEAF)
        side = np.full(cubes.shape[1:4:2], MIXED, np.uint8)
        side[cubes.min((0, 2, 4)) >= background] = OUTSIDE
        side[cubes.max((0, 2, 4)) <= -background] = INSIDE
        for y, z in np.argwhere(side == MIXED).tolist():
            leaf = cubes[:, y, :, z]
            active = np.abs(leaf) < background
            count += int(np.count_nonzero(active))
            stored = leaf[active].astype("<f4", copy=False).tobytes()
            leaves[len(sides), y, z] = _mask(active) + bytes([MASKED]) + _mask(leaf > 0) + stored
        sides.append(side)
    if not count:
        raise NoSurfaceError("the field has no surface: there is no level set to write")
    topology, order = _topology(np.stack(sides), leaves, background)
    own = str(uuid5(NAMESPACE_OID, f"{grid!r} {count}"))  # the file's own number
    head = struct.pack("<qIII?36sII", MAGIC, VERSION, *LIBRARY, True, own.encode(), 0, 1)
    head += _text("surface") + _text("Tree_float_5_4_3") + _text("")
    about = _about(grid, count)
    start = len(head) + struct.calcsize("<qqq")
    values_start = start + len(about) + len(topology)
    end = values_start + sum(map(len, leaves.values()))
    with path.open("wb") as file:
        file.write(head + struct.pack("<qqq", start, values_start, end) + about + topology)
        file.writelines(leaves[place] for place in order)


def _slabs(field: FineField, background: np.float32) -> Iterator[FloatArray]:
    """Yield eight planes of voxels after the other, (8, y, z), from voxel (-8, -8, -8) on.

    Beyond the lattice are distances from a surface that its border is nearest to.
    """
    lattice, voxel = FineLattice(field), float(background) / HALF_WIDTH
    places = [np.arange(-LEAF, LEAF * -(-(n + HALF_WIDTH - 1) // LEAF)) for n in lattice.shape]
    inner = [at.clip(0, n - 1) for at, n in zip(places, lattice.shape)]
    depths = np.ix_(*(np.minimum(at, n - 1 - at) for at, n in zip(inner, lattice.shape)))
    beyond = np.ix_(*(np.abs(at - within) for at, within in zip(places, inner)))
    for first in range(0, len(places[0]), LEAF):
        part = slice(first, first + LEAF)
        x = inner[0][part]
        planes = lattice[int(x[0]) : int(x[-1]) + 1][np.ix_(x - x[0], *inner[1:])]
        depth = np.minimum(np.minimum(depths[0][part], depths[1]), depths[2])
        values = np.maximum(planes, np.float32(0) - (voxel * depth).astype(np.float32))
        away = voxel * np.hypot(np.hypot(beyond[0][part], beyond[1]), beyond[2])
        yield np.hypot(values, away.astype(np.float32), out=values, where=away > 0)


def _about(grid: SdfGrid, count: int) -> bytes:
    """Return what a grid begins with: flags, metadata and transform."""
    entries = (
        ("class", "string", b"level set"),
        ("file_voxel_count", "int64", struct.pack("<q", count)),
        ("is_saved_as_half_float", "bool", b"\0"),
        ("name", "string", b"surface"),
    )
    metadata = b"".join(_text(name) + _text(kind) + _text(value) for name, kind, value in entries)
    steps, origin = np.array(grid.spacing), np.array(grid.origin)
    kind = "ScaleTranslateMap" if np.ptp(steps) else "UniformScaleTranslateMap"
    matrix = np.array([origin, steps, steps, 1 / steps, 1 / steps**2, 0.5 / steps])
    if not grid.is_straight:
        kind, matrix = "AffineMap", np.eye(4)
        matrix[:3, :3], matrix[3, :3] = (np.array(grid.direction) * steps).T, origin
    head = struct.pack("<II", ACTIVE_MASK, len(entries)) + metadata
    return head + _text(kind) + matrix.astype(F8).tobytes()


def _topology(
    sides: NDArray[np.uint8], leaves: dict[tuple[int, ...], bytes], background: np.float32
) -> tuple[bytes, list[tuple[int, ...]]]:
    """Return the tree without the leaves' values, and the places of the leaves in its order."""
    width, before = WIDTHS[1], WIDTHS[1] - 1  # whole nodes, from that before voxel 0 on
    padded = np.pad(sides, [(before, -(before + n) % width) for n in sides.shape])
    x, y, z = (n // width for n in padded.shape)
    nodes = padded.reshape(x, width, y, width, z, width).transpose(0, 2, 4, 1, 3, 5)
    roots: dict[tuple[int, ...], list[Ints]] = {}
    for place in np.argwhere((nodes != OUTSIDE).any((3, 4, 5))):
        roots.setdefault(tuple(((place - 1) // WIDTHS[0]).tolist()), []).append(place)
    parts = [struct.pack("<IfII", 1, background, 0, len(roots))]
    order: list[tuple[int, ...]] = []
    for root, within in roots.items():
        has_child = np.zeros((WIDTHS[0],) * 3, bool)
        has_child[tuple((np.array(within).T - 1) % WIDTHS[0])] = True
        parts += [struct.pack("<3i", *(EDGES[0] * np.array(root))), _node(has_child, ~has_child)]
        for place in within:
            node = nodes[tuple(place)]
            held = np.argwhere(node == MIXED) + width * place - before
            children = [(x, y, z) for x, y, z in held.tolist()]
            masks = [leaves[child][: LEAF**3 // 8] for child in children]
            parts += [_node(node == MIXED, node == OUTSIDE), *masks]
            order += children
    return b"".join(parts), order


def _node(has_child: BoolArray, is_outside: BoolArray) -> bytes:
    """Return a node without its children: all its tiles are inactive."""
    return _mask(has_child) + bytes(has_child.size // 8) + bytes([MASKED]) + _mask(is_outside)


def _mask(on: BoolArray) -> bytes:
    return np.packbits(on, bitorder="little").tobytes()


def _text(words: str | bytes) -> bytes:
    data = words.encode() if isinstance(words, str) else words
    return struct.pack("<I", len(data)) + data
