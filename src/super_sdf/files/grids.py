"""Reading grid files of all formats, and writing ``.npz``.

``formats`` has the table of all formats, ``readers`` calls the library of each.
"""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from importlib import import_module
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import FileError, OptionError, OutOfMemoryError, SuperSdfError, check_modules
from ..grid.samples import check_kind
from ..grid.sdf_grid import SdfGrid, make_grid, with_fields
from ..options import OPTIONS, PATH, AxisOrder, FieldKind, Inside, Options, Space, Values
from .formats import DICOM, check_regular_file, find_format, is_store, split_member
from .output import check_free, replacing
from .readers import MOST_NAMED, Names, Request, Volume, axes_direction, find_placement

if TYPE_CHECKING:
    from typing_extensions import Unpack


def read_grid(
    path: str | Path,
    *,
    spacing: Any = None,
    origin: Any = None,
    direction: Any = None,
    axes: AxisOrder | None = None,
    space: Space | None = None,
    inside: Inside = "auto",
    field: FieldKind = "auto",
    label: int | None = None,
    level: float | None = None,
    scale: float | None = None,
    unknown: float | None = None,
    max_memory: int | None = None,
) -> SdfGrid:
    """Read a grid from a file of any format in docs/guides/formats.md.

    An ``.npy`` file is memory-mapped, other files are loaded.

    Parameters
    ----------
    path : path
        The file; ``FILE:NAME`` names one of several arrays in a file, and ``FILE:NAME[3]`` or
        ``FILE[3]`` the fourth of several times, channels or classes in an array.
    spacing, origin, direction : numbers, optional
        Replace the values of the file; see ``make_grid``. ``direction`` is for files that state no
        axes.
    axes : {"xyz", "zyx"}, optional
        The axis order of an array whose file does not state one. Default: x, y, z in ``.npy``,
        ``.npz`` and MATLAB, else z, y, x.
    space : {"RAS", "LPS"}, optional
        Anatomical space of the grid, for files that state a space. Default: the file's space.
    inside, field, label, level, scale, unknown
        The kind of the values; see ``make_grid``.
    max_memory : int, optional
        Memory limit of this process in bytes. Default: a share of the free memory.

    Raises
    ------
    FileError, OutOfMemoryError, GridError, OptionError
        If the file cannot be read, for example without its library; if the grid does not fit in
        memory; if the values are no usable grid; if an option is wrong, or stated by the file.
    """
    values: Values = {"inside": inside, "field": field, "label": label, "level": level}
    values |= {"scale": scale, "unknown": unknown}
    Options(space=space, **values)  # checks them
    given = {"spacing": spacing, "origin": origin, "direction": direction}
    arrays = read_array(path, given, axes, space, max_memory)
    notes, space, names = (arrays.pop(key) for key in ("notes", "space", "names"))
    try:
        grid = make_grid(**arrays, **values)
    except SuperSdfError as error:
        listed = ", ".join(f"{n} ({name})" for n, (name, _) in [*names.items()][:MOST_NAMED])
        raise type(error)(error.flagged + f"; its labels: {listed}" * bool(names)) from None
    return with_fields(grid, flagged=(*notes, *grid.flagged), space=space)


def read_array(
    path: Any,
    given: dict[str, Any],
    axes: AxisOrder | None,
    space: Space | None,
    max_memory: int | None,
) -> dict[str, Any]:
    """Return values, place (unless ``given``), hint, space and notes: see ``read_grid``."""
    path, direction = PATH.check(path, "path"), given["direction"]
    with open_volume(path, axes, max_memory, direction) as (volume, request):
        volume = volume.in_space(space, str(path))
        if direction is not None:  # of x, y and z
            volume = replace(volume, direction=axes_direction(volume.axes or request.axes))
        arrays = _taken(volume, request, given)
    return arrays | {"notes": volume.notes, "space": volume.space, "names": volume.names}


def names_in(path: str | Path) -> Names:
    """Return the names of labels, and their colours, that a grid file states."""
    if find_format(path).key not in ("nrrd", "dicom"):  # others name none
        return {}
    with open_volume(Path(path)) as (volume, _):
        return volume.names


