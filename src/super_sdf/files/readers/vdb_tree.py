"""The tree of a grid in a ``.vdb`` file, as OpenVDB's source describes it (versions 222 and later).

A root maps corners to nodes of 4096^3 voxels, those hold nodes of 128^3, and those leaves of 8^3.
Where a node has no child it has a tile: one value for the whole cube. The file has the topology
first, then the values of the leaves, packed one by one. Only where each leaf's values lie is kept;
they are unpacked when a box of voxels is read.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray
from ...errors import FileError
from ...grid.planes import InputFile

Ints = NDArray[np.int64]
Tiles = tuple[Ints, Ints, NDArray[Any], BoolArray]  # corners, edges, values, which are active
Leaves = tuple[Ints, NDArray[np.uint8]]  # corners, masks of active voxels

ZIP, ACTIVE_MASK, BLOSC = 1, 2, 4  # flags of a grid's compression
# How the inactive values of a node are stored, besides the active ones. The first three have one
# inactive value; a mask chooses between two in the next three; the last stores every value.
MINUS_BACKGROUND, ONE_VALUE, MASKED, MASKED_ONE, MASKED_TWO, ALL = 1, 2, 3, 4, 5, 6
EDGES = (4096, 128)  # voxels along a child of the root, and along a child of that
LEAF = 8
PIECE = 1 << 20  # bytes read at a time
ONES = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(1)  # bits of a byte


class Cursor:
    """The bytes of a file, one after the other."""

    def __init__(self, file: InputFile, place: int = 0) -> None:
        self.file, self.place = file, place
        self._start, self._held = 0, b""

    def take(self, count: int) -> bytes:
        """Return the next bytes."""
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
        """Pass over bytes."""
        self.take(0)
        self.place += count

    def unpack(self, layout: str) -> tuple[Any, ...]:
        """Return the next numbers, little-endian, of a layout of ``struct``."""
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def number(self, layout: str) -> Any:
        """Return the next number."""
        return self.unpack(layout)[0]

    def text(self) -> str:
        """Return the next string, which follows its length."""
        return self.take(self.number("I")).decode("utf-8", "replace")

    def array(self, dtype: Any, count: int) -> NDArray[Any]:
        """Return the next array."""
        return np.frombuffer(self.take(np.dtype(dtype).itemsize * count), dtype)


@dataclass(frozen=True)
class Coding:
    """How the values of a tree are stored: their type, its packing, and the background."""

    dtype: np.dtype[Any]
    stored: np.dtype[Any]
    flags: int
    background: float

    def read(self, cursor: Cursor, active: BoolArray) -> NDArray[Any]:
        """Return the next values, one for each bit of a mask, inactive ones as they are meant."""
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

    def skip(self, cursor: Cursor, active: int) -> int:
        """Skip the values of a leaf of ``active`` active voxels; return how others are stored."""
        _, _, state = self._inactive(cursor, LEAF**3)
        partly = state != ALL and self.flags & ACTIVE_MASK
        cursor.skip(self._length(cursor, active if partly else LEAF**3)[0])
        return state

    def _inactive(self, cursor: Cursor, count: int) -> tuple[list[float], BoolArray | None, int]:
        """Return the inactive values, which voxels have the second one, and how they are stored."""
        state = cursor.number("B")
        if state > ALL:
            raise FileError(f"{cursor.file.name} is damaged: a node's values are of kind {state}")
        values = [-self.background if state else self.background, self.background]
        stated = {ONE_VALUE: 1, MASKED_ONE: 1, MASKED_TWO: 2}.get(state, 0)
        values[:stated] = cursor.array(self.dtype, stated).tolist()
        masked = state in (MASKED, MASKED_ONE, MASKED_TWO)
        return values, bits(cursor.array("u1", count // 8)) if masked else None, state

    def _length(self, cursor: Cursor, count: int) -> tuple[int, bool]:
        """Return how many bytes the next numbers take, and whether they are packed."""
        if not self.flags & (ZIP | BLOSC) or (not count and self.stored != self.dtype):
            return count * self.stored.itemsize, False
        length = cursor.number("q")
        return abs(length), length > 0

    def _numbers(self, cursor: Cursor, count: int) -> NDArray[Any]:
        length, packed = self._length(cursor, count)
        data, size = cursor.take(length), count * self.stored.itemsize
        if packed:
            data = _unpacked(data, size, self.flags & BLOSC)
        if len(data) != size:
            raise FileError(f"{cursor.file.name} is damaged: a node's values cannot be unpacked")
        return np.frombuffer(data, self.stored).astype(self.dtype)


def bits(mask: NDArray[np.uint8]) -> BoolArray:
    """Return the bits of a mask, the lowest of each byte first."""
    return np.unpackbits(mask, bitorder="little").astype(bool)


def _unpacked(data: bytes, size: int, is_blosc: int) -> bytes:
    """Return the bytes of a zlib stream or Blosc buffer; none if it is damaged."""
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


class Tree:
    """Where the T tiles and L leaves of a grid are, which are read from a byte of a file on.

    Tiles are kept that are active or have another value than the background. ``places`` are where
    the values of each leaf begin; a leaf that is ``whole`` may have inactive voxels of other values
    than the background. ``coding`` makes the coding of a background.
    """

    def __init__(self, file: InputFile, place: int, coding: Callable[[float], Coding]) -> None:
        self.file, cursor = file, Cursor(file, place)
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

    def _parts(self, cursor: Cursor) -> Iterator[Tiles | Leaves]:
        tiles, children = cursor.unpack("II")
        for _ in range(tiles):
            corner = cursor.array("<i4", 3).astype(np.int64)[None]
            value = cursor.array(self.coding.dtype, 1)
            yield self._tiles(corner, EDGES[0], value, bits(cursor.array("u1", 1))[:1])
        for _ in range(children):
            yield from self._node(cursor, cursor.array("<i4", 3).astype(np.int64), EDGES)

    def _node(
        self, cursor: Cursor, corner: Ints, edges: tuple[int, ...]
    ) -> Iterator[Tiles | Leaves]:
        """Yield what is in a node whose children have the second edge, or are leaves."""
        edge = edges[1] if len(edges) > 1 else LEAF
        count = edges[0] // edge
        child, active = (bits(cursor.array("u1", count**3 // 8)) for _ in range(2))
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

    @property
    def active_count(self) -> int:
        """Number of active voxels, those of tiles included."""
        return int(ONES[self.masks].sum()) + int((self.edges[self.active] ** 3).sum())

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
        """Return whether any tile, or any value of a leaf, is negative."""
        cursor, leaves = Cursor(self.file), range(len(self.leaves))
        negative = any((self._values_of(cursor, leaf)[0] < 0).any() for leaf in leaves)
        return negative or bool((self.values < 0).any())

    def read(self, first: Ints, shape: tuple[int, ...], *, unknown: bool = False) -> NDArray[Any]:
        """Return a box of voxels from ``first`` on; inactive background may be unknown, NaN."""
        background = np.nan if unknown else self.coding.background
        box = np.full(shape, background, self.coding.dtype)
        for tile in np.flatnonzero(_touch(self.corners, self.edges[:, None], first, shape)):
            edges = (int(self.edges[tile]),) * 3
            _put(box, np.broadcast_to(self.values[tile], edges), self.corners[tile] - first)
        cursor = Cursor(self.file)
        for leaf in np.flatnonzero(_touch(self.leaves, LEAF, first, shape)).tolist():
            values, active = self._values_of(cursor, leaf)
            if unknown:
                values[~active & (values == self.coding.background)] = np.nan
            _put(box, values.reshape(LEAF, LEAF, LEAF), self.leaves[leaf] - first)
        return box

    def _values_of(self, cursor: Cursor, leaf: int) -> tuple[NDArray[Any], BoolArray]:
        """Return the values of a leaf, and which are active, both (512,)."""
        cursor.place = int(self.places[leaf])
        active = bits(self.masks[leaf])
        return self.coding.read(cursor, active), active


def _touch(corners: Ints, edges: Any, first: Ints, shape: tuple[int, ...]) -> BoolArray:
    overlap = (corners < first + np.array(shape)) & (corners + edges > first)
    return np.asarray(overlap.all(1))


def _put(box: NDArray[Any], values: NDArray[Any], start: Ints) -> None:
    """Copy what lies within the box of an array that starts at ``start`` there."""
    low = np.maximum(start, 0)
    high = np.minimum(start + values.shape, box.shape)
    there = tuple(slice(a, b) for a, b in zip(low, high))
    box[there] = values[tuple(slice(a, b) for a, b in zip(low - start, high - start))]
