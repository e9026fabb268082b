"""Runs tasks: those of each shape in a process of their own.

So a shape that crashes, or runs out of memory or time, harms no other.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from threading import Timer
from typing import Any

from .measuring import Task, measure_task, reason_of
from .rows import Rows
from .shapes import Setting, Shape

OnTask = Callable[[int, int, str], None]
"""Called after each task: (tasks done, tasks in all, name of the task)."""

ROOT = str(Path(__file__).parents[1])
WORKER = ("-m", "lab.runner")
LONGEST = 1e6  # seconds, of a task without a limit
MARK, READ, UNREADABLE, ROW = "lab: ", "read", "unreadable", "row"


@dataclass(frozen=True)
class LeftOut:
    """A shape that could not be measured, or not everywhere, and why."""

    shape: str
    reason: str


def complete(
    tasks: Sequence[Task], rows: Rows, jobs: int, on_task: OnTask | None = None
) -> list[LeftOut]:
    """Measure what the rows lack and keep it there; return the shapes that could not be read.

    The tasks of a shape follow one another in a process.
    """
    of_shape: dict[Any, list[Task]] = {}
    for task in tasks:
        left = tuple(m for m in task.methods if not rows.is_final(task.key(m), task.limit))
        if left and task.limit:  # which is for this task alone, and all that is in it
            of_shape[task] = [task]
        elif left:
            group = of_shape.setdefault((task.path, task.turned), [])
            group.append(replace(task, methods=left))
    left_out: list[LeftOut] = []
    with ThreadPoolExecutor(max(jobs, 1)) as pool:
        run = run_apart if jobs else run_here
        futures = {pool.submit(run, group, rows): group for group in of_shape.values()}
        try:
            for done, future in enumerate(as_completed(futures), 1):
                first, reason = futures[future][0], future.result()
                left_out += [LeftOut(first.path.stem, reason)] if reason else []
                if on_task:
                    on_task(done, len(futures), first.path.stem)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return left_out


def run_here(tasks: Sequence[Task], rows: Rows) -> str | None:
    """Measure tasks of a shape in this process; return why it cannot be read, if so."""
    try:
        shape = Shape.read(tasks[0].path, tasks[0].turned)
    except Exception as problem:  # the other shapes still count
        return reason_of(problem)
    for task in tasks:
        for method, figures in measure_task(task, shape):
            rows.add(task.key(method), figures)
    return None


def run_apart(tasks: Sequence[Task], rows: Rows) -> str | None:
    """Measure tasks of a shape in processes; return why it cannot be read, if so.

    When a process dies, the method that was under way has failed, and another one goes on with the
    methods after it. At a time limit, all that are left fail.
    """
    left = [(number, method) for number, task in enumerate(tasks) for method in task.methods]
    while left:
        wanted = [(n, tuple(m for k, m in left if k == n)) for n, _ in dict.fromkeys(left)]
        parts = {n: replace(tasks[n], methods=methods) for n, methods in wanted}
        ended = run_process(parts, rows)
        if not ended.has_read:
            return ended.reason
        left = [one for one in left if one not in ended.done]
        failed = left if ended.is_late else left[:1]
        for number, method in failed:
            limit = {"limit": tasks[number].limit} if ended.is_late else {}
            rows.add(tasks[number].key(method), {"error": ended.reason, **limit})
        left = left[len(failed) :]
    return None


@dataclass
class Ended:
    """How a process ended: what it had done, and the reason if not all."""

    has_read: bool = False
    is_late: bool = False
    reason: str = "its process ended"
    done: set[tuple[int, str]] = field(default_factory=set)


def run_process(tasks: Mapping[int, Task], rows: Rows) -> Ended:
    """Run a process that measures tasks of a shape, by number, and keep its rows."""
    limit = next(iter(tasks.values())).limit
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [ROOT, *sys.path]))}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    process = subprocess.Popen([sys.executable, *WORKER], env=environment, **pipes)
    ended = Ended()

    def end() -> None:
        ended.is_late = ended.has_read = True
        process.kill()

    clock = Timer(limit or LONGEST, end)
    clock.daemon = True
    clock.start()
    try:
        with suppress(BrokenPipeError):
            messages = {n: {**asdict(task), "path": str(task.path)} for n, task in tasks.items()}
            process.stdin.write(json.dumps(messages))
            process.stdin.close()
        for line in process.stdout:
            take(line, tasks, rows, ended)
        code = process.wait()
    finally:
        clock.cancel()
        process.kill()
    if ended.is_late:
        ended.reason = f"over the limit of {limit:g} s"
    elif code:
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
        ended.reason = f"{'' if ended.has_read else 'while it was read '}its process {how}"
    return ended


def take(line: str, tasks: Mapping[int, Task], rows: Rows, ended: Ended) -> None:
    """Take a line that a process printed; what libraries print is no line of it."""
    if not line.startswith(MARK):
        return
    what, number, method, figures = json.loads(line[len(MARK) :])
    if what == UNREADABLE:
        ended.reason = figures
    elif what == READ:
        ended.has_read = True
    else:
        rows.add(tasks[number].key(method), figures)
        ended.done.add((number, method))


def main() -> None:
    """Measure the tasks on stdin; print what was measured, a line of JSON each."""
    tasks = {}
    for number, task in json.loads(sys.stdin.read()).items():
        task |= {"path": Path(task["path"]), "setting": Setting(**task["setting"])}
        tasks[int(number)] = Task(**{**task, "methods": tuple(task["methods"])})
    first = next(iter(tasks.values()))

    def tell(what: str, number: int = 0, method: str = "", figures: Any = None) -> None:
        print(f"{MARK}{json.dumps([what, number, method, figures])}", flush=True)

    try:
        shape = Shape.read(first.path, first.turned)
    except Exception as problem:  # the other shapes still count
        tell(UNREADABLE, figures=reason_of(problem))
        return
    tell(READ)
    for number, task in tasks.items():
        for method, figures in measure_task(task, shape):
            tell(ROW, number, method, figures)


if __name__ == "__main__":
    main()
