"""Reading and writing grid files: ``.npy`` (one array), ``.npz``, and other people's formats.

The keys of an ``.npz`` are ``values`` and, optionally, ``spacing``, ``origin`` and ``direction``.
Files are checked before they are read. ``formats`` has the table of all formats, ``readers`` their
readers.
"""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, GridError, OptionError, OutOfMemoryError, SuperSdfError
from ..grid.field import Wanted
from ..grid.planes import InputFile, PlaneFile, SampleArray, check_planes
from ..grid.samples import check_kind
from ..grid.sdf_grid import SdfGrid, make_grid
from ..machine.memory import ROOM_SHARE, held_memory, memory_bound
from ..options import check_path
from .apart import volume_apart
from .archives import Member, open_archive
from .formats import (
    GridFormat,
    check_direction_given,
    check_library,
    choose_axes,
    find_format,
    split_member,
)
from .headers import ArrayHeader, Read, read_array_header
from .output import check_free, replacing
from .regular import check_regular_file
from .store import check_grid_file
from .unpacking import check_ratio, unpack
from .volume import Request, Volume, axes_direction, take

PLACE = ("spacing", "origin", "direction")
NPZ_KEYS = ("values", *PLACE)
OPEN3D = {"key.npy", "voxel_size.npy", "block_resolution.npy", "attr_name_tsdf.npy"}
NUMBERS = "one number or three"
MOST_NAMED = 10  # members of an archive that an error lists
UNKNOWN_ROOM = 1 << 28  # bytes that an unpacked array may take if the memory left is unknown

READ_OPTIONS = (
    *("spacing", "origin", "direction", "axes", "inside", "field", "label", "level", "scale"),
    "max_memory",
)
"""What ``read_grid`` takes besides the path."""


def read_grid_with(path: str | Path, options: Any) -> SdfGrid:
    """Read a grid as an object with the attributes ``READ_OPTIONS`` says; see ``read_grid``."""
    return read_grid(path, **{name: getattr(options, name) for name in READ_OPTIONS})


def read_grid(
    path: str | Path,
    *,
    spacing: Any = None,
    origin: Any = None,
    direction: Any = None,
    axes: str | None = None,
    inside: str = "auto",
    field: str = "auto",
    label: int | None = None,
    level: float | None = None,
    scale: float | None = None,
    max_memory: int | None = None,
) -> SdfGrid:
    """Read a grid from a file of any format in ``formats.FORMATS``; docs/formats.md describes them.

    An ``.npy`` file is not loaded but read plane by plane, now and when the grid is refined. Others
    are unpacked first, and so are arrays in another axis order: into memory if that takes at most
    a quarter of what is left of ``max_memory``, else into a temporary file.

    Parameters
    ----------
    path : path
        The file; ``FILE:NAME`` names one of several arrays in a file.
    spacing, origin : number or three, optional
        Used instead of those in the file; see ``make_grid``.
    direction : nine numbers or (3, 3), optional
        How the axes x, y and z of the array lie in the world, used instead of what the file says;
        see ``make_grid``. Only for files in which it may be missing: ``.npy``, ``.npz``, TIFF, HDF5
        and Zarr.
    axes : {"xyz", "zyx"}, optional
        The axis order of an array whose file does not state one. Default: x, y, z in ``.npy`` and
        ``.npz``, else z, y, x.
    inside : {"auto", "negative", "positive"}
        Sign of the values inside the solid; see ``make_grid``.
    field, label, level, scale
        What the values are; see ``make_grid``.
    max_memory : int, optional
        Bytes that this process may hold in all. Default: a share of the free memory.

    Raises
    ------
    FileError
        If the file is missing, damaged, truncated, of another kind, or changes while it is read;
        if the library for its format is missing.
    OutOfMemoryError
        If there is no room to unpack it.
    GridError
        If its values are not a signed distance grid, or its axes are not at right angles.
    OptionError
        If the suffix, ``axes``, ``inside`` or ``field`` is unknown; if a direction is given, but
        files of the format state it.
    """
    Wanted(field, label, level, scale).check()
    place = {"spacing": spacing, "origin": origin, "direction": direction}
    found = read_array(path, place, axes, max_memory)
    grid = make_grid(
        found["values"],
        **{key: found[key] for key in PLACE},
        inside=inside,
        field=field,
        label=label,
        level=level,
        scale=scale,
    )
    return grid.noted(found["notes"])


def read_array(
    path: Any, given: dict[str, Any], axes: str | None, max_memory: int | None
) -> dict[str, Any]:
    """Return values, place (``PLACE``, unless ``given``) and notes of a file: see ``read_grid``."""
    path = check_path(path, "path")
    format_ = find_format(path)
    order = choose_axes(format_, axes)
    check_direction_given(format_, given["direction"])
    room = unpacking_room(max_memory)
    if format_.key in ("npy", "npz"):
        found = _read_numpy(check_regular_file(path), order, room, given)
    else:
        found = _read_foreign(path, format_, order, room, given, max_memory)
    check_planes(found["values"], memory_bound(max_memory))
    return {key: found[key] for key in ("values", *PLACE)} | {"notes": found.get("notes", ())}


