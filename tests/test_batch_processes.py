"""Batches and their processes, killed, ended, short of memory: nothing is lost or left over."""

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import trimesh
from batches import FAST, PLAIN, files, rows
from planted import COMMAND, run_beside_planted_files
from processes import PATIENCE, all_end, larger_grids, start_command, wait_for_lines

from super_sdf.batch import job as batch_job
from super_sdf.batch.inputs import find_jobs
from super_sdf.batch.job import Settings
from super_sdf.batch.run import Queue, Run, choose_workers, useful_workers
from super_sdf.options import Options
from super_sdf.threads import held_memory
from super_sdf.batch.pool import Death, Pool
from super_sdf.threads import Resources, allot_each, count_cores

pytestmark = pytest.mark.usefixtures("grid_folder")
SMALL = (*FAST, "--factor", 2, "--spacing", 1)


def test_an_interrupt_is_one_line_and_keeps_what_is_done(run_batch, monkeypatch):
    right, done = batch_job.convert, []

    def interrupt(*arguments, **options):
        if done:
            raise KeyboardInterrupt
        done.append(right(*arguments, **options))
        return done[0]

    monkeypatch.setattr(batch_job, "convert", interrupt)
    want = "Error: interrupted: 1 of 4 are done and kept; run it again to go on\n"
    assert run_batch("in") == (130, "", want)
    assert len(files()) == 2 and len(rows()) == 1


def test_what_a_killed_batch_left_is_removed_and_nothing_else(run_batch, command):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    Path("out/deep").mkdir(parents=True)
    mesh = Path("out/deep/b.ply")
    command("upsample", "in/deep/b.npz", mesh, *FAST, *PLAIN[2:])  # in place, and has no row yet
    stale, kept = Path(f"out/deep/.b.ply.{ended.pid}.part"), Path(f"out/.x.ply.{ended.pid}.part")
    for path in (stale, kept):
        path.write_text("half")
    Path("out/.super-sdf-batch").write_text('"deep/b.ply"\n"to')
    assert run_batch("in/", "--dry-run")[2].startswith("4 to do") and stale.exists()
    assert run_batch("in")[2].endswith("3 done, 1 failed; 3 meshes closed, 0 open\n")
    assert not stale.exists() and kept.exists()
    assert rows()[-1]["out"] == "deep/b.ply"  # last: it may be what ended the run
    assert Path("out/.super-sdf-batch").read_text() == ""


TWO_CORES = f"from super_sdf.batch import run\n\nrun.count_cores = lambda: 2\n{COMMAND}"


def test_nothing_of_the_current_folder_is_run(tmp_path):
    words = ("batch", "in", "--out", "out", "--jobs", 2, "--quality", "fast", "--factor", 2)
    done, ran = run_beside_planted_files(tmp_path, TWO_CORES, *words)
    assert "3 done, 1 failed" in done.stderr and not ran


def start_batch(*options):
    """Start a batch as a process, and return it when its report has some lines."""
    words = ("batch", "in", "--out", "out", "--jobs", 2, "--threads", 1, *SMALL, *options)
    process = start_command(*words)
    wait_for_lines(process, Path("out/report.jsonl"))
    return process


def test_killed_on_the_way_it_goes_on(command):
    larger_grids(10)
    process = start_batch()
    workers = psutil.Process(process.pid).children()
    assert len(workers) >= 2
    process.kill()
    process.communicate()
    assert all_end(workers)  # no orphans
    for mesh in Path("out").rglob("[!.]*.ply"):
        assert len(trimesh.load(mesh).faces) > 0
    finished = len(rows())
    code, _, err = command("batch", "in", "--out", "out", *SMALL)
    assert code == 1 and f", {finished} done before" in err
    assert len(rows()) == 14 == len({row["out"] for row in rows()})
    assert not list(Path("out").rglob(".*.part"))


def test_as_many_processes_as_cores_and_memory_allow(monkeypatch):
    monkeypatch.setattr("super_sdf.batch.run.count_cores", lambda: 8)
    monkeypatch.setattr("super_sdf.batch.run.free_memory", lambda: 3_500_000_000)
    assert choose_workers("cpu", 100) == 3
    monkeypatch.setattr("super_sdf.batch.run.free_memory", lambda: None)
    assert [choose_workers("cpu", jobs) for jobs in (0, 5, 100)] == [1, 5, 8]
    assert choose_workers("cuda", 100) == 1 and count_cores() >= 1


HOLD = "import sys; from pathlib import Path; from super_sdf.batch.ledger import folder_lock\n"
HOLD += "with folder_lock(Path('out')): print('held', flush=True); sys.stdin.read()"


def test_a_lock_is_exclusive_among_processes_and_ends_with_its_own(run_batch):
    words = [sys.executable, "-c", HOLD]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"held\n"
        want = "Error: out is in use by another batch: wait for it, or give another\n"
        assert run_batch("in/a.npy") == (1, "", want)
        assert run_batch("in/a.npy", "--dry-run")[0] == 0
        holder.kill()
        holder.wait()
        assert run_batch("in/a.npy")[0] == 0


