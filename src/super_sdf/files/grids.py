"""Grids from files, and to them: ``.npy`` (an array) and ``.npz``.

The keys of the latter are ``values`` and, optionally, ``spacing`` and ``origin``. Files are checked
before they are read.
"""

from __future__ import annotations

import zipfile
import zlib
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..errors import FileError, GridError, OptionError, SuperSdfError
from ..grid import SdfGrid
from ..memory import check_fits
from .conventions import make_grid
from .output import check_free, replacing

GRID_SUFFIXES = (".npy", ".npz")
NPZ_KEYS = ("values", "spacing", "origin")


def read_grid(
    path: str | Path,
    *,
    spacing: Any = None,
    origin: Any = None,
    inside: str = "auto",
    level: float = 0.0,
) -> SdfGrid:
    """Read a grid; ``spacing`` and ``origin`` go before those in the file. See ``make_grid``.

    An ``.npy`` file is mapped, not loaded.

    Raises
    ------
    FileError
        If the file is missing, damaged, truncated or of another kind.
    OutOfMemoryError
        If it is larger than memory.
    GridError
        If its values are no signed distance grid.
    """
    path = Path(path)
    if path.suffix.lower() not in GRID_SUFFIXES:
        raise OptionError(f"{path} is no grid file: give {' or '.join(GRID_SUFFIXES)}")
    try:
        found = _read_npy(path) if path.suffix.lower() == ".npy" else _read_npz(path)
    except FileNotFoundError:
        raise FileError(f"{path} does not exist") from None
    except IsADirectoryError:
        raise FileError(f"{path} is a folder: give a file") from None
    except PermissionError:
        raise FileError(f"{path} cannot be read: permission denied") from None
    given = {"spacing": spacing, "origin": origin}
    chosen = {key: found.get(key) if own is None else own for key, own in given.items()}
    return make_grid(found["values"], inside=inside, level=level, **chosen)


def _read_npy(path: Path) -> dict[str, NDArray[Any]]:
    """Map the array of an .npy file."""
    with path.open("rb") as file:
        shape, dtype = _read_header(file, str(path))
        follow = path.stat().st_size - file.tell()
    _check_promise(shape, dtype, follow, str(path))
    return {"values": np.load(path, mmap_mode="r", allow_pickle=False)}


def _read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Read the known arrays of an .npz file."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist()]
            if "values" not in names:
                held = ", ".join(names) or "nothing"
                raise FileError(f"{path} has no key 'values' (it holds {held})")
            return {key: _read_member(archive, key, path) for key in NPZ_KEYS if key in names}
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        # The last two are zipfile's for an unknown compression and for an encrypted member.
        if isinstance(error, SuperSdfError):
            raise
        raise FileError(f"{path} is no readable .npz archive: {error}") from None


def _read_member(archive: zipfile.ZipFile, key: str, path: Path) -> NDArray[Any]:
    """Read one array of an archive, after its size was checked."""
    name = f"{path}[{key}]"
    member = archive.getinfo(f"{key}.npy")
    with archive.open(member) as file:
        shape, dtype = _read_header(file, name)
        if key != "values" and prod(shape) > 3:
            raise GridError(f"{name} has shape {shape}: give one number or three")
        _check_promise(shape, dtype, member.file_size - file.tell(), name, loaded=True)
    with archive.open(member) as file:
        array: NDArray[Any] = npy.read_array(file, allow_pickle=False)
    return array


def _read_header(file: IO[bytes], name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return shape and dtype that an .npy header declares."""
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    try:
        shape, _, dtype = readers[npy.read_magic(file)](file)
    except (ValueError, KeyError, EOFError):
        raise FileError(f"{name} is no .npy array: its header cannot be read") from None
    if dtype.hasobject:
        raise FileError(f"{name} holds Python objects: save the numbers alone")
    return shape, dtype


def _check_promise(
    shape: tuple[int, ...], dtype: np.dtype[Any], follow: int, name: str, loaded: bool = False
) -> None:
    """Raise if an array is longer than its file or, to be loaded, than memory."""
    size = prod(shape) * dtype.itemsize
    said = f"{' x '.join(map(str, shape))} {dtype}, {size:,} bytes"
    if size > follow:
        raise FileError(f"{name} is truncated: its header promises {said}, but {follow:,} follow")
    if loaded:
        check_fits(size, f"{name}, {said},", "save it as .npy, which is read piece by piece")


def check_grid_target(path: str | Path, *, force: bool = False) -> Path:
    """Return the path of a grid file to be if it can be written; asked before the work starts."""
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise OptionError(f"{path} is no grid file that keeps spacing and origin: give .npz")
    return check_free(path, force=force)


def write_grid(grid: SdfGrid, path: str | Path, *, force: bool = False) -> None:
    """Write a grid as ``.npz``: values, spacing and origin, as ``read_grid`` reads them.

    Raises
    ------
    OptionError
        If the suffix is another.
    FileError
        If the file exists and ``force`` is not set, or cannot be written.
    """
    path = check_grid_target(path, force=force)
    with replacing(path, force=force) as part, part.open("wb") as file:
        np.savez(file, values=grid.values, spacing=grid.spacing, origin=grid.origin)
