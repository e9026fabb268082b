"""Supervised processes: any may die, at any moment, and the work is done or named."""

import multiprocessing
import multiprocessing.connection
import os
import signal
from collections import deque

import pytest
from planted import run_beside_planted_files

from super_sdf.errors import SuperSdfError
from super_sdf.batch import pool
from super_sdf.batch.pool import Death, Pool, describe_exit

KILLED = Death("was killed by SIGKILL (most likely out of memory)")


def square():
    """Return what answers tasks: a number by its square, a word by a death of that kind."""
    return answer


def answer(task):
    """Answer, or die."""
    if task == "while it works":
        os.kill(os.getpid(), signal.SIGKILL)
    if task == "while it sends":
        multiprocessing.connection.Connection._send_bytes = send_half
    if task == "in good order":
        os._exit(0)
    if task == "by a bug":
        raise OSError("odd")
    return task * task if isinstance(task, int) else None


def send_half(pipe, message):
    """Die in the middle of a message: its length is announced, and most of it never comes."""
    os.write(pipe.fileno(), b"\0\0\1\0half of a message")
    os.kill(os.getpid(), signal.SIGKILL)


def die():
    """End before anything is ready."""
    os.kill(os.getpid(), signal.SIGTERM)


def refuse():
    """Say why no process can work."""
    raise SuperSdfError("no network")


def blunder():
    """Show a bug."""
    return [][0]


def work(tasks, prepare, workers=2):
    """Return what came of the tasks."""
    return dict(Pool(deque(tasks), prepare).results(workers))


DEATHS = {
    "while it works": KILLED,
    "while it sends": KILLED,
    "in good order": Death("ended with exit code 0"),
    "by a bug": Death("ended with exit code 1"),
}


def test_a_death_is_the_result_of_its_task_alone():
    assert work([1, *DEATHS, 2, 3], square) == {1: 1, 2: 4, 3: 9, **DEATHS}


@pytest.mark.parametrize(
    ("prepare", "text"),
    [
        (die, "5 processes in a row ended before they were ready; the last one was killed by SIGT"),
        (refuse, "^no network$"),
        (blunder, "^IndexError: list index out of range$"),
    ],
)
def test_where_no_process_gets_ready_that_is_said(prepare, text):
    with pytest.raises(SuperSdfError, match=text):
        work([1, 2], prepare, 1)


def test_a_process_killed_before_it_is_ready_is_replaced(monkeypatch):
    start, victims = Pool._start_worker, []

    def kill_the_first(self):
        start(self)
        if not victims:
            victims.append(list(self.workers.values())[-1].process)
            victims[0].kill()

    monkeypatch.setattr(Pool, "_start_worker", kill_the_first)
    assert work([2, 3], square, 1) == {2: 4, 3: 9} and victims[0].exitcode == -signal.SIGKILL


def test_without_room_for_a_process_that_is_said(monkeypatch):
    def refuse_files(self):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(Pool, "_start_worker", refuse_files)
    with pytest.raises(SuperSdfError, match="no process can be started: Too many open files: try"):
        work([1], square)


def test_processes_end_with_the_iteration():
    started = Pool(deque(range(50)), square)
    results = started.results(2)
    next(results)
    processes = [worker.process for worker in started.workers.values()]
    results.close()
    assert processes and not any(process.is_alive() for process in processes)
    assert not started.workers


def test_an_end_has_a_name():
    names = {
        **{3: "ended with exit code 3", -signal.SIGTERM: "was killed by SIGTERM"},
        **{-63: "was killed by signal 63", 0xC0000005: "crashed (0xc0000005)"},  # of Windows
    }
    assert {code: describe_exit(code) for code in names} == names


def test_on_windows_signals_are_not_blocked(monkeypatch):
    """There neither masks nor SIGHUP exist."""
    heard = []
    monkeypatch.delattr(signal, "pthread_sigmask")
    monkeypatch.delattr(signal, "SIGHUP")
    monkeypatch.setattr(signal, "signal", lambda *arguments: heard.append(arguments))
    assert pool.ending_signals() == {signal.SIGINT, signal.SIGTERM}
    pool.settle_signals()
    assert heard == [(signal.SIGINT, signal.SIG_IGN)]
    assert work([2], square, 1) == {2: 4}


@pytest.mark.parametrize("flag", sorted({"-I", pool.SAFE_PATH}))
def test_no_process_runs_files_of_the_current_folder(tmp_path, flag):
    """Python 3.10 has no other flag than -I, which must not keep workers from ``PYTHONPATH``."""
    code = f"""
if __name__ == "__main__":
    import test_pool
    test_pool.pool.SAFE_PATH = {flag!r}
    print(sorted(test_pool.work([2, 3], test_pool.square).items()))
"""
    done, ran = run_beside_planted_files(tmp_path, code)
    assert (done.stdout, done.stderr, ran) == ("[(2, 4), (3, 9)]\n", "", [])
