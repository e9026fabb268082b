"""Run command lines in a child that may hang, crash or want all memory; another takes its place."""

from __future__ import annotations

import faulthandler
import multiprocessing
import resource
import tempfile
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from super_sdf.network.onnx import ort

from .running import Run, limit, run_here

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
        """End the process, start another, and say what became of it."""
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
