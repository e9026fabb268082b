"""OpenVDB level sets and densities: every voxel of the box round those that are not background.

Voxel (i, j, k) is the sample at the grid's transform of (i, j, k). A file has of each grid flags of
its compression, metadata, the transform and the tree, as OpenVDB's source describes them (versions
222 and later). The root of a tree maps corners to nodes of 4096^3 voxels, those hold nodes of
128^3, and those leaves of 8^3. Where a node has no child it has a tile: one value for the whole
cube. The file has the topology first, then the values of the leaves, packed one by one.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray
from ...errors import FileError, GridError
from .. import vdb_writer as vdb
from . import DISTANCE, Request, Volume, from_affine

Ints = NDArray[np.int64]

OLDEST = 222  # version of the file format, of OpenVDB 3
MARGIN = 2  # voxels of background around the others, so that the border is outside
TYPES: dict[str, np.dtype[Any]] = {
    "Tree_float_5_4_3": np.dtype("<f4"),
    "Tree_double_5_4_3": np.dtype("<f8"),
}
HALF = "_HalfFloat"  # ends the type of a grid whose values are stored in 16 bits
NUMBERS = {"float": "f", "double": "d", "int32": "i", "int64": "q", "bool": "?"}  # of metadata
# How many vectors a map has, and which are the translation and the scale.
MAPS = {"TranslationMap": (1, 0, None), "ScaleMap": (5, None, 0), "ScaleTranslateMap": (6, 0, 1)}
PICOGK_MM = 1000  # PicoGK states the size of a voxel in metres, and works in millimetres
STATED = {vdb.ONE_VALUE: 1, vdb.MASKED_ONE: 1, vdb.MASKED_TWO: 2}  # inactive values in a node


def read_vdb(request: Request) -> Volume:
    """Read a grid of floating-point values of a ``.vdb`` file.

    Every voxel has the value that OpenVDB gives it, inactive ones too. A background of 0 is no
    distance: where values are signed, voxels that have it and are not active are unknown.
    """
    start = _Cursor(str(request.path), request.path.read_bytes())
    entries = _entries(start)
    usable = [name for name, (kind, _, _) in entries.items() if kind.removesuffix(HALF) in TYPES]
    names = usable[: 1 if request.describes and request.member is None else None]
    name = request.choose(names, "grid of floating-point values")
    kind, parent, place = entries[name]
    cursor = start.at(place)
    flags, metadata, affine = cursor.number("I"), cursor.metadata(), cursor.transform()
    if parent:  # whose tree it shares
        cursor = start.at(entries[parent][2])
        flags, _, _ = cursor.number("I"), cursor.metadata(), cursor.transform()
    tree = _Tree(cursor, kind, flags)
    stated = metadata.get("file_voxel_count", tree.active_count)
    if stated != tree.active_count:
        has = f"it has {tree.active_count:,} active voxels and states {stated:,}"
        raise FileError(f"{request.path} is damaged: {has}")
    if not tree.ends:
        raise GridError(f"{request.path} has no active voxel: it holds no surface")
    lows, highs = zip(*tree.ends)
    unknown = not tree.background and any(np.min(values) < 0 for _, _, values, _ in tree.cubes)
    margin = 0 if unknown else MARGIN
    low, high = np.min(lows, 0) - margin, np.max(highs, 0) + margin
    size = PICOGK_MM * float(metadata.get("PicoGK.VoxelSize", 1 / PICOGK_MM))
    shape, notes, about = tuple((high - low).tolist()), tuple[str, ...](), dict[str, Any]()

    def load(index: Any) -> NDArray[Any]:
        voxels = tree.voxels(low, shape, unknown=unknown)
        return voxels if size == 1 else voxels * voxels.dtype.type(size)

    matrix = size * np.column_stack([affine[:, :3], affine[:, :3] @ low + affine[:, 3]])
    if "PicoGK.VoxelSize" in metadata:
        notes = (f"voxels of {size:.6g} mm, as PicoGK states: the mesh is in millimetres",)
    if request.describes:
        about["grids"] = [start.described(*each) for each in entries.items()]
        other = f"shape and place are those of {name!r}: give {start.name}:NAME for another"
        notes += (f"{other} grid",) * (len(entries) > 1)
    hint = DISTANCE if metadata.get("class") == "level set" else ""
    said: dict[str, Any] = {"notes": notes, "about": about, "hint": hint, **from_affine(matrix)}
    return Volume(load, shape, tree.dtype, **said)


def _entries(cursor: _Cursor) -> dict[str, tuple[str, str, int]]:
    """Return type, name of the grid whose tree it shares, and place of each grid by its name."""
    if len(cursor.data) < 12 or cursor.number("q") != vdb.MAGIC:
        raise FileError(f"{cursor.name} is no .vdb file: its first bytes are not OpenVDB's")
    if (version := cursor.number("I")) < OLDEST:
        said = f"{cursor.name} has version {version} of the format: save it with OpenVDB 3 or later"
        raise FileError(f"{said}, whose files have {OLDEST} at least")
    cursor.take(8)  # the library's version
    seekable = cursor.number("?")
    cursor.take(36)  # the file's own number
    cursor.metadata()
    count, entries = cursor.number("I"), {}
    if not seekable and count > 1:
        said = f"{cursor.name} holds {count} grids one after the other, as a stream"
        raise FileError(f"{said}: save it with openvdb.write")
    for _ in range(count):
        name, kind, parent = (cursor.text().replace("\x1e", "#") for _ in range(3))
        _, _, end = cursor.unpack("qqq")
        entries[name] = kind, parent, cursor.place
        if count > 1:
            cursor.place = end
    return entries


class _Cursor:
    """The bytes of a file, one after the other."""

    def __init__(self, name: str, data: bytes, place: int = 0) -> None:
        self.name, self.data, self.place = name, data, place

    def at(self, place: int) -> _Cursor:
        return _Cursor(self.name, self.data, place)

    def take(self, count: int) -> bytes:
        if not 0 <= count <= len(self.data) - self.place:
            said = f"{count:,} bytes are to follow byte {self.place:,} of {len(self.data):,}"
            raise FileError(f"{self.name} is truncated or damaged: {said}")
        self.place += count
        return self.data[self.place - count : self.place]

    def unpack(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def number(self, layout: str) -> Any:
        return self.unpack(layout)[0]

    def text(self) -> str:
        return self.take(self.number("I")).decode("utf-8", "replace")

    def array(self, dtype: Any, count: int) -> NDArray[Any]:
        return np.frombuffer(self.take(np.dtype(dtype).itemsize * count), dtype)

    def bits(self, count: int) -> BoolArray:
        return np.unpackbits(self.array("u1", count // 8), bitorder="little").astype(bool)

    def metadata(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for _ in range(self.number("I")):
            name, kind, data = self.text(), self.text(), self.take(self.number("I"))
            if kind == "string":
                found[name] = data.decode("utf-8", "replace")
            elif kind in NUMBERS:
                found[name] = struct.unpack("<" + NUMBERS[kind], data)[0]
        return found

    def described(self, name: str, entry: tuple[str, str, int]) -> dict[str, Any]:
        metadata = self.at(entry[2] + 4).metadata()
        kind = entry[0].removeprefix("Tree_").split("_")[0]
        about = {"name": name, "type": kind, "class": metadata.get("class", "unknown")}
        return {**about, "active_voxels": metadata.get("file_voxel_count")}

    def transform(self) -> NDArray[np.float64]:
        """Return the matrix (3, 4) from indices to world coordinates."""
        kind = self.text()
        if kind in ("AffineMap", "UnitaryMap"):
            return self.array("<f8", 16).reshape(4, 4).T[:3]  # OpenVDB multiplies rows by it
        if kind.removeprefix("Uniform") not in MAPS:
            said = f"{self.name} has a transform that is not affine, {kind}"
            raise GridError(f"{said}: resample the grid to a linear transform")
        count, translation, scale = MAPS[kind.removeprefix("Uniform")]
        vectors = self.array("<f8", 3 * count).reshape(count, 3)
        moved = np.zeros(3) if translation is None else vectors[translation]
        return np.column_stack([np.diag(np.ones(3) if scale is None else vectors[scale]), moved])


class _Tree:
    """The cubes of voxels of a grid: corner, edge, values, and which are active.

    A tile has one number for all of them; tiles of inactive background are left out. ``ends`` are
    the first voxel, and the one after the last, of each cube that is no inactive background.
    """

    def __init__(self, cursor: _Cursor, kind: str, flags: int) -> None:
        self.cursor, self.flags = cursor, flags
        self.dtype = TYPES[kind.removesuffix(HALF)]
        self.stored = np.dtype("<f2") if kind.endswith(HALF) else self.dtype
        if cursor.number("I") != 1:
            raise FileError(f"{cursor.name} is damaged: its tree has not one buffer")
        self.background = float(cursor.array(self.dtype, 1)[0])
        self.cubes: list[tuple[Ints, int, Any, Any]] = []
        leaves: list[Ints] = []
        tiles, children = cursor.unpack("II")
        for _ in range(tiles):
            corner = cursor.array("<i4", 3).astype(np.int64)
            value, active = cursor.array(self.dtype, 1)[0], cursor.number("B") & 1
            if active or value != self.background:
                self.cubes.append((corner, vdb.EDGES[0], value, active))
        for _ in range(children):
            self._add_node(cursor.array("<i4", 3).astype(np.int64), vdb.EDGES, leaves)
        self.ends = [(corner, corner + edge) for corner, edge, *_ in self.cubes]
        self.active_count = sum(edge**3 for _, edge, _, active in self.cubes if active)
        cube = (vdb.LEAF,) * 3
        for corner in leaves:  # after the topology, each after its mask
            active = cursor.bits(vdb.LEAF**3)
            values = self._values(active)
            self.active_count += int(active.sum())
            self.cubes.append((corner, vdb.LEAF, values.reshape(cube), active.reshape(cube)))
            shown = np.argwhere((active | (values != self.background)).reshape(cube))
            if len(shown):
                self.ends.append((corner + shown.min(0), corner + shown.max(0) + 1))

    def _add_node(self, corner: Ints, edges: tuple[int, ...], leaves: list[Ints]) -> None:
        """Take a node whose children have the second edge, or are leaves."""
        edge = edges[1] if len(edges) > 1 else vdb.LEAF
        count = edges[0] // edge
        child, active = self.cursor.bits(count**3), self.cursor.bits(count**3)
        values = self._values(active)
        corners = corner + edge * np.argwhere(np.ones((count,) * 3, bool))
        for n in np.flatnonzero(~child & (active | (values != self.background))):
            self.cubes.append((corners[n], edge, values[n], active[n]))
        for place in corners[child]:
            if edge > vdb.LEAF:
                self._add_node(place, edges[1:], leaves)
            else:
                self.cursor.take(vdb.MASK_BYTES)  # there again before the leaf's values
                leaves.append(place)

    def _values(self, active: BoolArray) -> NDArray[Any]:
        """Return the next values of a node."""
        cursor, count = self.cursor, len(active)
        state = cursor.number("B")
        if state > vdb.ALL:
            raise FileError(f"{cursor.name} is damaged: a node's values are of kind {state}")
        values = [-self.background if state else self.background, self.background]
        stated = STATED.get(state, 0)
        values[:stated] = cursor.array(self.dtype, stated).tolist()
        masked = state in (vdb.MASKED, vdb.MASKED_ONE, vdb.MASKED_TWO)
        selection = cursor.bits(count) if masked else np.zeros(count, bool)
        if state == vdb.ALL or not self.flags & vdb.ACTIVE_MASK:
            return self._numbers(count)
        filled = np.where(selection, *np.array(values[::-1], self.dtype))
        filled[active] = self._numbers(int(active.sum()))
        return filled

    def _numbers(self, count: int) -> NDArray[Any]:
        """Return the next numbers, which are a zlib stream, a Blosc buffer, or as they are."""
        size, is_blosc = count * self.stored.itemsize, self.flags & vdb.BLOSC
        packed = (self.flags & vdb.ZIP or is_blosc) and (count or self.stored == self.dtype)
        length = self.cursor.number("q") if packed else -size
        data = self.cursor.take(abs(length))
        if length > 0 and not is_blosc:
            data = zlib.decompressobj().decompress(data, size + 1)
        # the header of Blosc: four bytes, then the sizes unpacked, of a block, and packed
        elif length >= 16 and struct.unpack_from("<I4xI", data, 4) == (size, length):
            from numcodecs import blosc

            data = bytes(blosc.decompress(data)) if size else b""
        if len(data) != size:
            raise FileError(f"{self.cursor.name} is damaged: a node's values cannot be unpacked")
        return np.frombuffer(data, self.stored).astype(self.dtype)

    def voxels(self, first: Ints, shape: tuple[int, ...], *, unknown: bool) -> NDArray[Any]:
        """Return a box of voxels; if ``unknown``, inactive background is NaN."""
        box = np.full(shape, np.nan if unknown else self.background, self.dtype)
        for corner, edge, values, active in self.cubes:
            low, high = np.maximum(corner - first, 0), np.minimum(corner - first + edge, shape)
            if np.ndim(values):
                known = active | (values != self.background) | (not unknown)
                values = np.where(known, values, np.nan)
                values = values[tuple(map(slice, low - corner + first, high - corner + first))]
            box[tuple(map(slice, low, high))] = values
        return box
