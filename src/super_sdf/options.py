"""Checks of arguments before any work starts; the command line uses the same ones."""

from __future__ import annotations

from math import isfinite
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from .errors import OptionError, OptionTypeError, seen
from .grid.sdf_grid import SdfGrid
from .mesh import Mesh


def check_grid(grid: Any) -> None:
    """Raise OptionTypeError if ``grid`` is not an ``SdfGrid``, but an array or a path, say."""
    if not isinstance(grid, SdfGrid):
        what = f"an array of shape {grid.shape}" if isinstance(grid, np.ndarray) else seen(grid)
        raise OptionTypeError(
            f"grid is {what}: make one with make_grid(values, spacing=...) or read_grid(path)"
        )


def check_path(path: Any, name: str) -> Path:
    """Return an argument as a path; ``name`` is its name in the message.

    Raises
    ------
    OptionTypeError
        If it is neither a string nor a path.
    """
    if not isinstance(path, (str, PathLike)):
        raise OptionTypeError(f"{name} is {seen(path)}: give the path of a file")
    return Path(path)


def check_threads(threads: Any) -> int:
    """Return a number of threads; 0 means one per core.

    Raises
    ------
    OptionError
        If it is negative, or not a whole number (``OptionTypeError``).
    """
    if not isinstance(threads, Integral) or isinstance(threads, bool):
        raise OptionTypeError(
            f"threads is {seen(threads)}: give a whole number, 0 for one per core"
        )
    if int(threads) < 0:
        raise OptionError(f"threads is {threads}: give 1 or more, or 0 for one per core")
    return int(threads)


def check_network(network: Any) -> None:
    """Raise OptionTypeError if ``network`` cannot be called."""
    if not callable(network):
        raise OptionTypeError(f"network is {seen(network)}: give one from load_network()")


def check_distance(offset: Any) -> float:
    """Return an offset, in world units, as a float.

    Raises
    ------
    OptionError
        If it is not finite, or not a number (``OptionTypeError``).
    """
    if not isinstance(offset, Real) or isinstance(offset, bool):
        raise OptionTypeError(f"offset is {seen(offset)}: give a number, in world units")
    if not isfinite(offset):
        raise OptionError(f"offset is {offset}: give a finite number, in world units")
    return float(offset)


def check_cap(cap: Any) -> bool:
    """Return ``cap`` as a bool, or raise OptionTypeError if it is not one."""
    if not isinstance(cap, (bool, np.bool_)):
        raise OptionTypeError(f"cap is {seen(cap)}: give True or False")
    return bool(cap)


def _check_whole(number: Any, name: str) -> int:
    """Return a whole number; OptionTypeError if it is none."""
    if not isinstance(number, Integral) or isinstance(number, bool):
        raise OptionTypeError(f"{name} is {seen(number)}: give a whole number")
    return int(number)


def check_max_memory(size: Any) -> int | None:
    """Return a memory limit in bytes; None means a share of the free memory.

    Raises
    ------
    OptionError
        If it is not positive, or not a whole number (``OptionTypeError``).
    """
    if size is None:
        return None
    if not isinstance(size, Integral) or isinstance(size, bool):
        raise OptionTypeError(f"max_memory is {seen(size)}: give a whole number of bytes")
    if size <= 0:
        raise OptionError(f"max_memory is {size}: give a number of bytes greater than 0")
    return int(size)


def check_progress(progress: Any) -> None:
    """Raise OptionTypeError if ``progress`` is neither None nor callable."""
    if progress is not None and not callable(progress):
        raise OptionTypeError(
            f"progress is {seen(progress)}: give a function of (done, total), in thousandths"
        )


def check_mesh(mesh: Any) -> None:
    """Raise OptionTypeError if ``mesh`` is not a ``Mesh``."""
    if not isinstance(mesh, Mesh):
        raise OptionTypeError(f"mesh is {seen(mesh)}: give one from reconstruct(grid)")


def check_goal(
    error: Any, triangles: Any, names: tuple[str, str] = ("error", "triangles")
) -> tuple[float | None, int | None]:
    """Return to what a mesh is simplified: within an error, or to a number of triangles.

    ``names`` are those of the arguments in messages.

    Raises
    ------
    OptionError
        If not exactly one of them is given, or it is not positive, or not a number
        (``OptionTypeError``).
    """
    if error is None and triangles is None:
        raise OptionError("give {} or {}".format(*names))
    if error is not None and triangles is not None:
        raise OptionError(
            f"{names[0]} {seen(error)} and {names[1]} {seen(triangles)}: give only one of them"
        )
    if triangles is not None:
        return None, check_triangles(triangles, names[1])
    return check_error(error, names[0]), None


def check_error(error: Any, name: str = "error") -> float:
    """Return the largest distance of a simplified mesh; ``name`` is its name in messages.

    Raises
    ------
    OptionError
        If it is not positive and finite, or not a number (``OptionTypeError``).
    """
    if not isinstance(error, Real) or isinstance(error, bool):
        raise OptionTypeError(f"{name} is {seen(error)}: give a number greater than 0")
    if not (isfinite(error) and float(error) > 0):
        raise OptionError(f"{name} is {error}: give a number greater than 0")
    return float(error)


def check_triangles(triangles: Any, name: str = "triangles") -> int:
    """Return the most triangles of a simplified mesh; ``name`` is the argument's in messages.

    Raises
    ------
    OptionError
        If it is less than 4, or not a whole number (``OptionTypeError``).
    """
    number = _check_whole(triangles, name)
    if number < 4:
        raise OptionError(f"{name} is {number}: give 4 or more, as a closed mesh has")
    return number
