"""Run a command line as a terminal would see it: here, or in a child that may hang or crash."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from super_sdf.network.onnx import ort


class Terminal:
    """Files in place of standard output and error, for compiled code and children too.

    One for the life of the process: what it starts may keep them.
    """

    def __init__(self) -> None:
        # Appending, so that others who hold them go on at the end after they were emptied.
        self.folder = tempfile.TemporaryDirectory(prefix="corpus-terminal-")
        paths = [Path(self.folder.name, name) for name in ("out", "err")]
        self.files = [path.open("a+b", buffering=0) for path in paths]

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Let standard output and error go to the files."""
        before, streams = [os.dup(1), os.dup(2)], (sys.stdout, sys.stderr)
        for number, file in enumerate(self.files, 1):
            file.truncate(0)
            os.dup2(file.fileno(), number)
        errors = ("strict", "backslashreplace")
        sys.stdout, sys.stderr = (
            open(number, "w", encoding="utf-8", errors=error, closefd=False)  # noqa: SIM115
            for number, error in enumerate(errors, 1)
        )
        try:
            yield
        finally:
            with suppress(OSError, ValueError):
                sys.stdout.flush()
                sys.stderr.flush()
            sys.stdout, sys.stderr = streams
            for number, kept in enumerate(before, 1):
                os.dup2(kept, number)
                os.close(kept)

    def read(self) -> tuple[str, str]:
        """Return what was written to each."""
        texts = []
        for file in self.files:
            file.seek(0)
            texts.append(file.read().decode("utf-8", "replace"))
        return texts[0], texts[1]


LIMIT = 20.0  # seconds, on a machine that does nothing else; few of these inputs take one
# Python shows these to nobody who does not ask.
HIDDEN = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)


class HangError(BaseException):
    """The command did not end in time."""


class Run(NamedTuple):
    """How a command ended."""

    code: int  # below 0 if a signal ended the process
    out: str  # what stood on the terminal, what compiled code wrote there too
    err: str
    trace: str = ""  # where an exception came out of the program, its type and text
    warned: tuple[str, ...] = ()  # that Python would have shown
    grown: int = 0  # bytes that the process took more at its height than before


def limit() -> float:
    """Return the seconds that a command may take while others want the cores too."""
    return LIMIT * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


_terminals: list[Terminal] = []


def run_here(words: Sequence[str], folder: Path) -> Run:
    """Run the command line in a folder, in this process; only in its main thread."""
    from super_sdf.cli import main as cli

    if not _terminals:
        _terminals.append(Terminal())
    terminal, code, trace = _terminals[0], 0, ""
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
    warned = tuple(
        f"{entry.filename}:{entry.lineno}: {entry.message}"
        for entry in caught
        if not issubclass(entry.category, HIDDEN)
    )
    return Run(code, out, err, trace, warned, _status("VmHWM") - before)


@contextmanager
def _called(words: Sequence[str], folder: Path) -> Iterator[None]:
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
    ends = [*ours[-1:], frames[-1]]
    places = [f"{Path(each.filename).name}:{each.name}" for each in ends]
    text = str(error).splitlines()[0][:200] if str(error) else ""
    return f"{' < '.join(dict.fromkeys(places))}: {type(error).__name__}: {text}"


def _begin_memory() -> int:
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS")


def _status(key: str) -> int:
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(f"{key}:"):
                return int(line.split()[1]) * 1024
    return 0


MEMORY = 8 << 30  # bytes of address space: most of it is libraries and never used
FILE = 1 << 30  # bytes of a file
GRACE = 15.0  # seconds over the limit, for what an alarm does not wake


class Child:
    """A process that runs one command line after another, each as if it were the first."""

    def __init__(self) -> None:
        self.crash_log = tempfile.NamedTemporaryFile(prefix="corpus-crash-")  # noqa: SIM115
        self.start()

    def start(self) -> None:
        """Start the process."""
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=serve, args=(theirs, self.crash_log.name))
        self.process.start()
        theirs.close()

    def run(self, words: Sequence[str], folder: Path) -> Run:
        """Run a command line in a folder."""
        try:
            self.pipe.send((tuple(words), folder))
            if self.pipe.poll(limit() + GRACE):
                found: Run = self.pipe.recv()
                return found
            return self._replace("hangs where no alarm wakes it")
        except (EOFError, OSError):
            return self._replace("crash")

    def _replace(self, what: str) -> Run:
        self.process.join(1.0)
        self.process.kill()
        self.process.join()
        code = self.process.exitcode or 1
        log = Path(self.crash_log.name).read_text(errors="replace")
        places = [line.strip() for line in log.splitlines() if line.startswith("  File")]
        ours = [line for line in places if "super_sdf" in line] or places or [""]
        self.pipe.close()
        self.start()
        return Run(code, "", "", f"{what}: {ours[0]}")

    def stop(self) -> None:
        """End the process."""
        self.pipe.close()
        self.process.join(5.0)
        self.process.kill()


def serve(pipe: Connection, crash_log: str) -> None:
    """Run what comes by the pipe, until it is closed."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE, FILE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with open(crash_log, "w") as log:
        faulthandler.enable(log)
        ort.InferenceSession = kept_sessions()
        while True:
            try:
                words, folder = pipe.recv()
            except EOFError:
                return
            log.truncate(0)
            pipe.send(run_here(words, folder))


def kept_sessions() -> Callable[..., Any]:
    """Return what opens an ONNX file, and each shipped one only once, for one thread.

    Threads that wait for each other's cores cost more than such small grids.
    """
    from super_sdf.network.network import shipped_models

    shipped = {str(path) for path in shipped_models().values()}
    load, kept = ort.InferenceSession, {}

    def open_once(path: Any, options: Any, **others: Any) -> Any:
        if str(path) not in shipped:
            return load(path, options, **others)
        if path not in kept:
            options.intra_op_num_threads = 1
            kept[path] = load(path, options, **others)
        return kept[path]

    return open_once
