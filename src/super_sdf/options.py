"""What the library is asked, checked before any work: the same for the command line."""

from __future__ import annotations

from math import isfinite
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from .errors import OptionError, OptionTypeError, seen
from .grid.sdf_grid import SdfGrid


def check_grid(grid: Any) -> None:
    """Raise if what should be a grid is an array, say, or a path."""
    if not isinstance(grid, SdfGrid):
        what = f"an array of shape {grid.shape}" if isinstance(grid, np.ndarray) else seen(grid)
        raise OptionTypeError(
            f"grid is {what}: make one with make_grid(values, spacing=...) or read_grid(path)"
        )


def check_path(path: Any, name: str) -> Path:
    """Return a path."""
    if not isinstance(path, (str, PathLike)):
        raise OptionTypeError(f"{name} is {seen(path)}: give the path of a file")
    return Path(path)


def check_threads(threads: Any) -> int:
    """Return a number of threads; 0 is for one a core."""
    if not isinstance(threads, Integral) or isinstance(threads, bool):
        raise OptionTypeError(f"threads is {seen(threads)}: give a whole number, 0 for one a core")
    if int(threads) < 0:
        raise OptionError(f"threads is {threads}: give 1 or more, or 0 for one a core")
    return int(threads)


def check_network(network: Any) -> None:
    """Raise if what should be a network cannot be called."""
    if not callable(network):
        raise OptionTypeError(f"network is {seen(network)}: give one from load_network()")


def check_distance(offset: Any) -> float:
    """Return an offset as a finite number."""
    if not isinstance(offset, Real) or isinstance(offset, bool):
        raise OptionTypeError(f"offset is {seen(offset)}: give a number, in world units")
    if not isfinite(offset):
        raise OptionError(f"offset is {offset}: give a finite number, in world units")
    return float(offset)


def check_cap(cap: Any) -> bool:
    """Return whether to cap."""
    if not isinstance(cap, (bool, np.bool_)):
        raise OptionTypeError(f"cap is {seen(cap)}: give True or False")
    return bool(cap)


def check_max_memory(size: Any) -> int | None:
    """Return how many bytes may be held, None if that is not said."""
    if size is None:
        return None
    if not isinstance(size, Integral) or isinstance(size, bool):
        raise OptionTypeError(f"max_memory is {seen(size)}: give a whole number of bytes")
    if size <= 0:
        raise OptionError(f"max_memory is {size}: give a number of bytes greater than 0")
    return int(size)


def check_progress(progress: Any) -> None:
    """Raise if there is something to be told of progress that cannot be called."""
    if progress is not None and not callable(progress):
        raise OptionTypeError(
            f"progress is {seen(progress)}: give a function of (done, total), in thousandths"
        )
