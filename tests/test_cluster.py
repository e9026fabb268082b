"""Batches on a cluster: the bytes of a batch without one, whatever ends, and what is missing."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import deque
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from batches import CONSTANT, FAST, PLAIN, rows
from distributed import Client
from planted import COMMAND, run_beside_planted_files
from processes import PATIENCE, all_end, larger_grids, start_command, wait_for_lines, wait_until

from super_sdf import __version__
from super_sdf.cluster import checking, connecting
from super_sdf.cluster import crew as crew_module
from super_sdf.cluster.checking import Expected, Needs, check_some, check_workers, share_of
from super_sdf.cluster.connecting import connect
from super_sdf.cluster.crew import Crew
from super_sdf.errors import ClusterError
from super_sdf.machine.pool import Death
from super_sdf.machine.resources import Resources
from super_sdf.network.network import Fingerprint

pytestmark = pytest.mark.usefixtures("grid_folder")
LOCAL = ("--cluster", "local")
QUICK = (*FAST, "--factor", 2, "--spacing", 1, "--origin", 0)
DASK = {"DASK_DISTRIBUTED__SCHEDULER__HTTP__ROUTES": "[]", "OMP_NUM_THREADS": "1"}


def start(*words, path=None):
    """Start a process of Dask; ``path`` is searched for modules before anything else."""
    found = [str(path)] if path else []
    found += [os.path.abspath(folder) for folder in sys.path if folder]
    return subprocess.Popen(
        [sys.executable, "-m", "dask", *map(str, words)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | DASK | {"PYTHONPATH": os.pathsep.join(found)},
    )


def end(process):
    """Kill a process and those that it started."""
    family = [*psutil.Process(process.pid).children(recursive=True), process]
    for member in family:
        member.kill()
    process.wait()


@pytest.fixture
def scheduler(tmp_path_factory):
    """Run a scheduler; return its address and its process."""
    file = tmp_path_factory.mktemp("scheduler") / "scheduler.json"
    words = ("--host", "127.0.0.1", "--port", 0, "--scheduler-file", file, "--no-dashboard")
    process = start("scheduler", *words)
    assert wait_until(lambda: file.exists() and file.read_text().endswith("}"))
    yield json.loads(file.read_text())["address"], process
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


def outcomes(folder):
    """Return the rows of a report without what another run changes."""
    changing = {"seconds", "stages", "output", "content", "planned_bytes"}
    found = [{k: v for k, v in row.items() if k not in changing} for row in rows(folder)]
    return sorted(found, key=lambda row: row["out"])


def test_nothing_of_the_current_folder_is_run(tmp_path):
    words = ("batch", "in", "--out", "out", *LOCAL, "--jobs", 1, *QUICK)
    done, ran = run_beside_planted_files(tmp_path, COMMAND, *words)
    assert "3 done, 1 failed" in done.stderr and not ran


def start_batch(*options, out="out", lines=2):
    """Start a batch as a process, and return it when its report has some lines."""
    process = start_command("batch", "in", "--out", out, *QUICK, *options)
    wait_for_lines(process, Path(out, "report.jsonl"), lines)
    return process


def workers_of(process):
    """Return the worker processes below a process."""
    below = psutil.Process(process.pid).children(recursive=True)
    return [child for child in below if "spawn_main" in " ".join(child.cmdline())]


def test_a_batch_on_a_cluster_of_this_machine_writes_what_one_without_it_writes(
    command, monkeypatch
):
    monkeypatch.setattr("super_sdf.batch.run.count_cores", lambda: 2)
    environment = dict(os.environ)
    code, _, said = command("batch", "in", "--out", "plain", *PLAIN, *FAST)
    assert code == 1 and len(meshes("plain")) == 3
    code, _, err = command("batch", "in", "--out", "out", *QUICK, *LOCAL, "--jobs", 2)
    assert code == 1 and err.splitlines()[0] == f"Failed: in/bad.npy: {CONSTANT}"
    assert err.split(";")[:2] == said.replace("plain/", "out/").split(";")[:2]
    assert meshes("out") == meshes("plain")
    assert outcomes("out") == outcomes("plain")
    assert not workers_of(psutil.Process())
    changed = dict(set(os.environ.items()) ^ set(environment.items()))
    assert changed.keys() <= {"PYTHONHASHSEED", "__DASK_PARENT_PID"}  # nothing that matters
    code, _, err = command("batch", "in", "--out", "out", *QUICK, *LOCAL)
    assert code == 1 and "nothing to do: 3 done before" in err


def test_a_signal_ends_batch_and_workers_in_a_line():
    larger_grids(9)
    process = start_batch(*LOCAL, "--jobs", 2)
    workers = workers_of(process)
    assert len(workers) >= 2
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + signal.SIGTERM
    assert err.startswith("Error: ended by SIGTERM: ") and err.count("\n") == 1
    assert err.endswith("of 13 are done and kept; run it again to go on\n")
    assert all_end(workers) and not list(Path("out").rglob(".*.part"))


def test_a_killed_batch_leaves_no_workers(monkeypatch, tmp_path):
    larger_grids(9)
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # where it leaves the workers' folder
    process = start_batch(*LOCAL, "--jobs", 2)
    workers = workers_of(process)
    process.kill()
    process.communicate()
    assert all_end(workers)


def test_workers_at_an_address_write_the_same_bytes(command, scheduler, start_worker):
    worker = start_worker()
    code, _, err = command("batch", "in", "--out", "out", *QUICK, "--cluster", scheduler[0])
    assert code == 1 and ", 1 failed; 3 meshes closed" in err
    command("batch", "in", "--out", "plain", *PLAIN, *FAST)
    assert meshes("out") == meshes("plain") and len(meshes("out")) == 3
    assert worker.poll() is None  # it stays for others


def test_a_lost_scheduler_is_a_line_and_what_is_done_stays(command, scheduler, start_worker):
    larger_grids(9)
    start_worker()
    address, process = scheduler
    batch = start_batch("--cluster", address)
    end(process)
    _, err = batch.communicate(timeout=PATIENCE)
    want = f"Error: the connection to the Dask scheduler at {address} was lost: "
    assert batch.returncode == 1 and err == f"{want}run it again when the scheduler is back\n"
    finished = len(rows())
    assert finished < 13
    code, _, err = command("batch", "in", "--out", "out", *FAST, *PLAIN)
    assert code == 1 and len(rows()) == 13 and len(meshes("out")) == 12


def test_a_worker_with_another_version_is_named(command, scheduler, start_worker, tmp_path):
    Path("other/super_sdf").mkdir(parents=True)
    Path("other/super_sdf/__init__.py").write_text('__version__ = "0.0.1"\n')
    start_worker(tmp_path / "other")
    code, _, err = command("batch", "in", "--out", "out", *QUICK, "--cluster", scheduler[0])
    fault = f"has super-sdf 0.0.1, and here is {__version__}: install the same version there and"
    assert code == 1 and err.startswith("Error: worker tcp://127.0.0.1:")
    assert err.endswith(f" {fault} here\n") and err.count("\n") == 1
    assert not meshes("out")


def test_a_scheduler_without_workers_is_named(command, scheduler, monkeypatch):
    monkeypatch.setattr(connecting, "FIRST_WORKER_SECONDS", 0.1)
    code, _, err = command("batch", "in", "--out", "out", *QUICK, "--cluster", scheduler[0])
    want = f"the Dask scheduler at {scheduler[0]} has no workers: start some with "
    assert (code, err) == (1, f"Error: {want}'dask worker {scheduler[0]}'\n")


def test_an_address_where_nobody_listens_is_named(command, monkeypatch):
    monkeypatch.setattr(connecting, "CONNECT_SECONDS", 0.3)
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{bound.getsockname()[1]}"
        code, _, err = command("batch", "in", "--out", "out", "--cluster", address)
    want = f"no Dask scheduler answers at {address}: start one with 'dask scheduler' and workers "
    want += "with 'dask worker ADDRESS', or give 'local' or another address"
    assert (code, err) == (1, f"Error: {want}\n")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        code, _, err = command("batch", "in", "--out", "out", "--cluster", address)
    assert code == 1 and err.startswith(f"Error: no Dask scheduler answers at {address}: start one")
    code, _, err = command("batch", "in", "--out", "out", "--cluster", "nothing://here")
    assert code == 1 and err.startswith("Error: no Dask scheduler answers at nothing://here (")


def test_workers_of_this_machine_leave_no_folder_and_open_no_dashboard(monkeypatch, tmp_path):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    with connect("local", workers=1) as cluster:
        scheduler = cluster.client.scheduler_info()
        assert os.listdir(tempfile.tempdir)
        opened = [process["services"] for process in (scheduler, *scheduler["workers"].values())]
    assert opened == [{}, {}] and not os.listdir(tempfile.tempdir)


def test_a_missing_extra_is_named(command, monkeypatch):
    monkeypatch.setattr("super_sdf.machine.extras.find_spec", lambda name: None)
    code, _, err = command("batch", "in", "--out", "out", *LOCAL)
    want = "--cluster needs distributed: pip install -e '.[cluster]' in a clone of super-sdf"
    assert (code, err) == (1, f"Error: {want}\n") and not Path("out").exists()


def test_options_that_do_not_go_together_are_refused(command):
    address = "tcp://10.0.0.1:8786"
    code, _, err = command("batch", "in", "--out", "out", "--cluster", address, "--jobs", 2)
    want = f"--jobs 2 is for workers of this machine: those at {address} are as many as were "
    want += "started there; give only one of --jobs and that --cluster"
    assert (code, err) == (2, f"Error: {want}\n")
    code, _, err = command("batch", "in", "--out", "out", "--cluster", " ")
    want = "--cluster is empty: give local or the address of a Dask scheduler"
    assert (code, err) == (2, f"Error: {want}\n") and not Path("out").exists()


def test_a_dry_run_connects_to_nothing(command):
    code, _, err = command("batch", "in", "--out", "out", "--cluster", "no:1", "--dry-run")
    assert code == 0 and err.startswith("4 to do, ")


def prepare_to_count(limits):
    """Return work that doubles a number; a worker dies at 3, and 4 is a bug."""

    def work(task, check_wanted):
        check_wanted()
        if task == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        if task == 4:
            raise OSError("four")
        return 2 * task, limits.threads

    return work


def test_a_task_that_kills_workers_is_the_only_one_that_fails():
    with (
        connect("local", workers=2, threads=1) as cluster,
        Crew(cluster, Needs("fast"), prepare_to_count, pytest.fail) as crew,
    ):
        results = dict(crew.completed(deque(range(12))))
        assert list(crew.in_order(range(5, 9))) == [(2 * task, 1) for task in range(5, 9)]
        assert results.pop(3) == Death(
            "was lost 2 times by the cluster (most likely out of memory)"
        )
        assert results.pop(4) == Death("ended with OSError: four")
        assert results == {task: (2 * task, 1) for task in range(12) if task not in (3, 4)}


def prepare_to_wait(limits):
    """Return work that takes longer than it takes to look which workers there are."""
    return lambda task, check_wanted: time.sleep(0.12) or os.getpid()


@pytest.mark.parametrize("fault", ["", "is odd"])
def test_a_worker_that_comes_later_is_checked_and_used_or_named(monkeypatch, fault):
    monkeypatch.setattr(crew_module, "LOOK_SECONDS", 0.1)
    tasks, warnings, needs, pids = deque(range(4)), [], Needs("fast"), set()
    with connect("local", workers=2, threads=1) as cluster:
        checked = check_workers(cluster, needs)
        (first, limits), (second, _) = checked.members.items()
        if fault:
            found = replace(checked, members={}, faults={second: fault})
            monkeypatch.setattr(crew_module, "check_some", lambda *_: found)
        known = replace(checked, members={first: limits})
        monkeypatch.setattr(crew_module, "check_workers", lambda *_: known)
        with Crew(cluster, needs, prepare_to_wait, warnings.append) as crew:
            for _, pid in crew.completed(tasks):
                pids.add(pid)
                if not warnings and len(pids) < 2:
                    tasks.append(0)  # until the other was looked at
    assert len(pids) == (1 if fault else 2)
    assert warnings == ([f"worker {second} is odd; it is not used"] if fault else [])


def test_work_goes_on_when_all_workers_were_replaced():
    with (
        connect("local", workers=1, threads=1) as cluster,
        Crew(cluster, Needs("fast"), prepare_to_wait, pytest.fail) as crew,
    ):
        results = crew.in_order(range(3))
        pids = [next(results)]
        os.kill(pids[0], signal.SIGKILL)
        pids += results
        assert len(pids) == 3 and len(set(pids)) == 2


def test_a_cluster_without_workers_is_not_waited_for_long(monkeypatch):
    monkeypatch.setattr(crew_module, "PATIENCE_SECONDS", -1.0)
    with (
        connect("local", workers=1) as cluster,
        Crew(cluster, Needs("fast"), prepare_to_wait, pytest.fail) as crew,
    ):
        monkeypatch.setattr(cluster.client, "nthreads", dict)
        with pytest.raises(ClusterError, match=r"^the cluster local has had no worker for -1 s: "):
            list(crew.completed(deque(range(3))))


def expected(**changes):
    """Return what is here, changed: of the network, the folder, and a file in it."""
    path = Path("in/a.npy").resolve()
    needs = Needs("fast", modules=changes.pop("modules", ()), folder=Path.cwd())
    models, sizes = needs.digests_of_models(), {path: path.stat().st_size}
    return Expected(needs, models, sizes, None, True)._replace(**changes)


FAULTS = {
    "does not see the network x.onnx: put it where all machines see it": {
        "models": {"x.onnx": "0"}
    },
    "has another file of the network base.onnx: copy the one from here": {
        "models": {"base.onnx": "0"}
    },
    "lacks nowhere: install there what is installed here": {"modules": ("nowhere",)},
    "does not see /no/file: put the inputs where all machines see them by this path": {
        "sizes": {Path("/no/file"): 1}
    },
    "sees another /dev/null: its folder has to be the same on all machines": {
        "sizes": {Path("/dev/null"): 7}
    },
    "does not see the output folder /: write to a folder that all machines share under ": {
        "probe": (Path("/no file"), "text")
    },
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_a_worker_lacks_is_said(fault):
    assert checking.what_is_lacking(expected()) == ""
    assert checking.what_is_lacking(expected(**FAULTS[fault])).startswith(fault)


def test_workers_without_the_package_or_with_other_sources_are_named():
    want = f"does not have super-sdf: install version {__version__} of it there"
    assert checking.judge_version(ModuleNotFoundError("No module named 'super_sdf'")) == want
    assert checking.judge_version(__version__) == ""
    want = f"cannot import super-sdf (SyntaxError: no): install {__version__} there"
    assert checking.judge_version(SyntaxError("no")) == want
    want = f"has other sources of super-sdf {__version__} than are here: install the same state "
    assert checking.judge_sources("0") == f"{want}there and restart it"
    assert checking.judge_sources(checking.digest_of_sources()) == ""
    assert checking.first_of(["tcp://a", "tcp://b"]) == "worker tcp://a and 1 other"


def test_other_versions_of_what_computes_are_a_warning():
    here = checking.versions()
    own = checking.Report("", "host", here)
    other = own._replace(versions={**here, "numpy": "numpy 1.26.0"})
    assert checking.warnings_of({"tcp://a": other, "tcp://b": own, "tcp://c": other}) == [
        f"worker tcp://a and 1 other have numpy 1.26.0, and here is {here['numpy']}: results may "
        "differ in their last bits"
    ]


OTHER_PROCESSOR = """
from super_sdf.network.network import Network

