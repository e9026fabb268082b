"""Batches and tiles on a cluster: the bytes of a batch without one, whatever ends."""

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest
import trimesh
from batches import CONSTANT, FAST, PLAIN, rows
from distributed import Client
from processes import PATIENCE, all_end, larger_grids, start_command, wait_for_lines, wait_until

from super_sdf import __version__
from super_sdf.batch import cluster
from super_sdf.batch.cluster import completed, connect
from super_sdf.batch.work import Death

pytestmark = pytest.mark.usefixtures("grid_folder")
LOCAL = ("--cluster", "local")
QUICK = (*FAST, "--factor", 2, "--spacing", 1, "--origin", 0)


def start(*words, path=None):
    """Start a process of Dask; ``path`` is searched for modules before anything else."""
    found = [str(path)] if path else []
    found += [os.path.abspath(folder) for folder in sys.path if folder]
    return subprocess.Popen(
        [sys.executable, "-m", "dask", *map(str, words)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(found)},
    )


def end(process):
    """Kill a process and those that it started."""
    for member in (*psutil.Process(process.pid).children(recursive=True), process):
        member.kill()
    process.wait()


@pytest.fixture
def scheduler(tmp_path_factory):
    """Run a scheduler; return its address, its file and its process."""
    file = tmp_path_factory.mktemp("scheduler") / "scheduler.json"
    words = ("--host", "127.0.0.1", "--port", 0, "--scheduler-file", file, "--no-dashboard")
    process = start("scheduler", *words)
    assert wait_until(lambda: file.exists() and file.read_text().endswith("}"))
    yield json.loads(file.read_text())["address"], file, process
    if process.poll() is None:
        end(process)


@pytest.fixture
def start_worker(tmp_path_factory, scheduler):
    """Return what starts a worker of the scheduler; it ends with the test."""
    started = []

    def go(path=None):
        words = ["worker", scheduler[0], "--nthreads", 1, "--no-dashboard", "--host", "127.0.0.1"]
        words += ["--local-directory", tmp_path_factory.mktemp("worker")]
        started.append(start(*words, path=path))
        with Client(scheduler[0], timeout=PATIENCE, set_as_default=False) as client:
            client.wait_for_workers(len(started), timeout=PATIENCE)
        return started[-1]

    yield go
    for process in started:
        end(process)


def meshes(folder):
    """Return the content of all meshes in a folder."""
    return {p.relative_to(folder): p.read_bytes() for p in Path(folder).rglob("[!.]*.ply")}


def test_a_batch_on_a_cluster_of_this_machine_writes_what_one_without_it_writes(command):
    command("batch", "in", "--out", "plain", *PLAIN, *FAST)
    code, _, err = command("batch", "in", "--out", "out", *QUICK, *LOCAL, "--jobs", 1)
    assert code == 1 and err.splitlines()[0] == f"Failed: in/bad.npy: {CONSTANT}"
    assert meshes("out") == meshes("plain") and len(meshes("out")) == 3
    assert not [p for p in psutil.Process().children(True) if "spawn_main" in str(p.cmdline())]
    code, _, err = command("batch", "in", "--out", "out", *QUICK, *LOCAL)
    assert code == 1 and "3 done before, 1 failed before" in err


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_batch_that_is_ended_or_killed_leaves_no_workers(number):
    larger_grids(9)
    process = start_command("batch", "in", "--out", "out", *QUICK, *LOCAL, "--jobs", 2)
    wait_for_lines(process, Path("out/report.jsonl"))
    workers = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(number)
    process.communicate(timeout=PATIENCE)
    assert len(workers) >= 2 and all_end(workers)


def test_workers_at_an_address_write_the_same_bytes_until_the_scheduler_is_lost(
    command, scheduler, start_worker
):
    worker, (address, file, process) = start_worker(), scheduler
    code, _, err = command("batch", "in", "--out", "out", *QUICK, "--cluster", file)
    assert code == 1 and ", 1 failed" in err
    command("batch", "in", "--out", "plain", *PLAIN, *FAST)
    assert meshes("out") == meshes("plain") and worker.poll() is None  # it stays for others
    larger_grids(9)
    batch = start_command("batch", "in", "--out", "out", *QUICK, "--cluster", address)
    wait_for_lines(batch, Path("out/report.jsonl"), 6)
    end(process)
    _, err = batch.communicate(timeout=PATIENCE)
    assert batch.returncode == 1 and err.strip().startswith("Error: the Dask scheduler")
    assert err.strip().count("\n") == 0 and 4 < len(rows()) < 13
    code, _, err = command("batch", "in", "--out", "out", *FAST, *PLAIN)
    assert code == 1 and len(rows()) == 13 and len(meshes("out")) == 12


def test_no_worker_and_one_with_another_version_are_named(
    command, scheduler, start_worker, tmp_path, monkeypatch
):
    monkeypatch.setattr(cluster, "FIRST_WORKER_SECONDS", 0.1)
    words = ("batch", "in", "--out", "out", *QUICK, "--cluster", scheduler[0])
    want = f"the Dask scheduler at {scheduler[0]} has no workers: start some with "
    assert command(*words) == (1, "", f"Error: {want}'dask worker {scheduler[0]}'\n")
    Path("other/super_sdf").mkdir(parents=True)
    Path("other/super_sdf/__init__.py").write_text('__version__ = "0.0.1"\n')
    start_worker(tmp_path / "other")
    code, _, err = command(*words)
    assert code == 1 and err.startswith("Error: worker tcp://127.0.0.1:") and err.count("\n") == 1
    assert f" has another super-sdf (0.0.1) than here ({__version__}): install the same" in err


def test_an_address_where_nobody_listens_is_named(command, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        for address in (f"tcp://127.0.0.1:{silent.getsockname()[1]}", "nothing://here"):
            code, _, err = command("batch", "in", "--out", "out", "--cluster", address)
            assert code == 1 and err.startswith(f"Error: no Dask scheduler answers at {address}")
            assert err.count("\n") == 1


def double(task, memory):
    """Double a number; the worker dies at 3, and 4 is a bug."""
    if task == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    if task == 4:
        raise OSError("four")
    return 2 * task


def test_a_task_that_kills_workers_is_the_only_one_that_fails():
    """The others are done by the worker that takes the place of the only one."""
    tasks = list(range(8))
    with connect("local", 1) as client:
        results = dict(completed(client, lambda: tasks.pop(0) if tasks else None, double))
        cause = "was lost 2 times by the cluster (most likely out of memory)"
        assert results.pop(3) == Death(cause)
        assert results.pop(4) == Death("ended with OSError: four")
        assert results == {task: 2 * task for task in (0, 1, 2, 5, 6, 7)}


def test_one_grid_in_tiles_on_a_cluster_is_that_of_one_machine(command):
    x, y, z = np.indices((64, 64, 64)) - 31.5
    np.save("torus.npy", (np.hypot(np.hypot(x, y) - 18, z) - 7).astype(np.float32))
    words = ("upsample", "torus.npy", "a.off", "--spacing", 1, "--factor", 2, *FAST)
    assert command(*words)[0] == 0
    code, out, _ = command(*words, "--force", *LOCAL, "--jobs", 1, "--json")
    tiles, one = json.loads(out), trimesh.load("a.off", process=False)
    assert code == 0 and tiles["closed"] and tiles["tiles"] > 1
    assert len(one.faces) == tiles["triangles"] and one.is_watertight
