"""Reading a file in a process of its own, since libraries in C can crash on damaged files.

That process answers questions for boxes of samples until its input ends. It is killed once both
processes hold more memory than they may: only then it is known what some files unpack to.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from subprocess import DEVNULL, PIPE, Popen
from typing import IO, Any

import numpy as np

from ..errors import FileError, OutOfMemoryError, SuperSdfError
from ..threads import held_memory, in_words, memory_bound
from .volume import Request, Volume

STEP = 0.02  # seconds between two looks at the memory
LEAST = 1 << 27  # bytes with which the process and its library can start
FUNCTIONS = ("read", "read_box", "stored")  # fields of a volume that stay in that process
START = "from super_sdf.files import apart; apart.serve()"


@contextmanager
def volume_apart(key: str, request: Request) -> Iterator[Volume]:
    """Yield the volume that the reader of a format returns in a process of its own.

    Raises FileError if that process crashes, OutOfMemoryError if both processes hold too much.
    """
    reader = _Process(request)
    try:
        stated = {name: value for name, value in vars(request).items() if name != "files"}
        yield Volume(**reader.ask((key, stated)), read_box=reader.ask)
    finally:
        reader.close()


class _Process:
    def __init__(self, request: Request) -> None:
        self.path, self.ended, self.limit = request.path, threading.Event(), 0
        self.start = held_memory() or 0
        bound = memory_bound(None)
        self.left = request.left
        if self.left is None and bound is not None:
            self.left = bound - self.start
        command = [sys.executable, "-I", "-c", f"import sys; sys.path[:] = {sys.path!r}; {START}"]
        self.process = Popen(command, stdin=PIPE, stdout=PIPE, stderr=DEVNULL)
        threading.Thread(target=self._watch, daemon=True).start()

    def ask(self, question: Any) -> Any:
        assert self.process.stdin and self.process.stdout
        try:
            pickle.dump(question, self.process.stdin)
            self.process.stdin.flush()
            answer = pickle.load(self.process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError):
            raise self._death() from None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _watch(self) -> None:
        if self.left is None:
            return
        while not self.ended.wait(STEP):
            limit = max(self.left - (held_memory() or 0) + self.start, LEAST)
            if (held_memory(pid=self.process.pid) or 0) > limit:
                self.limit = limit
                self.process.kill()
                return

    def _death(self) -> SuperSdfError:
        code = self.process.wait()
        if self.limit:
            return OutOfMemoryError(
                f"{self.path} unpacks to more than the {in_words(self.limit)} of memory that are "
                "left for it; allow more (--max-memory), or save it as .npy"
            )
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return FileError(
            f"{self.path} cannot be read: the library that reads it crashed ({how}); the file is "
            "probably damaged, save it again"
        )

    def close(self) -> None:
        self.ended.set()
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            with suppress(OSError):  # nobody reads what was not sent
                if pipe:
                    pipe.close()


def serve() -> None:
    """Read the file of the first question, and answer with the boxes of the following ones."""
    from .readers import READERS

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other process handles it
    warnings.simplefilter("ignore")
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # libraries may print
    with ExitStack() as files, suppress(EOFError, BrokenPipeError):
        questions = sys.stdin.buffer
        key, request = pickle.load(questions)
        volume = _answer(
            answers,
            lambda: READERS[key](Request(**request, files=files)),
            lambda volume: {n: v for n, v in vars(volume).items() if n not in FUNCTIONS},
        )
        while volume:
            _answer(answers, partial(volume.box, pickle.load(questions)), np.ascontiguousarray)


def _answer(answers: IO[bytes], make: Callable[[], Any], told: Callable[[Any], Any]) -> Any:
    """Make something, send what is told of it or the error that it met, and return it."""
    made, answer = None, None
    try:
        made = make()
        answer = told(made)
    except SuperSdfError as error:
        answer = error
    except MemoryError as error:
        answer = OutOfMemoryError(f"it does not fit in memory: {error}")
    except Exception as error:  # the libraries raise all kinds of errors, not all can be sent
        answer = RuntimeError(str(error).strip() or type(error).__name__)
    pickle.dump(answer, answers, protocol=5)
    answers.flush()
    return made
