"""The work of a batch: one file converted, and worker processes, of which any may die."""

from __future__ import annotations

import json
import multiprocessing.resource_tracker
import os
import signal
import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, TypeVar

from ..convert import Conversion, convert
from ..errors import FileError, GridError, OptionError, WriteError, in_a_line
from ..files.output import naming
from ..labels.files import Names, convert_labels
from ..network.network import load_network
from ..options import Options
from .inputs import Job
from .record import Row, fingerprint

Task = TypeVar("Task")
EXIT_SECONDS = 10.0  # that a broken process may take to end
SPAWN = multiprocessing.get_context("spawn")  # forking harms the threads of onnxruntime
sigmask: Any = getattr(signal, "pthread_sigmask", lambda *_: None)  # Windows has none
load_once = lru_cache(maxsize=1)(load_network)


@dataclass(frozen=True)
class Settings:
    """How a batch is run."""

    folder: Path  # of the outputs
    options: Options  # those that lists cannot replace count: network, device, threads, memory
    workers: int = 0
    force: bool = False  # convert everything again; replace files that are not as a batch made them
    retry: bool = False  # try inputs again that failed before
    check: bool = False  # against the samples; meshes without a certificate are made again
    items: Path | None = None  # the folder for what a page shows of each mesh
    cluster: str | None = None  # "local", or the address of a scheduler: where files are converted
    names: Names | None = None  # of labels


def convert_job(
    job: Job, settings: Settings, stage: Path, threads: int = 0, memory: int | None = None
) -> Row:
    """Convert a file to meshes in the folder ``stage``; an error is a row, too."""
    start, content = time.perf_counter(), fingerprint(job.source)
    bounds = [bound for bound in (memory, job.options.max_memory) if bound]
    options, target = replace(job.options, max_memory=min(bounds, default=None)), stage / job.mesh
    network = load_once(**{**settings.options.network(), "threads": threads})
    row = job.failed("", content)
    try:
        with naming(settings.folder / job.mesh):
            target.parent.mkdir(parents=True, exist_ok=True)
        made: Any
        if options.labels is None:
            made, names = convert(job.source, target, network, options, force=True), [job.mesh]
        else:
            where = job.source, target, network, options
            made = convert_labels(*where, names=settings.names, force=True)
            for label in made.facts["labels"]:
                label["output"] = Path(label["output"]).relative_to(stage).as_posix()
            names = [label["output"] for label in made.facts["labels"]]
        known = {name: fingerprint(stage / name) for name in names}
        row |= {"output": known if job.has_label_files else known[job.mesh], **made.facts}
        row["stages"] = {name: round(seconds, 4) for name, seconds in made.seconds.items()}
        if settings.check or settings.items:
            row["check"] = _check(job, settings, made, row["output"]["sha256"])
        row |= {"status": "ok", "reason": None, "retry": False}
    except Exception as error:  # a bug that one file shows must not cost the others
        by_input = isinstance(error, (GridError, OptionError, FileError))
        retry = not by_input or isinstance(error, WriteError)
        row = job.failed(in_a_line(error), content) | {"retry": retry}
    row |= {"precision": network.precision, "seconds": round(time.perf_counter() - start, 4)}
    # sentences may name files, which will be in the output folder
    staged, final = (json.dumps(str(path))[1:-1] for path in (stage, settings.folder))
    return dict(json.loads(json.dumps(row).replace(staged, final)))


def _check(job: Job, settings: Settings, made: Conversion, sha256: str) -> Row:
    """Return the certificate of a mesh, or why there is none; keep what a page shows of it."""
    from ..check import check_mesh
    from ..pages.items import item_of, keep_item
    from ..truth import merged

    try:
        if settings.items is None:
            return check_mesh(merged(made.mesh), made.grid, job.options).report()
        item = item_of(made, job.options)
        keep_item(item, settings.items, job.target, sha256)
        return item.certificate or {}
    except Exception as error:  # the mesh is good all the same
        return {"error": in_a_line(error)}


class Death(str):
    """The result of a task whose worker died: a verb, such as "was killed by SIGKILL"."""


class Worker:
    """A process that gets one task at a time: so the task of one that dies is known."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        self.pipe, its_end = SPAWN.Pipe()
        self.process = SPAWN.Process(target=_serve, args=(its_end, work), daemon=True)
        self.process.start()
        its_end.close()

    def end(self, seconds: float = 0.0) -> Death:
        """Kill the process if it does not end by itself in time; return how it ended."""
        self.process.join(seconds)
        self.process.kill()
        self.process.join()
        if (code := self.process.exitcode or 0) >= 0:
            return Death(f"ended with exit code {code}")
        hint = " (most likely out of memory)" * (code == -9)
        return Death(f"was killed by {signal.Signals(-code).name}{hint}")


def _serve(pipe: Connection, work: Callable[[Any], Any]) -> None:
    """Work at the tasks from a pipe, and end with the parent: an orphan would go on."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    parent: Any = multiprocessing.parent_process()
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()
    while True:
        task = pipe.recv()
        try:
            pipe.send((work(task), None))
        except Exception as error:
            pipe.send((None, error))


def work_in_processes(
    take: Callable[[], Task | None], work: Callable[[Task], Any], count: int
) -> Generator[tuple[Task, Any], None, None]:
    """Yield tasks with their results, or a Death, as ``count`` processes complete them.

    ``take`` returns the next task, None while there is none. What ``work`` raises is raised here.
    """
    idle, running = list[Worker](), dict[Any, tuple[Worker, Task]]()

    def start() -> None:
        sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # of this thread: the process inherits it
        idle.append(Worker(work))

    os.environ.setdefault("PYTHONSAFEPATH", "1")  # processes import nothing from the current folder
    if os.name == "posix":
        multiprocessing.resource_tracker.ensure_running()  # later it would unblock SIGINT
    try:
        while True:
            while len(running) < count and (task := take()) is not None:
                if not idle:
                    with ThreadPoolExecutor(1) as thread:  # where no signal interrupts the start
                        thread.submit(start).result()
                running[idle[-1].pipe] = idle[-1], task
                worker = idle.pop()
                with suppress(OSError):  # if it has died, there is no answer, either
                    worker.pipe.send(task)
            if not running:
                return
            for pipe in wait(list(running)):
                worker, task = running.pop(pipe)
                try:
                    result, error = worker.pipe.recv()
                    idle.append(worker)
                except (EOFError, OSError):
                    result, error = worker.end(EXIT_SECONDS), None
                if error:
                    raise error
                yield task, result
    finally:
        for worker in (*idle, *(worker for worker, _ in running.values())):
            worker.end()
