"""Arrays that cannot be read plane by plane in their file: compressed, or in another axis order.

Each is copied once, so that its planes of x are contiguous: into memory if it is small, else into a
temporary file without a name, which disappears with the process, however that ends. It is read in
boxes of whole chunks, each of which is unpacked once. A box has as many chunks side by side as a
little memory allows, first along the axis that is fastest in the copy.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from io import FileIO
from itertools import pairwise, product
from math import prod
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, OutOfMemoryError
from ..grid.placement import check_kind
from ..grid.planes import InputFile, PlaneFile, SampleArray
from ..threads import in_words
from .volume import Box, Placement, Volume, find_placement, in_words_of, place_in_world

PIECE = 1 << 23  # bytes at a time
# Of a chunked array: bytes of a box, unless little memory is left; how many times the memory of a
# box or chunk reading it takes, with its packed bytes and the copy in another order of axes.
BOX, LEAST_SHARE, COPIES = 1 << 25, 16, 3
# No grid with a surface is compressed further than this; deflate reaches 1,030 on zeros.
BOMB_RATIO = 500
ON_DISK = "/var/tmp"  # /tmp is in memory on many systems

Sizes: TypeAlias = tuple[int, ...]


def take(
    volume: Volume, name: str, room: int, given: dict[str, Any], left: int | None = None
) -> dict[str, Any]:
    """Return values (nx, ny, nz), spacing, origin and direction of a volume, for ``make_grid``.

    ``given`` replaces what the file says of its place. ``left`` is how many bytes of memory the
    process may still take, None if unknown.
    """
    check_kind(volume.dtype, volume.shape)
    placement = find_placement(volume, name)
    values = volume.stored
    if values is None or placement.world_axes != (0, 1, 2) or any(placement.backwards):
        values = unpacked(volume, placement, name, (room, left))
    return {"values": values, **place_in_world(volume, placement, given)}


def unpacked(
    volume: Volume,
    placement: Placement,
    name: str,
    memory: tuple[int, int | None],
    planes: tuple[int, int] | None = None,
) -> SampleArray:
    """Return the samples, or some planes of x, as an array in memory or in a temporary file.

    ``memory`` is how many bytes the array may take, and the process in all, None if unknown.
    """
    room, left = memory
    name += volume.part
    _check_chunk(volume, name, left)
    size = prod(volume.shape) * volume.dtype.itemsize
    if volume.packed is not None and size > room and size > BOMB_RATIO * volume.packed:
        raise OutOfMemoryError(
            f"{name}, {in_words_of(volume.shape, volume.dtype)}, is compressed to "
            f"{volume.packed:,} bytes, like a zip bomb, and does not fit in memory; if it is a "
            "grid, save it as .npy"
        )
    x, y, z = placement.of_world((0, 1, 2))
    order, is_swapped = (x, min(y, z), max(y, z)), z < y
    budget = PIECE
    if volume.chunks:
        budget = BOX if left is None else max(min(BOX, left // LEAST_SHARE), PIECE)
    box = _box(volume, order, budget // volume.dtype.itemsize)
    nx, ny, nz = placement.of_world(volume.shape)
    first, last = planes or (0, nx)
    copy = (last - first, *((nz, ny) if is_swapped else (ny, nz)))
    blocks = _blocks(volume, placement, (order, box), (first, last))
    if prod(copy) * volume.dtype.itemsize <= room:
        held = np.empty(copy, volume.dtype)
        for start, block in blocks:
            held[tuple(slice(a, a + n) for a, n in zip(start, block.shape))] = block
        return held.transpose(0, 2, 1) if is_swapped else held
    shape = (last - first, ny, nz)
    file = _scratch_file(
        prod(copy) * volume.dtype.itemsize, f"{name}, {in_words_of(shape, volume.dtype)}"
    )
    for start, block in blocks:
        for offset, piece in runs_of(block, start, copy):
            _write(file, offset, piece, name)
    return PlaneFile(InputFile(file, name), 0, shape, volume.dtype, swapped=is_swapped)


def _check_chunk(volume: Volume, name: str, left: int | None) -> None:
    size = prod(volume.unit) * volume.dtype.itemsize
    if left is not None and COPIES * size > (left if volume.chunks else max(left, BOX)):
        parts = "chunks" if volume.chunks else "planes"
        chunk = " x ".join(map(str, volume.unit))
        raise OutOfMemoryError(
            f"{name} is stored in {parts} of {chunk} samples, {in_words(size)} each, and to unpack "
            f"one takes {in_words(COPIES * size)} of memory, {in_words(max(left, 0))} are left; "
            "allow more (--max-memory), or store it in smaller chunks"
        )


def _box(volume: Volume, order: Sizes, budget: int) -> Sizes:
    """Return the samples of a box along each axis: at most ``budget``, or one chunk."""
    box = [min(chunk, count) for chunk, count in zip(volume.unit, volume.shape)]
    for axis in reversed(order):
        chunk = volume.unit[axis]
        fitting = max(budget // (prod(box) // box[axis] * chunk), 1)
        box[axis] = min(fitting * chunk, volume.shape[axis])
    return tuple(box)


def _blocks(
    volume: Volume, placement: Placement, layout: tuple[Sizes, Sizes], planes: tuple[int, int]
) -> Iterator[tuple[Sizes, NDArray[Any]]]:
    """Yield some planes of x of a volume box by box, each with its start in the copy."""
    order, size = layout
    backwards = placement.backwards
    bounds = [(0, count) for count in volume.shape]
    bounds[order[0]] = planes
    if backwards[order[0]]:
        bounds[order[0]] = volume.shape[order[0]] - planes[1], volume.shape[order[0]] - planes[0]
    flipped = tuple(axis for axis in range(3) if backwards[axis])
    for box in _boxes_of(bounds, size):
        block = np.ascontiguousarray(np.flip(volume.box(box), flipped).transpose(order))
        start = [
            volume.shape[axis] - box[axis].stop if backwards[axis] else box[axis].start
            for axis in order
        ]
        start[0] -= planes[0]
        yield tuple(start), block
        del block  # before the next one is read


def _boxes_of(bounds: Sequence[tuple[int, int]], box: Sizes) -> Iterator[Box]:
    cuts = []
    for (low, high), size in zip(bounds, box):
        inner = range((low // size + 1) * size, high, size)
        cuts.append([slice(a, b) for a, b in pairwise([low, *inner, high])])
    yield from product(*cuts)


def runs_of(
    block: NDArray[Any], start: Sizes, shape: Sizes
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield the bytes of a block at ``start`` that are contiguous in an array, and where there."""
    _, b, c = shape
    apart = 1 if block.shape[2] == c else 2  # axes along which pieces are apart in the array
    if apart == 1 and block.shape[1] == b:
        apart = 0
    steps = np.array([b * c, c, 1]) * block.itemsize
    first = int(np.dot(start, steps))
    for place in np.ndindex(block.shape[:apart]):
        yield first + int(np.dot(place, steps[:apart])), block[place].reshape(-1).view(np.uint8)


