"""Reading grid files of all formats, and writing ``.npz``. Files are checked before they are read.

``formats`` has the table of all formats, ``readers`` their readers.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import FileError, OptionError, SuperSdfError
from ..grid.placement import STRAIGHT
from ..grid.planes import InputFile
from ..grid.sdf_grid import SdfGrid, make_grid, with_fields
from ..threads import held_memory, memory_bound
from ..options import AxisOrder, Options, Space, Values, check_path
from .formats import GridFormat, check_library, choose_axes, find_format, split_member
from .numpy_files import NUMPY_READERS
from .output import check_free, replacing
from .regular import check_grid_file
from .unpacking import take
from .volume import PLACE, Request, Volume, find_placement, place_in_world

if TYPE_CHECKING:
    from typing_extensions import Unpack

ROOM_SHARE = 0.25  # of what a bound leaves, the share that an unpacked array may take
UNKNOWN_ROOM = 1 << 28  # bytes that an unpacked array may take if the memory left is unknown


def read_grid(
    path: str | Path,
    *,
    spacing: Any = None,
    origin: Any = None,
    direction: Any = None,
    axes: AxisOrder | None = None,
    space: Space | None = None,
    max_memory: int | None = None,
    **values: Unpack[Values],
) -> SdfGrid:
    """Read a grid from a file of any format in ``formats.FORMATS``: see docs/guides/formats.md.

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
    space : {"RAS", "LPS"}, optional
        The anatomical space of the grid's world; for files that state theirs. Default: that one.
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
        files of the format state it; if a space is given, but the file states none.
    """
    Options(space=space, **values)  # checks them
    given = {"spacing": spacing, "origin": origin, "direction": direction}
    arrays = read_array(path, given, axes, space, max_memory)
    notes, space = arrays.pop("notes"), arrays.pop("space")
    return with_fields(make_grid(**arrays, **values).noted(notes), space=space)


def read_array(
    path: Any,
    given: dict[str, Any],
    axes: AxisOrder | None,
    space: Space | None,
    max_memory: int | None,
) -> dict[str, Any]:
    """Return values, place (``PLACE``, unless ``given``), space and notes: see ``read_grid``."""
    path = check_path(path, "path")
    format_ = find_format(path)
    order = choose_axes(format_, axes, given["direction"])
    room, bound = unpacking_room(max_memory), memory_bound(max_memory)
    left = None if bound is None else bound - (held_memory() or 0)
    with open_volume(path, format_, order, (room, left)) as volume:
        volume = volume.in_space(space, str(path))
        if given["direction"] is not None:
            volume = volume.turned(order)
        arrays = take(volume, str(path), room, given, left)
    return arrays | {"notes": volume.notes, "space": volume.space}


@contextmanager
def open_volume(
    path: Path,
    format_: GridFormat,
    axes: str,
    memory: tuple[int, int | None],
    *,
    describes: bool = False,
) -> Iterator[Volume]:
    """Yield the volume in a file; whatever its library raises is an error of one line.

    ``memory`` is how many bytes the unpacked array may take, and the process in all. ``describes``
    says that no sample will be read.
    """
    file, member = split_member(path)
    check_grid_file(path)
    check_library(format_)
    watched = None if file.is_dir() else InputFile.open(file)
    with one_line_errors(path, format_, watched), ExitStack() as files:
        request = Request(file, member, axes, *memory, files, describes)
        if format_.is_apart:
            from .apart import volume_apart  # loads what talks to other processes

            yield files.enter_context(volume_apart(format_.key, request))
        elif format_.key in NUMPY_READERS:
            yield NUMPY_READERS[format_.key](request)
        else:
            from .readers import READERS  # a dozen modules

            yield READERS[format_.key](request)


@contextmanager
def one_line_errors(path: Path, format_: GridFormat, watched: InputFile | None) -> Iterator[None]:
    """Turn whatever a library raises into a FileError of one line, and silence it meanwhile."""
    import logging

    logs = logging.root.manager.disable
    check_unchanged = watched.check_unchanged if watched else lambda: None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            logging.disable(logging.CRITICAL)  # what matters is raised
            yield
    except SuperSdfError as error:
        check_unchanged()  # a change explains whatever else went wrong
        if str(split_member(path)[0]) in str(error):
            raise
        raise type(error)(f"{path}: {error}") from None
    except MemoryError:
        raise
    except Exception as error:  # the libraries raise all kinds of errors
        check_unchanged()
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        reason = lines[-1][:200] if lines else type(error).__name__
        raise FileError(f"{path} cannot be read as {format_.name}: {reason}") from error
    finally:
        logging.disable(logs)
    check_unchanged()


def unpacking_room(max_memory: int | None) -> int:
    """Return how many bytes of memory an unpacked array may take."""
    bound = memory_bound(max_memory)
    if bound is None:
        return UNKNOWN_ROOM
    return int(ROOM_SHARE * max(bound - (held_memory() or 0), 0))


def grid_from_image(
    image: Any,
    scalars: str | None = None,
    *,
    max_memory: int | None = None,
    **values: Unpack[Values],
) -> SdfGrid:
    """Make a grid of VTK image data: the one that ``read_grid`` makes of it as a ``.vti`` file.

    Parameters
    ----------
    image : vtkImageData
        Or a subclass, such as ``pyvista.ImageData``. Its spacing, origin, extent and direction
        place the samples in the world.
    scalars : str, optional
        The name of an array of numbers at its points or, if no array there has that name, in its
        cells; samples in cells are at their centres. Default: the active scalars of the points,
        else of the cells, else the only array.
    inside, field, label, level, scale
        What the values are; see ``make_grid``.
    max_memory : int, optional
        Bytes that this process may hold in all. Default: a share of the free memory.

    Returns
    -------
    SdfGrid
        With a copy of the samples, in a temporary file if they are large.

    Raises
    ------
    GridError
        If there is no such array, or several and none is named; if its values are not a signed
        distance grid.
    OptionError
        If ``inside`` or ``field`` is unknown, or ``image`` is no image data (``OptionTypeError``).
    """
    Options(**values)  # checks them
    from .readers.vtk import NAME, volume_of_image

    volume = volume_of_image(image, scalars)
    arrays = take(volume, NAME, unpacking_room(max_memory), {})
    return make_grid(**arrays, **values)


def describe_grid_file(path: str | Path) -> dict[str, Any]:
    """Return format, shape (x, y, z), type, place and storage of the array in a grid file.

    No sample is read where the format allows it. What the file does not state is None or missing.
    Chunks and shards are in the order of the array's own axes. Raises as ``read_grid``.
    """
    path = check_path(path, "path")
    format_ = find_format(path)
    order = choose_axes(format_, None)
    with open_volume(path, format_, order, (0, None), describes=True) as volume:
        if len(volume.shape) != 3:
            raise FileError(f"its array has shape {volume.shape}: give three axes")
        placement = find_placement(volume, str(path))
        place = place_in_world(volume, placement, {})
    shape = placement.of_world(volume.shape)
    facts: dict[str, Any] = {
        "file": str(path),
        "format": format_.name,
        "shape": list(shape),
        "dtype": str(volume.dtype),
        "bytes": int(np.prod(shape, dtype=object)) * volume.dtype.itemsize,
        "axes in the file": "".join("xyz"[w] for w in placement.world_axes),
        **{key: _listed(place[key]) for key in PLACE},
        **({"space": volume.space} if volume.space else {}),
        **({"chunks": list(volume.chunks)} if volume.chunks else {}),
        **volume.about,
        "notes": list(volume.notes),
    }
    if facts["direction"] in (None, _listed(STRAIGHT)):
        del facts["direction"]
    return facts


def _listed(numbers: Any) -> list[float] | None:
    return None if numbers is None else [float(number) for number in np.ravel(numbers)]


def check_grid_target(path: str | Path, *, force: bool = False) -> Path:
    """Return the path if a grid file can be written there; called before the work starts."""
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise OptionError(f"{path} is not a grid file with spacing and origin: give .npz")
    return check_free(path, force=force)


def write_grid(grid: SdfGrid, path: str | Path, *, force: bool = False) -> None:
    """Write a grid as ``.npz``: values, spacing, origin and, if it is turned, direction."""
    path = check_grid_target(path, force=force)
    arrays: dict[str, Any] = {"spacing": grid.spacing, "origin": grid.origin}
    if not grid.is_straight:
        arrays["direction"] = grid.direction
    with replacing(path, force=force) as part, part.open("wb") as file:
        np.savez(file, values=grid.values, **arrays)
