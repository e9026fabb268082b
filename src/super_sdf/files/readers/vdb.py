"""OpenVDB level sets and densities: every voxel of the box round those that are not background.

Voxel (i, j, k) is the sample at the grid's transform of (i, j, k). A file has of each grid flags of
its compression, metadata, the transform and the tree, as OpenVDB's source describes them (versions
222 and later). The root of a tree maps corners to nodes of 4096^3 voxels, those hold nodes of
128^3, and those leaves of 8^3. Where a node has no child it has a tile: one value for the whole
cube. The file has the topology first, then the values of the leaves, packed one by one. Only where
each leaf's values lie is kept; they are unpacked when a box of voxels is read.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray
from ...errors import FileError, GridError
from ...grid.planes import InputFile
from ..vdb_writer import (ACTIVE_MASK, ALL, BLOSC, EDGES, LEAF, MAGIC, MASKED, MASKED_ONE, MASKED_TWO, ONE_VALUE, ZIP)
from ..volume import Box, Request, Volume, from_affine

Ints = NDArray[np.int64]
Tiles = tuple[Ints, Ints, NDArray[Any], BoolArray]  # corners, edges, values, which are active
Leaves = tuple[Ints, NDArray[np.uint8]]  # corners, masks of active voxels
Entry = tuple[str, str, str, int]  # a grid's name, type, whose tree it shares, first byte

PIECE = 1 << 20  # bytes read at a time
ONES = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(1)  # bits of a byte


class _Cursor:
    """The bytes of a file, one after the other."""

    def __init__(self, file: InputFile, place: int = 0) -> None:
        self.file, self.place = file, place
        self._start, self._held = 0, b""

    def take(self, count: int) -> bytes:
        if not 0 <= count <= self.file.size - self.place:
            raise FileError(
                f"{self.file.name} is truncated or damaged: {count:,} bytes are to follow byte "
                f"{self.place:,} of {self.file.size:,}"
            )
        if not self._start <= self.place <= self.place + count <= self._start + len(self._held):
            size = min(max(count, PIECE), self.file.size - self.place)
            self._start, self._held = self.place, self.file.read(self.place, size).tobytes()
        first = self.place - self._start
        self.place += count
        return self._held[first : first + count]

    def skip(self, count: int) -> None:
        self.take(0)
        self.place += count

    def unpack(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def number(self, layout: str) -> Any:
        return self.unpack(layout)[0]

    def text(self) -> str:
        return self.take(self.number("I")).decode("utf-8", "replace")

    def array(self, dtype: Any, count: int) -> NDArray[Any]:
        return np.frombuffer(self.take(np.dtype(dtype).itemsize * count), dtype)


@dataclass(frozen=True)
class _Coding:
    """How the values of a tree are stored: their type, its packing, and the background."""

    dtype: np.dtype[Any]
    stored: np.dtype[Any]
    flags: int
    background: float

    def read(self, cursor: _Cursor, active: BoolArray) -> NDArray[Any]:
        values, selection, state = self._inactive(cursor, len(active))
        packed = state != ALL and self.flags & ACTIVE_MASK
        numbers = self._numbers(cursor, int(active.sum()) if packed else len(active))
        if not packed:
            return numbers
        filled = np.full(len(active), values[0], self.dtype)
        if selection is not None:
            filled[selection] = values[1]
        filled[active] = numbers
        return filled

    def skip(self, cursor: _Cursor, active: int) -> int:
        """Skip the values of a leaf of ``active`` active voxels; return how others are stored."""
        _, _, state = self._inactive(cursor, LEAF**3)
        partly = state != ALL and self.flags & ACTIVE_MASK
        cursor.skip(self._length(cursor, active if partly else LEAF**3)[0])
        return state

    def _inactive(self, cursor: _Cursor, count: int) -> tuple[list[float], BoolArray | None, int]:
        """Return the inactive values, which voxels have the second one, and how they are stored."""
        state = cursor.number("B")
        if state > ALL:
            raise FileError(f"{cursor.file.name} is damaged: a node's values are of kind {state}")
        values = [-self.background if state else self.background, self.background]
        stated = {ONE_VALUE: 1, MASKED_ONE: 1, MASKED_TWO: 2}.get(state, 0)
        values[:stated] = cursor.array(self.dtype, stated).tolist()
        masked = state in (MASKED, MASKED_ONE, MASKED_TWO)
        return values, _bits(cursor.array("u1", count // 8)) if masked else None, state

    def _length(self, cursor: _Cursor, count: int) -> tuple[int, bool]:
        if not self.flags & (ZIP | BLOSC) or (not count and self.stored != self.dtype):
            return count * self.stored.itemsize, False
        length = cursor.number("q")
        return abs(length), length > 0

    def _numbers(self, cursor: _Cursor, count: int) -> NDArray[Any]:
        length, packed = self._length(cursor, count)
        data, size = cursor.take(length), count * self.stored.itemsize
        if packed:
            data = _unpacked(data, size, self.flags & BLOSC)
        if len(data) != size:
            raise FileError(f"{cursor.file.name} is damaged: a node's values cannot be unpacked")
        return np.frombuffer(data, self.stored).astype(self.dtype)


def _bits(mask: NDArray[np.uint8]) -> BoolArray:
    return np.unpackbits(mask, bitorder="little").astype(bool)


def _unpacked(data: bytes, size: int, is_blosc: int) -> bytes:
    """Return the bytes of a zlib stream or Blosc buffer; none if they are damaged."""
    with suppress(zlib.error, RuntimeError, ValueError):
        if not is_blosc:
            stream = zlib.decompressobj()
            unpacked = stream.decompress(data, size + 1)
            return unpacked if stream.eof else b""
        from numcodecs import blosc

        # the header: four bytes, then the sizes unpacked, of a block, and packed
        if len(data) >= 16 and struct.unpack_from("<I4xI", data, 4) == (size, len(data)):
            return bytes(blosc.decompress(data))
    return b""


class _Tree:
    """The T tiles and L leaves of a grid, which are read from a byte of a file on.

    ``places`` are where the values of each leaf begin; a leaf that is ``whole`` may have inactive
    voxels of other values than the background. ``coding`` makes the coding of a background.
    """

    def __init__(self, file: InputFile, place: int, coding: Callable[[float], _Coding]) -> None:
        self.file, cursor = file, _Cursor(file, place)
        buffers = cursor.number("I")
        if buffers != 1:
            raise FileError(f"{file.name} is damaged: its tree has {buffers} buffers, not one")
        dtype = coding(0.0).dtype
        self.coding = coding(float(cursor.array(dtype, 1)[0]))
        corner, edge = np.empty((0, 3), np.int64), np.empty(0, np.int64)
        tiles: list[Tiles] = [(corner, edge, np.empty(0, dtype), np.empty(0, bool))]
        leaves: list[Leaves] = [(corner, np.empty((0, LEAF**3 // 8), np.uint8))]
        for part in self._parts(cursor):
            (tiles if len(part) == 4 else leaves).append(part)  # type: ignore[arg-type]
        self.corners, self.edges, self.values, self.active = map(np.concatenate, zip(*tiles))
        self.leaves, self.masks = map(np.concatenate, zip(*leaves))
        counts = ONES[self.masks].sum(1)
        self.places = np.empty(len(counts), np.int64)
        self.whole = np.empty(len(counts), bool)
        for leaf, count in enumerate(counts.tolist()):  # after the topology, each after its mask
            cursor.skip(LEAF**3 // 8)
            self.places[leaf] = cursor.place
            self.whole[leaf] = self.coding.skip(cursor, count) != 0
        cursor.skip(0)
        self.active_count = int(counts.sum()) + int((self.edges[self.active] ** 3).sum())

    def _parts(self, cursor: _Cursor) -> Iterator[Tiles | Leaves]:
        tiles, children = cursor.unpack("II")
        for _ in range(tiles):
            corner = cursor.array("<i4", 3).astype(np.int64)[None]
            value = cursor.array(self.coding.dtype, 1)
            yield self._tiles(corner, EDGES[0], value, _bits(cursor.array("u1", 1))[:1])
        for _ in range(children):
            yield from self._node(cursor, cursor.array("<i4", 3).astype(np.int64), EDGES)

    def _node(
        self, cursor: _Cursor, corner: Ints, edges: tuple[int, ...]
    ) -> Iterator[Tiles | Leaves]:
        """Yield what is in a node whose children have the second edge, or are leaves."""
        edge = edges[1] if len(edges) > 1 else LEAF
        count = edges[0] // edge
        child, active = (_bits(cursor.array("u1", count**3 // 8)) for _ in range(2))
        values = self.coding.read(cursor, active)
        corners = corner + edge * np.argwhere(np.ones((count,) * 3, bool))
        yield self._tiles(corners[~child], edge, values[~child], active[~child])
        if edge > LEAF:
            for place in corners[child]:
                yield from self._node(cursor, place, edges[1:])
            return
        masks = cursor.array("u1", 64 * int(child.sum()))
        yield corners[child], masks.reshape(-1, LEAF**3 // 8)

    def _tiles(self, corners: Ints, edge: int, values: NDArray[Any], active: BoolArray) -> Tiles:
        """Return the tiles that are active, or have another value than the background."""
        kept = active | (values != self.coding.background)
        return corners[kept], np.full(int(kept.sum()), edge), values[kept], active[kept]

    def bounds(self) -> tuple[Ints, Ints] | None:
        """Return the first voxel and the one after the last that is no inactive background."""
        by_axis = self.masks.reshape(-1, LEAF, LEAF)  # the bits of a byte are along z
        z = np.bitwise_or.reduce(self.masks, axis=1)[:, None]
        lines = [by_axis.any(2), by_axis.any(1), np.unpackbits(z, axis=1, bitorder="little")]
        along = np.stack(lines, axis=1).astype(bool)  # (L, 3, 8): whether any voxel is active there
        along[self.whole] = True
        some = along.any((1, 2))
        firsts, ends = along.argmax(2), LEAF - along[:, :, ::-1].argmax(2)
        low = np.concatenate([self.corners, (self.leaves + firsts)[some]])
        high = np.concatenate([self.corners + self.edges[:, None], (self.leaves + ends)[some]])
        return (low.min(0), high.max(0)) if len(low) else None

    def is_signed(self) -> bool:
        cursor, leaves = _Cursor(self.file), range(len(self.leaves))
        negative = any((self._values_of(cursor, leaf)[0] < 0).any() for leaf in leaves)
        return negative or bool((self.values < 0).any())

    def read(self, first: Ints, shape: tuple[int, ...], *, unknown: bool = False) -> NDArray[Any]:
        background = np.nan if unknown else self.coding.background
        box = np.full(shape, background, self.coding.dtype)
        for tile in np.flatnonzero(_touch(self.corners, self.edges[:, None], first, shape)):
            edges = (int(self.edges[tile]),) * 3
            _put(box, np.broadcast_to(self.values[tile], edges), self.corners[tile] - first)
        cursor = _Cursor(self.file)
        for leaf in np.flatnonzero(_touch(self.leaves, LEAF, first, shape)).tolist():
            values, active = self._values_of(cursor, leaf)
            if unknown:
                values[~active & (values == self.coding.background)] = np.nan
            _put(box, values.reshape(LEAF, LEAF, LEAF), self.leaves[leaf] - first)
        return box

    def _values_of(self, cursor: _Cursor, leaf: int) -> tuple[NDArray[Any], BoolArray]:
        cursor.place = int(self.places[leaf])
        active = _bits(self.masks[leaf])
        return self.coding.read(cursor, active), active


def _touch(corners: Ints, edges: Any, first: Ints, shape: tuple[int, ...]) -> BoolArray:
    overlap = (corners < first + np.array(shape)) & (corners + edges > first)
    return np.asarray(overlap.all(1))


def _put(box: NDArray[Any], values: NDArray[Any], start: Ints) -> None:
    low = np.maximum(start, 0)
    high = np.minimum(start + values.shape, box.shape)
    there = tuple(slice(a, b) for a, b in zip(low, high))
    box[there] = values[tuple(slice(a, b) for a, b in zip(low - start, high - start))]


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


def read_vdb(request: Request) -> Volume:
    """Read a grid of floating-point values of a ``.vdb`` file.

    Every voxel has the value that OpenVDB gives it, inactive ones too. A background of 0 is no
    distance: where values are signed, voxels that have it and are not active are unknown.
    """
    file = InputFile.open(request.path)
    entries = _entries(file)
    usable = [entry for entry in entries if entry[1].removesuffix(HALF) in TYPES]
    names = [name for name, *_ in usable]
    if request.describes and request.member is None:
        names = names[:1]
    chosen = names.index(request.choose(names, "grid of floating-point values"))
    name, kind, parent, place = usable[chosen]
    flags, metadata, affine, place = _read_head(file, place)
    if parent:  # whose tree it shares
        places = [place for name, _, _, place in entries if name == parent]
        if not places:
            raise FileError(f"{file.name} is damaged: it lacks the grid {parent!r}")
        flags, _, _, place = _read_head(file, places[0])
    dtype = TYPES[kind.removesuffix(HALF)]
    stored = np.dtype("<f2") if kind.endswith(HALF) else dtype
    tree = _Tree(file, place, partial(_Coding, dtype, stored, flags))
    stated = metadata.get("file_voxel_count", tree.active_count)
    if stated != tree.active_count:
        raise FileError(
            f"{file.name} is damaged: it has {tree.active_count:,} active voxels and states "
            f"{stated:,}"
        )
    volume = _volume(file, tree, metadata, affine)
    return _with_grids(volume, file, entries, name) if request.describes else volume


def _with_grids(volume: Volume, file: InputFile, entries: list[Entry], read: str) -> Volume:
    """Return a volume that says which grids its file holds, and which of them it is."""
    grids = []
    for name, kind, _, place in entries:
        metadata = _read_metadata(_Cursor(file, place + 4))
        kind = kind.removeprefix("Tree_").split("_")[0]
        grids.append({"name": name, "type": kind, "class": metadata.get("class", "unknown")})
        grids[-1]["active_voxels"] = metadata.get("file_voxel_count")
    other = f"shape and place are those of {read!r}: give {file.name}:NAME for another grid"
    notes = volume.notes + (other,) * (len(grids) > 1)
    return replace(volume, about={"grids": grids}, notes=notes)


def _entries(file: InputFile) -> list[Entry]:
    cursor = _Cursor(file)
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
        entries.append((name, type_, parent, cursor.place))
        if count > 1:
            cursor.place = end
            cursor.skip(0)
    return entries


def _read_head(file: InputFile, place: int) -> tuple[int, dict[str, Any], NDArray[np.float64], int]:
    cursor = _Cursor(file, place)
    flags = cursor.number("I")
    metadata = _read_metadata(cursor)
    return flags, metadata, _read_transform(cursor), cursor.place


def _read_metadata(cursor: _Cursor) -> dict[str, Any]:
    metadata: dict[str, Any] = {}
    for _ in range(cursor.number("I")):
        name, type_ = cursor.text(), cursor.text()
        data = _Cursor(cursor.file, cursor.place + 4)
        cursor.skip(cursor.number("I"))
        if type_ == "string":
            metadata[name] = data.take(cursor.place - data.place).decode("utf-8", "replace")
        elif type_ in NUMBERS:
            metadata[name] = data.number(NUMBERS[type_])
    return metadata


def _read_transform(cursor: _Cursor) -> NDArray[np.float64]:
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
    file: InputFile, tree: _Tree, metadata: dict[str, Any], affine: NDArray[np.float64]
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