def _read_numpy(path: Path, axes: str, room: int, given: dict[str, Any]) -> dict[str, Any]:
    """Return the arrays of an .npy or .npz file, with the axes x, y, z."""
    read = _read_npy if path.suffix.lower() == ".npy" else _read_npz
    found = read(path, room)
    place = {key: found.get(key) if own is None else own for key, own in given.items()}
    values = found["values"]
    if axes != "xyz":
        turned = axes_direction(axes)
        volume = Volume(values.shape, values.dtype, lambda a, b: values[a:b], direction=turned)
        values = take(volume, str(path), room, place)["values"]
    return {"values": values, **place}


def _read_foreign(
    path: Path,
    format_: GridFormat,
    axes: str,
    room: int,
    given: dict[str, Any],
    max_memory: int | None,
) -> dict[str, Any]:
    """Return values and place of a file that its own library reads."""
    bound = memory_bound(max_memory)
    left = None if bound is None else bound - (held_memory() or 0)
    with open_volume(path, format_, axes, (room, left)) as volume:
        if given["direction"] is not None:
            volume = volume.turned(axes)
        found = take(volume, str(path), room, given, left)
        return found | {"notes": volume.notes}


@contextmanager
def open_volume(
    path: Path, format_: GridFormat, axes: str, memory: tuple[int, int | None]
) -> Iterator[Volume]:
    """Yield the volume in a file that its own library reads; its errors are of one line.

    ``memory`` is how many bytes the unpacked array may take, and the process in all.
    """
    file, member = split_member(path)
    check_grid_file(path)
    check_library(format_)
    from .readers.table import READERS

    watched = None if file.is_dir() else InputFile.open(file)
    with one_line_errors(path, format_, watched), ExitStack() as files:
        request = Request(file, member, axes, *memory, files)
        if format_.is_apart:
            yield files.enter_context(volume_apart(format_.key, request))
        else:
            yield READERS[format_.key](request)


@contextmanager
def one_line_errors(path: Path, format_: GridFormat, watched: InputFile | None) -> Iterator[None]:
    """Turn whatever a library raises into a FileError of one line, and silence its warnings."""
    try:
        with warnings.catch_warnings(), _silent_logs():
            warnings.simplefilter("ignore")
            yield
    except SuperSdfError as error:
        if str(split_member(path)[0]) in str(error) or isinstance(error, OutOfMemoryError):
            raise
        raise type(error)(f"{path}: {error}") from None
    except Exception as error:  # the libraries raise all kinds of errors
        if isinstance(error, MemoryError):
            raise
        if watched:
            watched.check_unchanged()
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        reason = lines[-1][:200] if lines else type(error).__name__
        raise FileError(f"{path} cannot be read as {format_.name}: {reason}") from error
    if watched:
        watched.check_unchanged()


@contextmanager
def _silent_logs() -> Iterator[None]:
    """Keep libraries from logging to stderr: what matters is raised."""
    import logging

    disabled = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(disabled)


def unpacking_room(max_memory: int | None) -> int:
    """Return how many bytes of memory an unpacked array may take."""
    bound = memory_bound(max_memory)
    if bound is None:
        return UNKNOWN_ROOM
    return int(ROOM_SHARE * max(bound - (held_memory() or 0), 0))


def _read_npy(path: Path, room: int) -> dict[str, Any]:
    """Return the array of an .npy file: a ``PlaneFile``, or unpacked if in Fortran order."""
    file = InputFile.open(path)
    read = reader_of(file)
    header = read_array_header(read, str(path)).squeezed()
    _check_size(header, file.size - header.length, str(path))
    check_kind(header.dtype, header.shape)
    if header.fortran_order:
        return {"values": unpack(read, header, str(path), room)}
    return {"values": PlaneFile(file, header.length, header.shape, header.dtype)}


def reader_of(file: InputFile) -> Read:
    """Return a function that reads a file from its beginning on."""
    place = 0

    def read(count: int) -> bytes:
        nonlocal place
        data = file.read(place, count)
        place += len(data)
        return data.tobytes()

    return read


def _read_npz(path: Path, room: int) -> dict[str, Any]:
    """Read the known arrays of an .npz file."""
    file = InputFile.open(path)
    try:
        with open_archive(file) as archive:
            if OPEN3D.issubset(archive.namelist()):
                return _read_blocks(archive, path, room)
            members = find_members(archive, path)
            found = {
                key: read_small(archive, members[key], f"{path}[{key}]")
                for key in NPZ_KEYS[1:]
                if key in members
            }
            return found | {"values": _read_values(archive, members["values"], path, room)}
    finally:
        file.check_unchanged()  # a change explains whatever else went wrong


