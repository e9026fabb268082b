"""Whether functions run compiled: by numba (extra ``fast``), with the same results bit for bit.

To load numba takes half a second, so small grids do without unless it is there already. What is
compiled is kept on disk beside ``compiled.py``, or in the user's cache, for other processes.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from threading import Thread
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])

MODULE = "super_sdf.compiled"
# Decoded voxels from which compiled code saves more than loading it takes.
WORTH = 100_000
# Set to 0, compiled code is not used; set to 1, always where numba is installed.
SWITCH = "SUPER_SDF_COMPILED"


def use_compiled(voxels: int) -> bool:
    """Load the compiled functions if that is worth it for so many decoded voxels; say whether."""
    asked = os.environ.get(SWITCH)
    worth = voxels >= WORTH or "numba" in sys.modules or asked == "1"
    if asked != "0" and worth and MODULE not in sys.modules and find_spec("numba") is not None:
        # Its first call takes a quarter of a second: let that pass while the network runs.
        Thread(target=import_module(MODULE).wake).start()
    return is_loaded()


def is_loaded() -> bool:
    """Say whether compiled functions are in use."""
    return MODULE in sys.modules and os.environ.get(SWITCH) != "0"


def compiled_twin(function: Function) -> Function:
    """Return the compiled function of the same name, if such are in use, else the function."""
    if not is_loaded():
        return function
    twin: Function = getattr(sys.modules[MODULE], function.__name__.lstrip("_"))
    return twin
