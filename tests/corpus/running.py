"""Run a command line in this process, as a terminal would see it, within a time limit."""

from __future__ import annotations

import os
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .terminal import Terminal

LIMIT = 20.0  # seconds, on a machine that does nothing else; few of these inputs take one
# Python shows these to nobody who does not ask.
HIDDEN = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)


class HangError(BaseException):
    """The command did not end in time."""


@dataclass(frozen=True)
class Run:
    """How a command ended.

    Attributes
    ----------
    code : int
        The exit code; negative if a signal ended the process.
    out, err : str
        What stood on the terminal, what compiled code wrote there too.
    trace : str
        Where an exception came out of the program, its type and text; empty if none did.
    warned : tuple of str
        Warnings that Python would have shown.
    grown : int
        Bytes that the process took more at its height than before.
    """

    code: int
    out: str
    err: str
    trace: str = ""
    warned: tuple[str, ...] = ()
    seconds: float = 0.0
    grown: int = 0


def limit() -> float:
    """Return the seconds that a command may take while others want the cores too."""
    return LIMIT * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


_terminals: list[Terminal] = []


def run_here(words: Sequence[str], folder: Path) -> Run:
    """Run the command line in a folder, in this process; only in its main thread."""
    from super_sdf.cli import main as cli

    if not _terminals:
        _terminals.append(Terminal())
    terminal, start, code, trace = _terminals[0], time.perf_counter(), 0, ""
    before = _begin_memory()
    with (
        warnings.catch_warnings(record=True) as caught,
        terminal.taken(),
        _called(words, folder),
        time_limit(limit()),
    ):
        warnings.simplefilter("always")
        try:
            cli.main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        except BaseException as error:  # whatever comes out is what is looked for
            code, trace = 1, describe(error)
    out, err = terminal.read()
    warned = tuple(_say(entry) for entry in caught if not issubclass(entry.category, HIDDEN))
    spent = time.perf_counter() - start
    return Run(code, out, err, trace, warned, spent, _peak_memory() - before)


@contextmanager
def _called(words: Sequence[str], folder: Path) -> Iterator[None]:
    """Be called with these words in this folder."""
    before, home = sys.argv, os.getcwd()
    sys.argv = ["super-sdf", *words]
    os.chdir(folder)
    try:
        yield
    finally:
        sys.argv = before
        os.chdir(home)


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise HangError after so long."""

    def ring(*_: Any) -> None:
        raise HangError

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def describe(error: BaseException) -> str:
    """Return where an exception came from, the last of our own lines first, and what it says."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if f"{os.sep}super_sdf{os.sep}" in frame.filename]
    places = []
    for frame in [ours[-1] if ours else frames[-1], frames[-1]]:
        path = Path(frame.filename)
        places.append(f"{path.parent.name}/{path.name}:{frame.name}")
    text = str(error).splitlines()[0][:200] if str(error) else ""
    return f"{' < '.join(dict.fromkeys(places))}: {type(error).__name__}: {text}"


def _say(entry: warnings.WarningMessage) -> str:
    path = Path(entry.filename)
    first = str(entry.message).splitlines()[0] if str(entry.message) else ""
    return f"{path.parent.name}/{path.name}:{entry.lineno}: {entry.category.__name__}: {first}"


def _begin_memory() -> int:
    """Set the high-water mark back, where the system can, and return what is held now."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS")


def _peak_memory() -> int:
    return _status("VmHWM")


def _status(key: str) -> int:
    """Return a line of the process's status in bytes; 0 where the system keeps none."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(f"{key}:"):
                return int(line.split()[1]) * 1024
    return 0