def _read_blocks(archive: zipfile.ZipFile, path: Path, room: int) -> dict[str, Any]:
    """Return the dense values and place of a ``VoxelBlockGrid`` that Open3D saved."""
    from .readers.open3d import volume_of_blocks

    def array(key: str) -> NDArray[Any]:
        if f"{key}.npy" not in archive.namelist():
            raise FileError(f"{path} is Open3D's VoxelBlockGrid, but has no key {key!r}")
        name = f"{path}[{key}]"
        member = Member(archive, archive.getinfo(f"{key}.npy"), name)
        header = read_array_header(member.read, name)
        if header.size > room:
            raise OutOfMemoryError(f"{name}, {header}, does not fit: allow more (--max-memory)")
        _check_size(header, member.left, name)
        return np.frombuffer(member.read(header.size), header.dtype).reshape(header.shape)

    return take(volume_of_blocks(array), str(path), room, dict.fromkeys(PLACE))


def find_members(archive: zipfile.ZipFile, path: Path) -> dict[str, zipfile.ZipInfo]:
    """Return the members that belong to a grid, by key."""
    infos = archive.infolist()
    names = [info.filename.removesuffix(".npy") for info in infos]
    if {"voxels", "factor"} <= set(names):
        raise FileError(
            f"{path} is a refined field, no grid: mesh it with extract_mesh(read_field(path))"
        )
    if "values" not in names:
        held = ", ".join(names[:MOST_NAMED]) or "nothing"
        more = f" and {len(names) - MOST_NAMED:,} more" if len(names) > MOST_NAMED else ""
        raise FileError(f"{path} has no key 'values' (it holds {held}{more})")
    twice = next((key for key in NPZ_KEYS if names.count(key) > 1), None)
    if twice:
        raise FileError(f"{path} holds {twice!r} {names.count(twice)} times: save it once")
    return {name: info for name, info in zip(names, infos) if name in NPZ_KEYS}


def read_small(archive: zipfile.ZipFile, info: zipfile.ZipInfo, name: str) -> NDArray[Any]:
    """Read an array of one number or three; of nine, for a direction."""
    most, asked = (9, "nine numbers") if name.endswith("[direction]") else (3, NUMBERS)
    member = Member(archive, info, name)
    header = read_array_header(member.read, name)
    if prod(header.shape) > most:
        raise GridError(f"{name} has shape {header.shape}: give {asked}")
    if header.dtype.kind not in "fiu":
        raise GridError(f"{name} has dtype {header.dtype}: give {asked}")
    _check_size(header, member.left, name)
    return np.frombuffer(member.read(header.size), header.dtype).reshape(header.shape)


def npz_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> Member:
    """Return the values of an .npz file, to be read from their beginning on."""
    return Member(archive, info, f"{path}[values]")


def _read_values(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path, room: int
) -> SampleArray:
    """Unpack the array of samples."""
    name = f"{path}[values]"
    member = npz_member(archive, info, path)
    header = read_array_header(member.read, name).squeezed()
    _check_size(header, member.left, name)
    check_kind(header.dtype, header.shape)
    check_ratio(header, info.compress_size, name, room)
    return unpack(member.read, header, name, room)


def _check_size(header: ArrayHeader, follow: int, name: str) -> None:
    """Raise FileError unless ``follow`` bytes, those after the header, are the array."""
    sizes = f"its header promises {header}, but {follow:,} follow"
    if header.size > follow:
        raise FileError(f"{name} is truncated: {sizes}")
    if header.size < follow:
        raise FileError(f"{name} holds more than one array, or its header is damaged: {sizes}")


def check_grid_target(path: str | Path, *, force: bool = False) -> Path:
    """Return the path if a grid file can be written there; called before the work starts."""
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise OptionError(f"{path} is not a grid file with spacing and origin: give .npz")
    return check_free(path, force=force)


def write_grid(grid: SdfGrid, path: str | Path, *, force: bool = False) -> None:
    """Write a grid as ``.npz``: the keys values, spacing, origin and, if it is turned, direction.

    Raises
    ------
    OptionError
        If the suffix is not ``.npz``.
    FileError
        If the file exists and ``force`` is not set, or cannot be written.
    """
    path = check_grid_target(path, force=force)
    arrays: dict[str, Any] = {"spacing": grid.spacing, "origin": grid.origin}
    if not grid.is_straight:
        arrays["direction"] = grid.direction
    with replacing(path, force=force) as part, part.open("wb") as file:
        np.savez(file, values=grid.values, **arrays)
