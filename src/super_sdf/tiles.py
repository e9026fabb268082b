"""A grid that is too large for the memory, or for one machine, as tiles: cut, and joined again.

A tile is a box of samples with a margin as wide as all that a vertex depends on, refined as a grid
of its own. Without their margins the tiles part the grid. A vertex belongs to the tile that has the
node of its key (see ``surface.extract``), a triangle to that of its smallest key; the position of a
vertex is that of its owner.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .errors import MeshError, OptionError, OutOfMemoryError
from .refine import bounds, prediction, spheres
from .refine.band import BandSummary
from .refine.prediction import AT_ONCE
from .surface.extract import KEYS_PER_NODE, reach_in_voxels
from .surface.mesh import Mesh
from .threads import check_count, held_memory, in_words, memory_bound

if TYPE_CHECKING:
    from .grid.sdf_grid import SdfGrid
    from .options import MesherName

Index = tuple[int, int, int]
Box = tuple[Index, Index]
"""From the lowest index to before the highest."""
FIXED = 50_000_000  # bytes of chunks, and what the network takes in any case
LEAST_SIDE = 8  # samples of a tile without its margin: smaller ones are nearly all margin
ON_BORDER = 1e-2  # voxels: open edges so near to the border of the grid end there


@dataclass(frozen=True)
class Tile:
    """A box of samples, from the lowest index to before the highest, with and without margin."""

    low: Index
    high: Index
    inner_low: Index
    inner_high: Index

    def __str__(self) -> str:
        box = zip(self.inner_low, self.inner_high)
        return "samples " + ", ".join(f"{low} to {high - 1}" for low, high in box)

    def owns(self, voxel_ijk: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Return which voxels (n, 3) belong to the tile, (n,)."""
        inside = (voxel_ijk >= self.inner_low) & (voxel_ijk < self.inner_high)
        return np.asarray(inside.all(1))


@dataclass(frozen=True, eq=False)
class Part:
    """The mesh of a tile: vertices that it owns, and others that its triangles use."""

    tile: Tile
    mesh: Mesh
    keys: NDArray[np.int64]  # (n,), of its vertices
    mine: NDArray[np.bool_]  # (n,), which of these it owns
    worker: str = ""  # the process that made it, if that was another one

    @classmethod
    def without_surface(cls, tile: Tile) -> Part:
        """Return the part of a tile in which no surface is."""
        mesh = Mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
        return cls(tile, mesh, np.empty(0, np.int64), np.empty(0, bool))

    def __str__(self) -> str:
        return str(self.tile) + f" ({self.worker})" * bool(self.worker)


@dataclass(frozen=True)
class Room:
    """How many voxels of the band fit in the memory that may be taken; all figures are measured."""

    bound: float  # bytes that the process may hold
    held: int  # bytes that it holds
    factor: int
    network: tuple[float, float]  # bytes of the network per voxel that it sees, and per value

    @classmethod
    def of(cls, max_memory: int | None, factor: int, network: tuple[float, float]) -> Room:
        """Return the room of this process."""
        return cls(memory_bound(max_memory) or np.inf, held_memory() or 0, factor, network)

    def voxels(self, meshes: float = 0.0) -> float:
        """Return how many voxels can be refined at once, beside ``meshes`` bytes.

        The network sees ``AT_ONCE`` of a large band at a time, and a fifth more beside them. Three
        quarters of the voxels of a band are decoded.
        """
        left, values = self.bound - self.held - FIXED - meshes, (self.factor + 1) ** 3
        run = 250 + self.network[0] + 0.75 * self.network[1] * values
        small, large = left / (250 + run), (left - 1.2 * AT_ONCE * run) / (250 + 3 * values)
        if large < AT_ONCE:
            large = min(small, AT_ONCE)
        fitted, meshed = 900 + 4 * values, 350 + 3 * values + 54 * self.factor**2
        return min(large, left / fitted, left / meshed)

    def beside(self, whole: BandSummary) -> float:
        """Return the voxels that a tile may have beside the meshes of the others."""
        mesh = self.factor**2 * whole.count  # bytes: 21 of its parts, 42 joined
        return self.voxels(21 * mesh) if self.bound - self.held > 42 * mesh else -1.0

    def refusal(self, whole: BandSummary) -> OutOfMemoryError:
        """Return the error for a grid of which not even the smallest tiles fit."""
        count = whole.count
        return OutOfMemoryError(
            f"factor {self.factor} on {count:,} voxels near the surface does not fit in the "
            f"{in_words(self.bound)} of memory that may be used, not even in small tiles: use a "
            "smaller factor, or allow more (--max-memory)"
        )