@contextmanager
def open_volume(
    path: Path, axes: str | None = None, max_memory: int | None = None, direction: Any = None
) -> Iterator[tuple[Volume, Request]]:
    """Yield the volume in a file, and what was asked for; all errors become those of a line."""
    format_, (file, named) = find_format(path), split_member(path)
    if format_ is not DICOM and not is_store(file):
        check_regular_file(file)
    if format_.extra:
        check_modules(f"{format_.name} ({format_.suffixes[0]})", format_.extra)
    member, brackets = re.fullmatch(r"(.*?)((?:\[\d+\])*)", named or "", re.S).groups()  # type: ignore[union-attr]
    numbers = tuple(map(int, re.findall(r"\d+", brackets)))
    axes = OPTIONS["axes"].check(axes)
    if format_.axes is None and (axes or direction is not None):
        what = f"--axes {axes}" if axes else "--direction is given"
        raise OptionError(f"{what}, but {format_.name} files state their axes: leave it out")
    order = axes or format_.axes or "xyz"
    try:
        with warnings.catch_warnings(), ExitStack() as files:
            warnings.simplefilter("ignore")
            files.callback(logging.disable, logging.root.manager.disable)
            logging.disable(logging.CRITICAL)  # what matters is raised
            readers = import_module(f".readers.{format_.module}", __package__)
            request = Request(file, member or None, numbers, order, files, max_memory)
            yield getattr(readers, f"read_{format_.key}")(request), request
    except SuperSdfError as error:
        if str(file) in error.flagged.split(": ")[0]:  # not only in the way out
            raise
        raise type(error)(f"{path}: {error.flagged}") from None
    except MemoryError:
        raise OutOfMemoryError(f"{path} does not fit in memory: save it as .npy") from None
    except Exception as error:  # the libraries raise all kinds of errors
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        reason = lines[-1][:200] if lines else type(error).__name__
        if re.match("mmap length|EOF: reading (magic|array header)", reason):  # NumPy's words
            reason = f"it is cut off: it has only {file.stat().st_size:,} bytes"
        raise FileError(f"{path} cannot be read as {format_.name}: {reason}") from error


def _taken(volume: Volume, request: Request, given: dict[str, Any]) -> dict[str, Any]:
    """Return values (nx, ny, nz), place and hint of a volume, for ``make_grid``."""
    check_kind(volume.dtype, volume.shape)
    order, backwards, place = find_placement(volume, given)
    place["hint"] = volume.hint
    if volume.is_mapped and order == (0, 1, 2) and not backwards:
        return {"values": volume.read(), **place}
    request.check_fits(volume.shape, volume.dtype)
    values = np.flip(volume.read().transpose(order), backwards)
    return {"values": np.ascontiguousarray(values, values.dtype.newbyteorder("=")), **place}


def grid_from_image(
    image: Any,
    scalars: str | None = None,
    *,
    max_memory: int | None = None,
    **values: Unpack[Values],
) -> SdfGrid:
    """Make a grid from VTK image data, equal to ``read_grid`` of the saved ``.vti`` file.

    Parameters
    ----------
    image : vtkImageData
        Or a subclass, such as ``pyvista.ImageData``, with spacing, origin, extent and direction.
    scalars : str, optional
        The name of a point array, or, if there is none, of a cell array, with samples at the
        centres of the cells. Default: the active scalars of the points, else of the cells, else the
        only array.
    max_memory, inside, field, label, level, scale, unknown
        As in ``read_grid``.

    Raises
    ------
    FileError, GridError, OptionError
        If there is no such array, or no usable grid; if ``image`` is not image data.
    """
    Options(**values)  # checks them
    from .readers.vtk import NAME, volume_of_image

    request = Request(Path(NAME), scalars, (), "zyx", ExitStack(), max_memory)
    volume = volume_of_image(image, request)
    return make_grid(**_taken(volume, request, {}), **values)


def describe_grid_file(path: str | Path, *, is_each: bool = False) -> dict[str, Any]:
    """Return format, shape (x, y, z), type and place of the array in a grid file.

    Of several arrays, ``grids`` are these facts of each, or an ``error`` (so with ``is_each``). No
    sample is read where the format allows it. What the file does not state is None or missing.
    Raises as ``read_grid``.
    """
    about = {"file": str(PATH.check(path, "path")), "format": find_format(path).name}
    try:
        with open_volume(Path(path)) as (volume, _):
            order, _, place = find_placement(volume, {})
    except SuperSdfError as error:
        if not (is_each or error.names):
            raise
        if is_each:
            return about | {"error": error.flagged}
        paths = [f"{split_member(path)[0]}:{name}" for name in error.names]
        return about | {"grids": [describe_grid_file(each, is_each=True) for each in paths]}
    shape = [volume.shape[axis] for axis in order]
    facts = {k: None if at is None else np.ravel(at).tolist() for k, at in place.items()}
    if facts["direction"] in (None, np.eye(3).ravel().tolist()):
        del facts["direction"]
    return {
        **about,
        "shape": shape,
        "dtype": str(volume.dtype),
        "bytes": prod(shape) * volume.dtype.itemsize,
        "axes in the file": "".join("xyz"[order.index(axis)] for axis in range(3)),
        **facts,
        **({"space": volume.space} if volume.space else {}),
        "labels": [f"{n} {name}" for n, (name, _) in volume.names.items()],
        "notes": list(volume.notes),
    }


def check_grid_target(path: str | Path, *, force: bool = False) -> Path:
    """Return the path if a grid file can be written there; called before the work starts."""
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise OptionError(f"{path} is not a grid file with spacing and origin: give .npz")
    return check_free(path, force=force)


def write_grid(grid: SdfGrid, path: str | Path, *, force: bool = False) -> None:
    """Write a grid as ``.npz``: values, spacing, origin and, if it is turned, direction."""
    arrays: dict[str, Any] = {"spacing": grid.spacing, "origin": grid.origin}
    if not grid.is_straight:
        arrays["direction"] = grid.direction
    with replacing(Path(path), force=force) as part, part.open("wb") as file:
        np.savez(file, values=grid.values, **arrays)