def _write(file: FileIO, start: int, piece: NDArray[np.uint8], name: str) -> None:
    rest = piece.data
    try:
        file.seek(start)
        while rest:
            rest = rest[file.write(rest) :]
    except OSError as error:
        raise FileError(
            f"{name} cannot be unpacked to {scratch_folder()}: {error.strerror or error}; "
            "set TMPDIR to another folder"
        ) from None


def scratch_folder() -> str:
    """Return the folder for temporary files: TMPDIR, else one on a disk."""
    if not os.environ.get("TMPDIR") and os.access(ON_DISK, os.W_OK):
        return ON_DISK
    return tempfile.gettempdir()


def _scratch_file(size: int, what: str) -> FileIO:
    """Return an empty unnamed file with room for an array, on a disk: memory would count."""
    folder = scratch_folder()
    if folder == "/dev/shm":
        raise OutOfMemoryError(
            f"{what}, is too large to unpack into memory, and {folder} is in memory, "
            "too: set TMPDIR to a folder on a disk, or allow more (--max-memory)"
        )
    free = shutil.disk_usage(folder).free
    if size > free:
        raise OutOfMemoryError(
            f"{what}, is too large to unpack into memory, and {folder} has "
            f"{in_words(free)} free; save it as .npy in C order, or set TMPDIR to a folder "
            "with more room"
        )
    try:
        return tempfile.TemporaryFile(dir=folder, prefix="super-sdf-", buffering=0)
    except OSError as error:
        raise FileError(f"no temporary file can be made in {folder}: {error.strerror}") from None