def margin_of(grid: SdfGrid, receptive_field: int | None, mesher: MesherName, factor: int) -> int:
    """Return how many samples to every side a tile's vertices and triangles depend on."""
    if receptive_field is None:
        raise OptionError(
            "the network states no receptive field, so it has to see the whole grid at once, and "
            "that does not fit: allow more memory (--max-memory), or use another network"
        )
    seen = max(receptive_field, bounds.REACH_OF_SAMPLES)
    if grid.field.network is None:
        seen = max(seen, prediction.BEYOND)
    fitted = spheres.REACH_IN_VOXELS + bounds.REACH_IN_VOXELS
    return seen + fitted + reach_in_voxels(mesher, factor) + 1


def plan(
    shape: Index, summary: BandSummary, margin: int, room: Room | None = None, least: int = 1
) -> list[Tile]:
    """Cut a grid into tiles that each fit in the memory, ``least`` or more of them.

    The largest is cut first, along its longest axis, with as many voxels on either side. Boxes
    without voxels are left out. OutOfMemoryError if the smallest tiles do not fit.
    """
    cells, side, most = summary.cells, summary.side, room.beside(summary) if room else np.inf
    before = np.zeros([n + 1 for n in cells.shape], np.int64)  # voxels in all cells before
    before[1:, 1:, 1:] = cells.cumsum(0).cumsum(1).cumsum(2)

    def seen(box: Box) -> int:
        """Return the voxels in a box of cells and in its margin."""
        low = [max(n * side - margin, 0) // side for n in box[0]]
        high = [min(-(-(n * side + margin) // side), m) for n, m in zip(box[1], cells.shape)]
        part = before[np.ix_(*zip(low, high))]
        return int(np.diff(np.diff(np.diff(part, axis=0), axis=1), axis=2).sum())

    whole: Box = ((0, 0, 0), as_index(cells.shape))
    boxes, done = [(seen(whole), whole)], list[Box]()  # from the smallest to the largest
    while boxes:
        needed, box = boxes.pop()
        if needed <= most and len(boxes) + len(done) + 1 >= least:
            done += [box, *(other for _, other in boxes)]
            break
        if halves := _halves(box, cells, -(-LEAST_SIDE // side)):
            for half in halves:
                insort(boxes, (seen(half), half))
        elif room is None or needed <= most:
            done.append(box)
        else:
            raise room.refusal(summary)
    tiles = []
    for low, high in sorted(done):
        inner_low, inner_high = np.array(low) * side, np.minimum(np.array(high) * side, shape)
        around, beyond = np.maximum(inner_low - margin, 0), np.minimum(inner_high + margin, shape)
        tiles.append(Tile(*map(as_index, (around, beyond, inner_low, inner_high))))
    return tiles


def _halves(box: Box, cells: NDArray[np.int64], least: int) -> list[Box]:
    """Return the halves of a box of cells that have voxels; none if it is too small to be cut."""
    low, high = box
    part = cells[tuple(map(slice, low, high))]
    axis = int(np.argmax(part.shape))
    if part.shape[axis] < 2 * least:
        return []
    count = np.moveaxis(part, axis, 0).sum((1, 2)).cumsum()
    at = int(np.searchsorted(count, count[-1] / 2)) + 1
    at = low[axis] + min(max(at, least), part.shape[axis] - least)
    middle, start = list(high), list(low)
    middle[axis] = start[axis] = at
    halves = (low, as_index(middle)), (as_index(start), high)
    return [half for half in halves if cells[tuple(map(slice, *half))].any()]


def as_index(numbers: Iterable[Any]) -> Index:
    """Return one whole number per axis."""
    i, j, k = map(int, numbers)
    return i, j, k


def voxels_of(keys: NDArray[np.int64], shape: Index, factor: int) -> NDArray[np.int64]:
    """Return the voxels (n, 3) in which the nodes of keys lie: in the upper one of two."""
    lattice = tuple(factor * (n + 2) + 1 for n in shape)
    node_ijk = np.stack(np.unravel_index(keys // KEYS_PER_NODE, lattice), 1)
    return np.clip(node_ijk // factor - 1, 0, np.array(shape) - 1)


def own_part(mesh: Mesh, keys: NDArray[np.int64], tile: Tile, shape: Index, factor: int) -> Part:
    """Return what belongs to a tile of the mesh that it makes, which has the margin, too."""
    if tile.inner_low == (0, 0, 0) and tile.inner_high == shape:
        return Part(tile, mesh, keys, np.ones(len(keys), bool))
    mine = tile.owns(voxels_of(keys, shape, factor))
    of_corner = keys[mesh.faces]
    first = np.take_along_axis(mesh.faces, of_corner.argmin(1)[:, None], 1)[:, 0]
    faces = mesh.faces[mine[first]]
    used = mine.copy()
    used[faces] = True
    number = np.cumsum(used, dtype=np.int32) - np.int32(1)
    part = Mesh(mesh.vertices[used], number[faces])
    return Part(tile, part, keys[used], mine[used])


def join(parts: list[Part]) -> tuple[Mesh, list[tuple[str, int]]]:
    """Return the mesh of all tiles, and their names with how many vertices each has; frees parts.

    Vertices come tile by tile, and so do triangles. MeshError if two tiles do not meet.
    """
    names = [(str(part), int(np.count_nonzero(part.mine))) for part in parts]
    if len(parts) == 1:
        return parts[0].mesh, names
    starts = np.cumsum([0, *(count for _, count in names)])
    check_count(int(starts[-1]), "vertices")
    foreign = np.unique(np.concatenate([part.keys[~part.mine] for part in parts]))
    place = np.full(len(foreign), -1, np.int32)  # of vertices that other tiles use
    for part, start in zip(parts if len(foreign) else (), starts.tolist()):
        keys = part.keys[part.mine]
        at = np.minimum(np.searchsorted(foreign, keys), len(foreign) - 1)
        known = np.flatnonzero(foreign[at] == keys)
        place[at[known]] = start + known
    vertices, faces = [], []
    for (name, count), start in zip(names, starts.tolist()):
        part = parts.pop(0)
        number = np.empty(len(part.keys), np.int32)
        number[part.mine] = np.arange(start, start + count)
        number[~part.mine] = place[np.searchsorted(foreign, part.keys[~part.mine])]
        if len(number) and number.min() < 0:
            raise torn(f"{np.count_nonzero(number < 0):,} vertices lack beside", [name])
        vertices.append(part.mesh.vertices[part.mine])
        faces.append(number[part.mesh.faces])
        del part
    return Mesh(np.concatenate(vertices), np.concatenate(faces)), names


def check_closed(
    mesh: Mesh, lattice: SdfGrid, names: Sequence[tuple[str, int]], *, cap: bool
) -> int:
    """Return how many edges of a mesh are open; MeshError if some are that should not be.

    Open are those on the border of the grid, if there is no ``cap``, and any others if the surface
    may end at unknown samples. ``names`` are those of ``join``.
    """
    edges = mesh.boundary()
    if lattice.field.unseen is not None or not len(edges):
        return len(edges)
    bad = edges
    if not cap:
        place = lattice.to_index(mesh.vertices[edges].reshape(-1, 3)).reshape(-1, 2, 3)
        border = (place < ON_BORDER - 0.5) | (place > np.array(lattice.shape) - 0.5 - ON_BORDER)
        bad = edges[~np.any(border.all(1), axis=1)]
    if len(bad):
        last = np.cumsum([count for _, count in names])
        some = np.unique(np.searchsorted(last, bad.ravel(), "right"))
        raise torn(f"{len(bad):,} edges are open", [names[n][0] for n in some])
    return len(edges)


def torn(what: str, names: Sequence[str]) -> MeshError:
    """Return the error for a mesh that has holes in the tiles of some names."""
    way = "run it again, and report it if that does not help"
    if any(name.endswith(")") for name in names):  # a worker made it
        way = "use workers with the same processor, NumPy and onnxruntime"
    return MeshError(f"the mesh is torn, {what} in {' and '.join(names[:4])}: {way}")
