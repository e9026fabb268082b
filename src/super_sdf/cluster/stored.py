"""Planes of a grid in a store that several processes open for themselves.

A chunked array is unpacked layer by layer: planes of x that share chunks. A layer that was read
stays unpacked, in memory or in a temporary file, since each pass over the grid needs it again.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, OptionError, OutOfMemoryError
from ..files.formats import choose_axes, find_format
from ..files.grids import one_line_errors, open_volume
from ..files.unpacking import PIECE, unpacked
from ..files.volume import find_placement, place_in_world
from ..grid.planes import SampleArray, SamplePlanes
from ..machine.memory import ROOM_SHARE, held_memory

ROOM = 1 << 28  # bytes for layers that stay unpacked, if there is no bound
WAY_OUT = "convert it on one machine (without --cluster)"


class Source(NamedTuple):
    """A grid file as all processes open it, by its absolute path; ``axes`` as in ``read_grid``.

    A direction that the user gives replaces that in the file. ``run`` differs from run to run: the
    file may have changed since the one before.
    """

    path: str
    axes: str | None
    has_direction: bool = False
    run: str = ""

    @property
    def is_npy(self) -> bool:
        """Whether it is an .npy file, which is read without unpacking."""
        return find_format(self.path).key == "npy"


def check_source(source: Source) -> None:
    """Raise OptionError if workers cannot read the planes of such a file for themselves."""
    if find_format(source.path).key not in ("npy", "zarr"):
        raise OptionError(
            f"{source.path} cannot be read by several workers at once: --cluster takes .zarr and "
            f".npy; {WAY_OUT}, or save it as .zarr"
        )
    if source.is_npy and source.axes == "zyx":
        raise OptionError(
            f"axes is 'zyx', but workers read planes of x of {source.path}: {WAY_OUT}, or save it "
            "as .zarr"
        )


class StoredPlanes(SamplePlanes):
    """The samples of a store, whose planes along x any process reads for itself.

    Pickled, it is the path: another process opens the store when it reads the first plane.
    """

    travels = True

    def __init__(self, source: Source, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self.source, self.name = source, source.path
        self.shape, self.dtype = shape, dtype

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to ``last`` (exclusive), (last - first, ny, nz)."""
        store = opened(self.source)
        if store.shape != self.shape or store.dtype != self.dtype:
            raise FileError(f"{self.name} changed while it was read: read it when it is complete")
        return store.read(first, last)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle where the samples are."""
        return StoredPlanes, (self.source, self.shape, self.dtype)


class Store:
    """An open store in this process, with the layers (planes that share chunks) it has unpacked.

    ``bound`` are the bytes that this process may hold, if that is known.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    layer = 1

    def __init__(self, source: Source) -> None:
        self.source = source
        self.files = ExitStack()
        self.layers: dict[int, SampleArray] = {}
        self.bound: int | None = None
        path = Path(source.path)
        self.format = find_format(path)
        if source.is_npy:
            with open_volume(path, self.format, "xyz", (0, None)) as volume:
                if volume.axes != "xyz":
                    raise FileError(f"{path} is in Fortran order: save it in C order, or {WAY_OUT}")
            self.shape, self.dtype = volume.shape, volume.dtype
            self.planes: Any = volume.stored
        else:
            self._open_volume(path, choose_axes(self.format, source.axes))

    def _open_volume(self, path: Path, axes: str) -> None:
        """Open a store that a library reads."""
        volume = self.files.enter_context(open_volume(path, self.format, axes, (0, None)))
        self.volume = volume.turned(axes) if self.source.has_direction else volume
        self.placement = find_placement(self.volume, str(path))
        order = [self.placement.world_axes.index(world) for world in range(3)]
        self.shape, self.dtype = tuple(self.volume.shape[axis] for axis in order), volume.dtype
        nx, ny, nz = self.shape
        unit = min(self.volume.unit[order[0]], nx)
        self.layer = unit * max(PIECE // (ny * nz * self.dtype.itemsize * unit), 1)

    def place(self, given: dict[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
        """Return the place in the world, ``given`` or that of the file, and notes."""
        if self.source.is_npy:
            return given, ()
        return place_in_world(self.volume, self.placement, given), self.volume.notes

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return planes ``first`` to before ``last``."""
        if self.source.is_npy:
            return np.asarray(self.planes[first:last])
        parts = [np.empty((0, *self.shape[1:]), self.dtype)]
        for start in range(first - first % self.layer, last, self.layer):
            low, high = max(first - start, 0), min(last - start, self.layer)
            parts.append(np.asarray(self._layer(start)[low:high]))
        return parts[-1] if len(parts) <= 2 else np.concatenate(parts)

    def _layer(self, start: int) -> SampleArray:
        """Return the layer that begins at a plane, unpacked once if there is room for it."""
        if start not in self.layers:
            try:
                layer = self._unpacked(start)
            except OutOfMemoryError:
                if not self.layers:
                    raise
                self.layers.clear()  # make room on the disk
                layer = self._unpacked(start)
            self.layers[start] = layer
        return self.layers[start]

    def _unpacked(self, start: int) -> SampleArray:
        """Return a layer unpacked, in memory or in a temporary file."""
        planes = start, min(start + self.layer, self.shape[0])
        held = sum(layer.nbytes for layer in self.layers.values() if isinstance(layer, np.ndarray))
        room = ROOM if self.bound is None else int(ROOM_SHARE * self.bound)
        left = None if self.bound is None else max(self.bound - (held_memory() or 0), 0)
        path = self.source.path
        with one_line_errors(Path(path), self.format, None):
            return unpacked(self.volume, self.placement, path, (room - held, left), planes)


_stores: dict[Source, Store] = {}


def opened(source: Source) -> Store:
    """Return a store of this process, opened once; the one before is closed."""
    if source not in _stores:
        close_stores()
        _stores[source] = Store(source)
    return _stores[source]


def close_stores() -> None:
    """Close what is open in this process, and free its layers."""
    while _stores:
        _, store = _stores.popitem()
        store.layers.clear()
        store.files.close()