@pytest.mark.parametrize(
    ("error", "want"),
    [(errno.ENOLCK, ""), (errno.EACCES, "Error: out cannot be written: Permission denied\n")],
)
def test_without_locks_of_its_file_system_a_batch_runs_other_errors_are_named(
    run_batch, monkeypatch, error, want
):
    def refuse(self, *_, **__):
        raise OSError(error, os.strerror(error))

    monkeypatch.setattr("super_sdf.batch.ledger.FileLock.acquire", refuse)
    code, _, err = run_batch("in/a.npy")
    assert (code, err if code else "") == (bool(want), want)


@pytest.mark.parametrize(
    ("number", "said", "options"),
    [
        (signal.SIGHUP, "ended by SIGHUP", ()),
        (signal.SIGINT, "interrupted", ("--quiet",)),
        (signal.SIGTERM, "ended by SIGTERM", ("--json",)),
    ],
)
def test_a_signal_ends_batch_and_workers_in_a_line(number, said, options):
    larger_grids(10)
    process = start_batch(*options)
    workers = psutil.Process(process.pid).children()
    process.send_signal(number)
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + number
    facts = json.loads(out) if "--json" in options else {}
    assert not facts or err == f"Error: {facts['error']}\n"
    assert not facts or facts["done"] + facts["failed"] == len(rows()) > 0
    assert err.startswith(f"Error: {said}: ") and err.count("\n") == 1
    assert err.endswith("of 14 are done and kept; run it again to go on\n")
    assert all_end(workers) and not list(Path("out").rglob(".*.part"))


def test_a_file_at_which_two_processes_die_is_named(command, monkeypatch):
    seen = []

    def deaths(self, count):
        while len(self.tasks):
            seen.append(job := self.tasks.popleft())
            made = {"content": None, "output": None, "closed": True, "inferred": [], "warnings": []}
            row = {**batch_job.failed_row(job, None), **made, "status": "ok", "retry": False}
            yield job, Death("was killed by SIGKILL") if job.source.name == "a.npy" else row

    monkeypatch.setattr(Pool, "results", deaths)
    monkeypatch.setattr("super_sdf.batch.run.count_cores", lambda: 2)
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    Path("out").mkdir()
    (part := Path(f"out/.a.ply.{ended.pid}.part")).write_text("half")
    code, _, err = command("batch", "in", "--out", "out", "--quality", "fast", "--jobs", 2)
    assert not part.exists()
    reason = "the process that converted it was killed by SIGKILL, twice"
    assert code == 1 and err.startswith(f"Failed: in/a.npy: {reason}\n3 done, 1 failed")
    assert [job.source.name for job in seen].count("a.npy") == 2
    assert seen[-1].source.name == "a.npy"  # the others first
    assert {job.options.max_memory for job in seen} != {None}


def test_fail_fast_begins_nothing_more_in_several_processes():
    Path("out").mkdir()
    settings = Settings(Path("out"), fail_fast=True)
    run = Run(find_jobs(["in"], ".ply", Options()).jobs, settings)
    queue = Queue(run)
    assert len(queue) == 4
    first = queue.popleft()
    run._take(first, batch_job.failed_row(first, "why"))
    assert len(queue) == 0 and len(run.batch.waiting) == 3


def test_the_bound_is_shared_by_those_that_run(monkeypatch):
    monkeypatch.setattr("super_sdf.threads.memory_bound", lambda asked: asked)
    monkeypatch.setattr("super_sdf.threads.held_memory", lambda: 10**8)
    assert allot_each(3, 1, 10**9) == Resources(1, 3 * 10**8)
    Path("out").mkdir()
    run = Run(find_jobs(["in"], ".ply", Options()).jobs, Settings(Path("out")))
    queue = Queue(run, 3 * 10**8)
    assert [queue.popleft().options.max_memory for _ in range(4)] == 4 * [3 * 10**8]


def test_no_more_processes_than_are_of_use(monkeypatch):
    monkeypatch.setattr("super_sdf.batch.run.count_cores", lambda: 4)
    assert useful_workers(4, 10) == (4, None)
    assert useful_workers(8, 2) == (2, "--jobs 8 is cut to 2: there is no more to do")
    note = "--jobs 200 is cut to 4: this process may use no more cores"
    assert useful_workers(200, 10, 10**10) == (4, note)
    note = "--jobs 3 is cut to 2: --max-memory has no room for more"
    assert useful_workers(3, 10, 700_000_000) == (2, note)
    assert choose_workers("cpu", 10, 700_000_000) == 1


def test_many_jobs_of_two_files_share_a_small_bound(command):
    larger_grids(2)
    arguments = "batch", "in/more0.npy", "in/more1.npy", "--out", "out", "--quality", "fast"
    bound = held_memory() + 600_000_000  # the tests before may have left much in this process
    code, _, err = command(*arguments, "--jobs", 8, "--max-memory", bound)
    assert code == 0 and err.startswith("Note: --jobs 8 is cut to ")
    assert {row["slabs"] for row in rows()} == {1}
