"""Supervised processes: any may die, at any moment, and the work is done or named."""

import multiprocessing
import multiprocessing.connection
import os
import signal
import time
from collections import deque

import pytest
from planted import run_beside_planted_files

from super_sdf.errors import SuperSdfError
from super_sdf.machine import serving
from super_sdf.machine.pool import Death, Pool, PoolOptions, describe_exit
from super_sdf.machine.serving import ClockStarted

KILLED = Death("was killed by SIGKILL (most likely out of memory)")


def square():
    """Return what answers tasks: a number by its square, a word by a death of that kind."""
    return answer


def answer(task, tell):
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


def count_up():
    """Return what tells all numbers below its task."""
    return count


def count(task, tell):
    """Tell the numbers with the clock started at 1; stay at 3 for ever."""
    for number in range(task):
        if number == 1:
            tell(ClockStarted())
        tell((number, os.getpid()))
        time.sleep(60 if number == 3 else 0)
    return "done"


def die():
    """End before anything is ready."""
    os.kill(os.getpid(), signal.SIGTERM)


def refuse():
    """Say why no process can work."""
    raise SuperSdfError("no network")


def blunder():
    """Show a bug."""
    return [][0]


def work(tasks, prepare, workers=2, **options):
    """Return what came of the tasks."""
    return dict(Pool(deque(tasks), prepare, PoolOptions(**options)).results(workers))


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


def test_partial_results_arrive_in_order_before_the_final_one():
    results = [result for _, result in Pool(deque([3]), count_up).results(1)]
    numbers = [result[0] for result in results if type(result) is tuple]
    assert numbers == [0, 1, 2] and results[1] == ClockStarted() and results[-1] == "done"


def test_a_task_over_its_limit_is_ended_and_the_next_one_goes_on():
    pool = Pool(deque([5, 3, 2]), count_up, PoolOptions(time_limit={5: 0.3}.get))
    results = list(pool.results(1))
    ends = {task: result for task, result in results if type(result) is not tuple}
    assert ends == {5: Death("over the limit of 0.3 s", is_late=True), 3: "done", 2: "done"}
    assert [result[0] for task, result in results if task == 5 and type(result) is tuple] == [
        *range(4)
    ]


@pytest.mark.parametrize(("is_reused", "processes"), [(True, 1), (False, 3)])
def test_a_task_may_have_a_process_of_its_own(is_reused, processes):
    pool = Pool(deque([1, 1, 1]), count_up, PoolOptions(is_reused=is_reused))
    told = [result for _, result in pool.results(1) if type(result) is tuple]
    assert len({pid for _, pid in told}) == processes


def test_processes_end_with_the_iteration():
    pool = Pool(deque([5, 5]), count_up)
    results = pool.results(2)
    (_, (_, pid)) = next(results)
    processes = [worker.process for worker in pool.workers.values()]
    assert pid in [process.pid for process in processes]
    results.close()
    assert not any(process.is_alive() for process in processes) and not pool.workers


def test_without_room_for_a_process_that_is_said(monkeypatch):
    def refuse_files(self):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(Pool, "_start_worker", refuse_files)
    with pytest.raises(SuperSdfError, match="no process can be started: Too many open files: try"):
        work([1], square)


def test_an_end_has_a_name():
    assert describe_exit(3) == "ended with exit code 3"
    assert describe_exit(-signal.SIGTERM) == "was killed by SIGTERM"
    assert describe_exit(-63) == "was killed by signal 63"
    assert describe_exit(0xC0000005) == "crashed (0xc0000005)"  # Windows: access violation


def test_on_windows_signals_are_not_blocked(monkeypatch):
    """There neither masks nor SIGHUP exist."""
    heard = []
    monkeypatch.delattr(signal, "pthread_sigmask")
    monkeypatch.delattr(signal, "SIGHUP")
    monkeypatch.setattr(signal, "signal", lambda *arguments: heard.append(arguments))
    assert serving.ending_signals() == {signal.SIGINT, signal.SIGTERM}
    serving.settle_signals()
    assert heard == [(signal.SIGINT, signal.SIG_IGN)]
    assert work([2], square, 1) == {2: 4}


@pytest.mark.parametrize(
    ("flag", "method"), [("-I", "spawn"), (serving.SAFE_PATH, "spawn"), ("-I", "forkserver")]
)
def test_no_process_runs_files_of_the_current_folder(tmp_path, flag, method):
    """Python 3.10 has no other flag than -I, which must not keep workers from ``PYTHONPATH``."""
    code = f"""
if __name__ == "__main__":
    from multiprocessing import get_context
    import test_pool
    test_pool.serving.SAFE_PATH = {flag!r}
    print(test_pool.work([2, 3], test_pool.square, start_method=get_context({method!r})))
"""
    done, ran = run_beside_planted_files(tmp_path, code)
    assert (done.stdout, done.stderr, ran) == ("{2: 4, 3: 9}\n", "", [])
