"""Supervised processes: any may die, at any moment, and the work is done or named."""

import os
import signal
from collections import deque

import pytest

from super_sdf.errors import SuperSdfError
from super_sdf.machine import pool as pools
from super_sdf.machine.pool import Death, Pool, describe_end
from super_sdf.machine.records import append_line, append_shared_line, parse_line


def square():
    """Return what answers tasks: a number by its square, a name by a death of that kind."""
    return answer


def answer(task):
    """Answer, or die."""
    if task == "while it works":
        os.kill(os.getpid(), signal.SIGKILL)
    return task * task


def die():
    """End before anything is ready."""
    os.kill(os.getpid(), signal.SIGTERM)


def refuse():
    """Say why no process can work."""
    raise SuperSdfError("no network")


def blunder():
    """Show a bug."""
    return [][0]


def work(tasks, prepare, count=2):
    """Return what came of the tasks, and at which a process had to be cleaned up after."""
    cleaned = []
    pool = Pool(deque(tasks), prepare, lambda task, pid: cleaned.append(task))
    return dict(pool.results(count)), cleaned


def test_a_death_is_the_answer_of_its_task_alone():
    done, cleaned = work([1, "while it works", 2, 3], square)
    death = Death("died of SIGKILL (for want of memory, mostly)")
    assert done == {1: 1, 2: 4, 3: 9, "while it works": death}
    assert cleaned == ["while it works"]


@pytest.mark.parametrize(
    ("prepare", "text"),
    [
        (die, "5 processes in a row ended before they were ready, the last died of SIGTERM: try"),
        (refuse, "^no network$"),
        (blunder, "^IndexError: list index out of range$"),
    ],
)
def test_where_no_process_gets_ready_that_is_said(prepare, text):
    with pytest.raises(SuperSdfError, match=text):
        work([1, 2], prepare, 1)


def test_a_process_killed_before_it_is_ready_is_replaced(monkeypatch):
    start, victims = Pool._start, []

    def kill_the_first(self):
        start(self)
        if not victims:
            victims.append(list(self.workers.values())[-1].process)
            victims[0].kill()

    monkeypatch.setattr(Pool, "_start", kill_the_first)
    assert work([2, 3], square, 1)[0] == {2: 4, 3: 9} and victims[0].exitcode == -signal.SIGKILL


def test_half_an_answer_is_a_death():
    pool = Pool(deque([5]), square, lambda task, pid: None)
    results = pool.results(1)
    receive = pools.Connection.recv

    def cut(pipe):
        if next(iter(pool.workers.values())).ready:
            raise OSError("got end of file during message")
        return receive(pipe)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pools.Connection, "recv", cut)
        ((task, said),) = results
    assert task == 5 and isinstance(said, Death)


def test_without_room_for_a_process_that_is_said(monkeypatch):
    def refuse_files(self):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(Pool, "_start", refuse_files)
    with pytest.raises(SuperSdfError, match="no process can be started: Too many open files: try"):
        work([1], square)


def test_an_end_has_a_name():
    assert describe_end(3) == "ended with exit code 3"
    assert describe_end(-signal.SIGTERM) == "died of SIGTERM"
    assert describe_end(-63) == "died of signal 63"


def test_lines_are_appended_whole_or_not_at_all(tmp_path):
    path = tmp_path / "lines"
    append_line(path, {"a": 1})
    append_shared_line(path, "b")
    assert path.read_bytes() == b'{"a": 1}\n\n"b"\n'
    with pytest.raises(OSError, match="No space left on device"):
        append_line(Full(path), [2])
    assert path.read_bytes() == b'{"a": 1}\n\n"b"\n'
    assert [parse_line(line) for line in (b"[1]", b"[", 10**5 * b"[", b"\xff")] == [
        [1],
        *3 * [None],
    ]


class Full:
    """A path to a file that takes three bytes more, and then no more."""

    def __init__(self, path):
        self.path, self.room = path, 3

    def open(self, mode, buffering):
        """Open it, with this for its write."""
        self.file = self.path.open(mode, buffering=buffering)
        return self

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.file.close()

    def __getattr__(self, name):
        return getattr(self.file, name)

    def write(self, data):
        """Take what there is room for."""
        if not self.room:
            raise OSError(28, "No space left on device")
        self.room = 0
        return self.file.write(bytes(data[:3]))