exact = Network.__call__
Network.__call__ = lambda *given: exact(*given) * (1 + 2**-20)
"""


def test_workers_that_round_differently_are_refused_and_both_named(
    command, scheduler, start_worker, tmp_path
):
    Path("other").mkdir()
    Path("other/sitecustomize.py").write_text(OTHER_PROCESSOR)
    start_worker(), start_worker(tmp_path / "other")
    with connect(scheduler[0]) as cluster:
        cluster.client.wait_for_workers(2)
        first, second = cluster.workers()
        values = check_some(cluster, Needs("fast"), {first: 1}).values
        late = check_some(cluster, Needs("fast"), {second: 1}, values)
        assert not late.members and f" than worker {first} (" in late.faults[second]
    code, _, err = command("batch", "in", "--out", "out", *QUICK, "--cluster", scheduler[0])
    worker = r"worker tcp://127\.0\.0\.1:\d+ \([^()]*(\(R\)[^()]*)*, int8 on cpu, [0-9a-f]{8}\)"
    assert code == 1 and re.fullmatch(
        f"Error: {worker} gets other values from the network than {worker}, so that meshes would "
        "differ or be torn: use workers with the same kind of processor\n",
        err,
    )
    for differing in (r"tcp://\S+", ", ([0-9a-f]{8})"):
        assert len(set(re.findall(differing, err))) == 2
    assert not meshes("out")


def test_values_that_differ_are_said_with_what_computed_them():
    one = Fingerprint("0123456789", "cpu", "A", "int8")
    others = {"b": one, "c": one._replace(digest="f" * 64, device="cuda", precision="float32")}
    assert checking.differing(("a", one), others) == {
        "c": "(A, float32 on cuda, ffffffff) gets other values from the network than worker a "
        "(A, int8 on cpu, 01234567), so that meshes would differ or be torn: give --device cpu"
    }


def test_a_folder_that_is_not_shared_is_noticed():
    with checking.probing(Path.cwd()) as (path, text):
        assert checking.why_unusable(path, text) == ""
        want = f"does not see the output folder {Path.cwd()}"
        assert checking.why_unusable(path.with_name("other"), text) == want
        assert checking.why_unusable(path, "else") == want
    assert not list(Path.cwd().glob(".super-sdf-probe-*"))


def test_a_worker_plans_with_what_its_machine_and_dask_allow():
    def share(asked, threads, limit, free, neighbours=1):
        report = checking.Report("", "host", {}, limit, free)
        return share_of(asked, threads, report, neighbours)

    assert share(Resources(0), 4, None, None) == Resources(4, None)
    assert share(Resources(0), 1, 10**9, 10**10) == Resources(1, 75 * 10**7)
    assert share(Resources(0), 1, 10**10, 2 * 10**9, 2) == Resources(1, 6 * 10**8)
    assert share(Resources(2, 10**9), 1, 10**10, 1) == Resources(2, 10**9)
    assert share(Resources(2, 10**9), 1, 10**9, None) == Resources(2, 75 * 10**7)
