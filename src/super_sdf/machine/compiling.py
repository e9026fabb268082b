"""Whether functions run compiled: by numba (extra ``fast``), with the same results bit for bit.

To load numba takes half a second, so small grids do without unless it is there already. What is
compiled is kept on disk beside ``compiled.py``, or in the user's cache, for other processes. Where
numba does not work, or has nowhere to keep that, NumPy does the work, and ``why_not`` says why.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import wraps
from importlib import import_module
from importlib.util import find_spec
from pickle import UnpicklingError
from threading import Event, Lock, Thread
from types import ModuleType
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])

MODULE = "super_sdf.compiled.functions"
# Decoded voxels from which compiled code saves more than loading it takes.
WORTH = 100_000
# Set to 0, compiled code is not used; set to 1, always where numba is installed.
SWITCH = "SUPER_SDF_COMPILED"
# What a call raises before it begins if compiled code cannot be kept on disk or read from there.
STORAGE_FAULTS = (OSError, EOFError, UnpicklingError)


class Compiled:
    """The compiled functions of this process: loaded once, whichever thread comes first."""

    def __init__(self) -> None:
        self.module: ModuleType | None = None
        self.fault = ""
        self.must_compile = False
        self.lock = Lock()
        self.awake = Event()

    def load(self) -> None:
        """Load them, unless that was tried before; other threads wait for it."""
        with self.lock:
            if self.module or self.fault or not is_installed():
                return
            try:
                self.module = import_module(MODULE)
            except Exception as error:  # numba does not fit NumPy, LLVM is missing, no cache ...
                self.give_up(error)
                return
            self.must_compile = not self.module.is_on_disk()  # before the first call writes it
            # The first call takes a quarter of a second: let that pass while the network runs.
            Thread(target=self.wake, args=(self.module,)).start()

    def wake(self, module: ModuleType) -> None:
        """Call something compiled, so that the next call is quick."""
        try:
            module.wake()
        except Exception as error:  # nothing runs compiled here, whatever the reason
            self.give_up(error)
        finally:
            self.awake.set()

    def give_up(self, error: Exception) -> None:
        """Use NumPy from now on, and keep in a line why."""
        reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
        self.fault = (
            f"numba is installed but cannot be used, and NumPy takes longer ({reason}); mend it, "
            f"or set {SWITCH}=0"
        )
        self.module = None


_compiled = Compiled()


def is_installed() -> bool:
    """Say whether numba is there, which does not mean that it works."""
    try:
        return find_spec("numba") is not None
    except ValueError:  # something that calls itself numba, and is no module from a file
        return False


def use_compiled(voxels: int) -> bool:
    """Load the compiled functions if that is worth it for so many decoded voxels; say whether."""
    asked = os.environ.get(SWITCH)
    if asked != "0" and (voxels >= WORTH or "numba" in sys.modules or asked == "1"):
        _compiled.load()
    return is_loaded()


def is_loaded() -> bool:
    """Say whether compiled functions are in use."""
    return _compiled.module is not None and os.environ.get(SWITCH) != "0"


def must_compile() -> bool:
    """Say whether the functions in use have to be compiled first, which takes memory of its own."""
    return is_loaded() and _compiled.must_compile


def why_not() -> tuple[str, ...]:
    """Return a sentence on why numba is not used though it is installed; none if all is well."""
    return (_compiled.fault,) * bool(_compiled.fault)


def try_compiled() -> str:
    """Load the compiled functions and call one; return why that fails, "" if it does not."""
    _compiled.load()
    if _compiled.module:
        _compiled.awake.wait()
    return _compiled.fault


def compiled_twin(function: Function) -> Function:
    """Return the compiled function of the same name, if such are in use, else the function."""
    if not is_loaded():
        return function
    _compiled.awake.wait()
    module = _compiled.module
    if module is None:
        return function
    twin: Function = getattr(module, function.__name__.lstrip("_"))

    @wraps(function)
    def run(*arguments: Any) -> Any:
        try:
            return twin(*arguments)
        except STORAGE_FAULTS as error:
            _compiled.give_up(error)
            return function(*arguments)

    return run  # type: ignore[return-value]
