"""OpenVDB: level sets and densities in, refined fields out as level sets.

Voxel (i, j, k) is the sample at the grid's transform of (i, j, k); of a field it is node (i, j, k)
of the fine lattice. A file has of each grid flags of its compression, metadata, the transform and
the tree, as OpenVDB's source describes them (versions 222 and later). The root of a tree maps
corners to nodes of 4096^3 voxels, those hold nodes of 128^3, and those leaves of 8^3. Where a node
has no child it has a tile: one value for the whole cube. The file has the topology first, then the
values of the leaves, packed one by one.

In a file that is written here, the voxels nearer to the surface than three spacings are active. All
others have the background, which is those three spacings, or minus the background inside. A level
set is closed: a solid that leaves the lattice is cut off at its border, so no node is deeper inside
than the border is away, and voxels beyond are outside. Nothing is packed: zlib would take long and
save about a fifth. OpenVDB 5 and later read the file.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NoReturn
from uuid import NAMESPACE_OID, uuid5

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray, FloatArray
from ...errors import FileError, GridError, NoSurfaceError, OptionError
from ...grid.sdf_grid import SdfGrid
from ...refine.field import FineField, FineLattice, fine_grid
from . import DISTANCE, Request, Volume, from_affine

Ints = NDArray[np.int64]
Sides = NDArray[np.uint8]  # what each cube of voxels is: one of the three

MAGIC = 0x56444220
OLDEST = 222  # version of the file format that is read, of OpenVDB 3
VERSION, LIBRARY = 224, (5, 0)  # that is written, and the first library with it
ZIP, ACTIVE_MASK, BLOSC = 1, 2, 4  # flags of a grid's compression
# How the inactive values of a node are stored: 0 to 2 have one; in 3 to 5 a mask chooses between
# two (in 3 the background, where it is set, and minus that); the last stores every value.
ONE_VALUE, MASKED, MASKED_ONE, MASKED_TWO, ALL = 2, 3, 4, 5, 6
STATED = {ONE_VALUE: 1, MASKED_ONE: 1, MASKED_TWO: 2}  # inactive values in a node
EDGES = (4096, 128, 8)  # voxels along a node below the root, along one below that, and a leaf
LEAF = EDGES[2]
WIDTHS = EDGES[0] // EDGES[1], EDGES[1] // LEAF  # children along an edge of the two inner nodes
F4, F8 = np.dtype("<f4"), np.dtype("<f8")
TYPES: dict[str, np.dtype[Any]] = {"Tree_float_5_4_3": F4, "Tree_double_5_4_3": F8}
MASK_BYTES = LEAF**3 // 8
HALF = "_HalfFloat"  # ends the type of a grid whose values are stored in 16 bits
NUMBERS = {"float": "f", "double": "d", "int32": "i", "int64": "q", "bool": "?"}  # of metadata
# How many vectors a map has, and which are the translation and the scale.
MAPS = {"TranslationMap": (1, 0, None), "ScaleMap": (5, None, 0), "ScaleTranslateMap": (6, 0, 1)}
PICOGK_MM = 1000  # PicoGK states the size of a voxel in metres, and works in millimetres
MARGIN = 2  # voxels of background around the others, so that the border is outside
OUTSIDE, INSIDE, MIXED = 0, 1, 2  # a cube of voxels: all background, all minus that, or neither
HALF_WIDTH = 3  # voxels of the narrow band to either side of the surface; OpenVDB's tools want 3
SIZES = 2e-5, 1e30  # of a voxel: OpenVDB refuses transforms with a determinant below 3e-15


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
    flags, metadata, affine = cursor.head()
    if parent:  # whose tree it shares
        cursor = start.at(entries[parent][2])
        flags, *_ = cursor.head()
    tree = _Tree(cursor, kind, flags)
    stated = metadata.get("file_voxel_count", tree.active_count)
    if stated != tree.active_count:
        cursor.fail(f"it has {tree.active_count:,} active voxels and states {stated:,}")
    if not tree.ends:
        raise GridError(f"{request.path} has no active voxel: it holds no surface")
    lows, highs = zip(*tree.ends)
    unknown = not tree.background and any(np.min(values) < 0 for _, _, values, _ in tree.cubes)
    margin = 0 if unknown else MARGIN
    low, high = np.min(lows, 0) - margin, np.max(highs, 0) + margin
    size = PICOGK_MM * float(metadata.get("PicoGK.VoxelSize", 1 / PICOGK_MM))
    shape, notes, about = tuple((high - low).tolist()), tuple[str, ...](), dict[str, Any]()
    if "PicoGK.VoxelSize" in metadata:
        notes = (f"voxels of {size:.6g} mm, as PicoGK states: the mesh is in millimetres",)
    if request.describes:
        about["grids"] = [start.described(each, k, at) for each, (k, _, at) in entries.items()]
        other = f"shape and place are those of {name!r}: give {start.name}:NAME for another"
        notes += (f"{other} grid",) * (len(entries) > 1)

    def load(index: Any) -> NDArray[Any]:
        voxels = tree.voxels(low, shape, unknown=unknown)
        return voxels if size == 1 else voxels * voxels.dtype.type(size)

    matrix = size * np.column_stack([affine[:, :3], affine[:, :3] @ low + affine[:, 3]])
    hint = DISTANCE if metadata.get("class") == "level set" else ""
    said: dict[str, Any] = {"notes": notes, "about": about, "hint": hint, **from_affine(matrix)}
    return Volume(load, shape, tree.dtype, **said)


def _entries(cursor: _Cursor) -> dict[str, tuple[str, str, int]]:
    """Return type, name of the grid whose tree it shares, and place of each grid by its name."""
    if len(cursor.data) < 12 or cursor.number("q") != MAGIC:
        raise FileError(f"{cursor.name} is no .vdb file: its first bytes are not OpenVDB's")
    if (version := cursor.number("I")) < OLDEST:
        said = f"{cursor.name} has version {version} of the format: save it with OpenVDB 3 or later"
        raise FileError(f"{said}, whose files have {OLDEST} at least")
    *_, seekable = cursor.unpack("II?36s")  # the library's version, and the file's own number
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

    def fail(self, said: str, how: str = "damaged") -> NoReturn:
        raise FileError(f"{self.name} is {how}: {said}")

    def take(self, count: int) -> bytes:
        if not 0 <= count <= len(self.data) - self.place:
            said = f"{count:,} bytes are to follow byte {self.place:,} of {len(self.data):,}"
            self.fail(said, "truncated or damaged")
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

    def described(self, name: str, kind: str, place: int) -> dict[str, Any]:
        metadata, value = self.at(place + 4).metadata(), kind.removeprefix("Tree_").split("_")[0]
        about = {"name": name, "type": value, "class": metadata.get("class", "unknown")}
        return {**about, "active_voxels": metadata.get("file_voxel_count")}

    def head(self) -> tuple[int, dict[str, Any], NDArray[np.float64]]:
        """Return flags, metadata, and the matrix (3, 4) from indices to world coordinates."""
        flags, metadata, kind = self.number("I"), self.metadata(), self.text()
        if kind in ("AffineMap", "UnitaryMap"):  # OpenVDB multiplies rows by it
            return flags, metadata, self.array("<f8", 16).reshape(4, 4).T[:3]
        if kind.removeprefix("Uniform") not in MAPS:
            said = f"{self.name} has a transform that is not affine, {kind}"
            raise GridError(f"{said}: resample the grid to a linear transform")
        count, translation, scale = MAPS[kind.removeprefix("Uniform")]
        vectors = self.array("<f8", 3 * count).reshape(count, 3)
        moved = np.zeros(3) if translation is None else vectors[translation]
        scales = np.diag(np.ones(3) if scale is None else vectors[scale])
        return flags, metadata, np.column_stack([scales, moved])


class _Tree:
    """The cubes of voxels of a grid: corner, edge, values (a tile has one), and which are active.

    Tiles of inactive background are left out. ``ends`` are the first voxel, and the one after the
    last, of each cube that is no inactive background.
    """

    def __init__(self, cursor: _Cursor, kind: str, flags: int) -> None:
        self.cursor, self.flags = cursor, flags
        self.dtype = TYPES[kind.removesuffix(HALF)]
        self.stored = np.dtype("<f2") if kind.endswith(HALF) else self.dtype
        if cursor.number("I") != 1:
            cursor.fail("its tree has not one buffer")
        self.background = float(cursor.array(self.dtype, 1)[0])
        self.cubes: list[tuple[Ints, int, Any, Any]] = []
        leaves: list[Ints] = []
        tiles, children = cursor.unpack("II")
        row = np.dtype([("corner", "<i4", 3), ("value", self.dtype), ("active", "u1")])
        rows = cursor.array(row, tiles)
        corners = rows["corner"].astype(np.int64)
        self._add_tiles(corners, EDGES[0], rows["value"], rows["active"] & 1 > 0)
        for _ in range(children):
            self._add_node(cursor.array("<i4", 3).astype(np.int64), 0, leaves)
        self.ends = [(corner, corner + edge) for corner, edge, *_ in self.cubes]
        self.active_count = sum(edge**3 for _, edge, _, active in self.cubes if active)
        cube = (LEAF,) * 3
        for corner in leaves:  # after the topology, each after its mask
            active = cursor.bits(LEAF**3)
            values = self._values(active)
            self.active_count += int(active.sum())
            self.cubes.append((corner, LEAF, values.reshape(cube), active.reshape(cube)))
            shown = np.argwhere((active | (values != self.background)).reshape(cube))
            if len(shown):
                self.ends.append((corner + shown.min(0), corner + shown.max(0) + 1))

    def _add_tiles(self, corners: Ints, edge: int, values: Any, active: BoolArray) -> None:
        """Take those tiles that are no inactive background."""
        for n in np.flatnonzero(active | (values != self.background)):
            self.cubes.append((corners[n], edge, values[n], active[n]))

    def _add_node(self, corner: Ints, depth: int, leaves: list[Ints]) -> None:
        """Take the tiles of a node, and its children, which are nodes or leaves."""
        edge, count = EDGES[depth + 1], WIDTHS[depth]
        child, active = self.cursor.bits(count**3), self.cursor.bits(count**3)
        values = self._values(active)
        corners = corner + edge * np.argwhere(np.ones((count,) * 3, bool))
        self._add_tiles(corners[~child], edge, values[~child], active[~child])
        for place in corners[child]:
            if edge > LEAF:
                self._add_node(place, depth + 1, leaves)
            else:
                self.cursor.take(MASK_BYTES)  # there again before the leaf's values
                leaves.append(place)

    def _values(self, active: BoolArray) -> NDArray[Any]:
        """Return the next values of a node."""
        cursor, count = self.cursor, len(active)
        if (state := cursor.number("B")) > ALL:
            cursor.fail(f"a node's values are of kind {state}")
        values = [-self.background if state else self.background, self.background]
        stated = STATED.get(state, 0)
        values[:stated] = cursor.array(self.dtype, stated).tolist()
        masked = state in (MASKED, MASKED_ONE, MASKED_TWO)
        selection = cursor.bits(count) if masked else np.zeros(count, bool)
        if state == ALL or not self.flags & ACTIVE_MASK:
            return self._numbers(count)
        filled = np.where(selection, *np.array(values[::-1], self.dtype))
        filled[active] = self._numbers(int(active.sum()))
        return filled

    def _numbers(self, count: int) -> NDArray[Any]:
        """Return the next numbers, which are a zlib stream, a Blosc buffer, or as they are."""
        size, is_blosc = count * self.stored.itemsize, self.flags & BLOSC
        packed = (self.flags & ZIP or is_blosc) and (count or self.stored == self.dtype)
        length = self.cursor.number("q") if packed else -size
        data = self.cursor.take(abs(length))
        if length > 0 and not is_blosc:
            data = zlib.decompressobj().decompress(data, size + 1)
        # the header of Blosc: four bytes, then the sizes unpacked, of a block, and packed
        elif length >= 16 and struct.unpack_from("<I4xI", data, 4) == (size, length):
            from numcodecs import blosc

            data = bytes(blosc.decompress(data)) if size else b""
        if len(data) != size:
            self.cursor.fail("a node's values cannot be unpacked")
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


@dataclass(frozen=True, eq=False)
class LevelSet:
    """What is written."""

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
    """Yield eight planes of voxels after the other, (8, y, z), from voxel (-8, -8, -8) on."""
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
        floor = np.maximum(least[0][x[0] : x[-1] + 1, None, None], least_across)
        planes = np.maximum(lattice[int(x[0]) : int(x[-1]) + 1], floor)
        values = np.pad(planes[x - x[0]], [(0, 0), *pads[1:]], mode="edge")
        away = np.hypot(beyond[0][first + LEAF : first + 2 * LEAF, None, None], beyond_across)
        np.hypot(values, away.astype(np.float32), out=values, where=away > 0)
        yield values  # beyond the lattice: distances from a surface that its border is nearest to


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
    steps, origin = np.array(tree.grid.spacing), np.array(tree.grid.origin)
    name = "ScaleTranslateMap" if np.ptp(steps) else "UniformScaleTranslateMap"
    matrix = np.array([origin, steps, steps, 1 / steps, 1 / steps**2, 0.5 / steps])
    if not tree.grid.is_straight:
        name, matrix = "AffineMap", np.eye(4)
        matrix[:3, :3], matrix[3, :3] = (np.array(tree.grid.direction) * steps).T, origin
    file.write(_text(name) + matrix.astype("<f8").tobytes())
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
            file.write(_node(node) + b"".join(tree.leaves[leaf][:MASK_BYTES] for leaf in held))
            order += held
    return order


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
    """Return cubes in whole nodes of ``width``^3, from that before node 0 on; and the nodes."""
    before = width - 1
    padded = np.pad(sides, [(before, -(before + count) % width) for count in sides.shape])
    x, y, z = (count // width for count in padded.shape)
    cubes = padded.reshape(x, width, y, width, z, width)
    low, high = cubes.min((1, 3, 5)), cubes.max((1, 3, 5))
    return padded, np.where(low == high, low, np.uint8(MIXED))


def _part(cubes: NDArray[Any], place: Ints, width: int) -> NDArray[Any]:
    """Return the cubes of a node of ``width``^3."""
    x, y, z = (slice(width * at, width * (at + 1)) for at in place.tolist())
    return cubes[x, y, z]
