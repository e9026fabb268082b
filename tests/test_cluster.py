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
from pathlib import Path

import psutil
import pytest
from batches import CONSTANT, FAST, PLAIN, rows
from distributed import Client
from planted import COMMAND, run_beside_planted_files
from processes import PATIENCE, all_end, larger_grids, start_command, wait_for_lines, wait_until

from super_sdf import __version__
from super_sdf.batch.fingerprint import fingerprint
from super_sdf.batch.journal import clear_journal, note_made, read_journal
from super_sdf.cluster import checking, connecting
from super_sdf.cluster import pool as cluster_pool
from super_sdf.cluster.checking import Needs, Question, check_workers
from super_sdf.cluster.connecting import Limits, connect, share_of
from super_sdf.cluster.pool import ClusterPool, ClusterPoolOptions
from super_sdf.errors import ClusterError, DeviceError
from super_sdf.machine.pool import Death
from super_sdf.network.fingerprint import Fingerprint

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


@pytest.mark.parametrize("code", ["", COMMAND])
def test_nothing_of_the_current_folder_is_run(tmp_path, code):
    words = ("batch", "in", "--out", "out", *LOCAL, "--jobs", 1, *QUICK)
    done, ran = run_beside_planted_files(tmp_path, code, *words)
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
    assert Path("out/.super-sdf-batch").read_text() == ""
    assert not workers_of(psutil.Process())
    changed = dict(set(os.environ.items()) ^ set(environment.items()))
    assert changed.keys() <= {"PYTHONHASHSEED", "__DASK_PARENT_PID"}  # nothing that matters
    code, _, err = command("batch", "in", "--out", "out", *QUICK, *LOCAL)
    assert code == 1 and "nothing to do: 3 done before" in err


def test_a_killed_worker_costs_nothing(command):
    larger_grids(30)
    process = start_batch(*LOCAL, "--jobs", 2, "--quiet")
    workers_of(process)[0].kill()
    _, err = process.communicate(timeout=PATIENCE)
    assert err == f"Failed: in/bad.npy: {CONSTANT}\n"
    assert len(rows()) == 34 and not list(Path("out").rglob(".*.part"))
    command("batch", "in", "--out", "plain", *PLAIN, *FAST)
    assert meshes("out") == meshes("plain") and len(meshes("out")) == 33


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT"])
def test_a_signal_ends_batch_and_workers_in_a_line(name):
    larger_grids(40)
    process = start_batch(*LOCAL, "--jobs", 2)
    workers = workers_of(process)
    assert len(workers) >= 2
    process.send_signal(getattr(signal, name))
    _, err = process.communicate(timeout=PATIENCE)
    said = "interrupted" if name == "SIGINT" else f"ended by {name}"
    assert process.returncode == 128 + getattr(signal, name)
    assert err.startswith(f"Error: {said}: ") and err.count("\n") == 1
    assert err.endswith("of 44 are done and kept; run it again to go on\n")
    assert all_end(workers) and not list(Path("out").rglob(".*.part"))


def test_a_killed_batch_leaves_no_workers(monkeypatch, tmp_path):
    larger_grids(40)
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
    larger_grids(30)
    start_worker()
    address, process = scheduler
    batch = start_batch("--cluster", address)
    end(process)
    _, err = batch.communicate(timeout=PATIENCE)
    want = f"Error: the connection to the Dask scheduler at {address} was lost: "
    assert batch.returncode == 1 and err == f"{want}run it again when the scheduler is back\n"
    finished = len(rows())
    assert 2 <= finished < 34
    code, _, err = command("batch", "in", "--out", "out", *FAST, *PLAIN)
    assert code == 1 and len(rows()) == 34 and len(meshes("out")) == 33


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
    monkeypatch.setattr(connecting, "CONNECT_SECONDS", 0.5)
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{bound.getsockname()[1]}"
        code, _, err = command("batch", "in", "--out", "out", "--cluster", address)
    want = f"no Dask scheduler answers at {address}: start one with 'dask scheduler' and workers "
    want += "with 'dask worker ADDRESS', or give 'local' or another address"
    assert (code, err) == (1, f"Error: {want}\n")
    code, _, err = command("batch", "in", "--out", "out", "--cluster", "nothing://here")
    assert code == 1 and err.startswith("Error: no Dask scheduler answers at nothing://here (")


def test_a_peer_that_says_nothing_is_given_up(command, monkeypatch):
    monkeypatch.setattr(connecting, "CONNECT_SECONDS", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        code, _, err = command("batch", "in", "--out", "out", "--cluster", address)
    assert code == 1 and err.startswith(f"Error: no Dask scheduler answers at {address}: start one")


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


def test_a_task_that_kills_workers_is_the_only_one_that_fails(monkeypatch):
    monkeypatch.setattr(cluster_pool, "SHORT_TASK", 60.0)  # so that all are looked ahead at
    tasks, died, cleaned, results = deque(range(12)), [], [], {}
    options = ClusterPoolOptions(
        clean_up=lambda task, pid: cleaned.append(task), is_suspect=lambda task: task in died
    )
    needs, lost = Needs("fast"), Death("was lost by the cluster (most likely out of memory)")
    with connect("local", workers=2, threads=1) as cluster:
        checked = check_workers(cluster, needs)
        running = ClusterPool(cluster, checked, needs, tasks, prepare_to_count, options).results()
        for task, result in running:
            if result == lost and task not in died:
                died.append(task)
                tasks.append(task)
            else:
                results[task] = result
    assert results.pop(3) == lost
    assert results.pop(4) == Death("ended with OSError: four")
    assert results == {task: (2 * task, 1) for task in range(12) if task not in (3, 4)}
    assert cleaned.count(3) == 2 and set(cleaned) == set(died) and len(died) <= 3


def prepare_to_wait(limits):
    """Return work that takes longer than the pool takes to look which workers there are."""

    def work(task, check_wanted):
        time.sleep(1.2 * cluster_pool.LOOK_SECONDS)
        return os.getpid()

    return work


@pytest.mark.parametrize("fault", ["", "is odd"])
def test_a_worker_that_comes_later_is_checked_and_used_or_named(monkeypatch, fault):
    tasks, warnings, needs, pids = deque(range(6)), [], Needs("fast"), set()
    with connect("local", workers=2, threads=1) as cluster:
        checked = check_workers(cluster, needs)
        first, second = checked.members
        if fault:
            found = checked._replace(members=[], faults={second.address: fault})
            monkeypatch.setattr(cluster_pool, "check_some", lambda *_: found)
        known = checked._replace(members=[first])
        options = ClusterPoolOptions(warn=warnings.append)
        pool = ClusterPool(cluster, known, needs, tasks, prepare_to_wait, options)
        for _, pid in pool.results():
            pids.add(pid)
            if not warnings and second.report.pid not in pids:
                tasks.append(0)  # until the other was looked at
    later = set() if fault else {second.report.pid}
    assert pids == {first.report.pid} | later
    assert warnings == ([f"worker {second.address} is odd; it is not used"] if fault else [])


def own_report(**changes):
    """Return a question about this process and its folder, and the report of it, changed."""
    question = Question(Needs("fast", folder=Path.cwd()), (Path("in/a.npy").resolve(),), None, True)
    return question, checking.report_here(question)._replace(**changes)


FAULTS = {
    "models": ({"fast.onnx": "0"}, "does not see the network base-int8.onnx: put it where all"),
    "lacking": (("zarr",), "lacks zarr: install there what is installed here"),
    "sizes": ((None,), "does not see {0}: put the inputs where all machines see them by this path"),
    "folder": ("is full", "is full: write to a folder that all machines share under {1}"),
}


@pytest.mark.parametrize("field", FAULTS)
def test_what_a_worker_lacks_is_said(field):
    value, want = FAULTS[field]
    question, report = own_report(**{field: value})
    own = checking.report_here(question)
    said = checking.judge_report(report, own, question)
    assert said.startswith(want.format(question.files[0], Path.cwd()))
    assert checking.judge_report(own, own, question) == ""


def test_another_file_of_the_same_name_is_noticed():
    question, report = own_report(sizes=(7,))
    said = checking.judge_report(report, checking.report_here(question), question)
    path = question.files[0]
    assert said == f"sees another {path}: its folder has to be the same on all machines"
    question, report = own_report()
    changed = report._replace(models={**report.models, "base.onnx": "0"})
    said = checking.judge_report(changed, report, question)
    assert said == "has another file of the network base.onnx: copy the one from here"


def test_workers_without_the_package_or_with_other_sources_are_named():
    want = f"does not have super-sdf: install version {__version__} of it there"
    assert checking.judge_version(ModuleNotFoundError("No module named 'super_sdf'")) == want
    assert checking.judge_version(__version__) == ""
    want = f"cannot import super-sdf (SyntaxError: no): install {__version__} there"
    assert checking.judge_version(SyntaxError("no")) == want
    want = f"has other sources of super-sdf {__version__} than are here: install the same state "
    assert checking.judge_sources("0") == f"{want}there and restart it"
    assert checking.judge_sources(checking.digest_of_sources()) == ""
    faults = {"tcp://a": "is old", "tcp://b": "is new", "tcp://c": "is old"}
    assert checking.name_workers(faults) == "worker tcp://a and 1 other is old"


def test_other_versions_of_what_computes_are_a_warning():
    _, own = own_report()
    other = own._replace(versions={**own.versions, "numpy": "numpy 1.26.0"})
    here = own.versions["numpy"]
    assert checking.warnings_of({"tcp://a": other, "tcp://b": own, "tcp://c": other}, own) == [
        f"worker tcp://a and 1 other have numpy 1.26.0, and here is {here}: results may differ in "
        "their last bits"
    ]


OTHER_PROCESSOR = """
from super_sdf.network.network import Network

exact = Network.__call__
Network.__call__ = lambda *given: exact(*given) * (1 + 2**-20)
"""


def test_workers_that_round_differently_are_refused_and_both_named(
    command, scheduler, start_worker, tmp_path, monkeypatch
):
    monkeypatch.setattr(connecting, "FIRST_WORKER_SECONDS", 60)
    Path("other").mkdir()
    Path("other/sitecustomize.py").write_text(OTHER_PROCESSOR)
    start_worker(), start_worker(tmp_path / "other")
    with connect(scheduler[0]) as cluster:
        cluster.client.wait_for_workers(2)
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


def test_a_worker_that_comes_later_and_rounds_differently_is_a_fault(monkeypatch):
    with connect("local", workers=2, threads=1) as cluster:
        first, second = check_workers(cluster, Needs("fast")).members
        known = first._replace(values=first.values._replace(digest="0" * 64))
        found = checking.check_some(cluster, Needs("fast"), {second.address: 1}, [known])
    assert found.members == [] and set(found.faults) == {second.address}
    assert f" than worker {first.address} (" in found.faults[second.address]


def test_values_that_differ_are_said_with_what_computed_them():
    one = Fingerprint("0123456789", "cpu", "A", "int8")
    others = {"b": one, "c": one._replace(digest="f" * 64, device="cuda", precision="float32")}
    assert checking.differing({"a": one, **others}) == {
        "c": "(A, float32 on cuda, ffffffff) gets other values from the network than worker a "
        "(A, int8 on cpu, 01234567), so that meshes would differ or be torn: give --device cpu"
    }
    assert checking.differing({}) == {} and checking.judge_values(one) == ""
    want = "cannot run the network: no GPU"
    assert checking.judge_values(DeviceError("no GPU")) == want


def test_a_folder_that_is_not_shared_is_noticed():
    with checking.probing(Path.cwd()) as (path, text):
        assert checking.why_unusable((path, text)) == ""
        missing = path.with_name("other"), text
        want = f"does not see the output folder {Path.cwd()}"
        assert checking.why_unusable(missing) == checking.why_unusable((path, "else")) == want
    assert not list(Path.cwd().glob(".super-sdf-probe-*"))


def test_a_worker_plans_with_what_its_machine_and_dask_allow():
    assert share_of(Limits(), 4, None, None) == Limits(4, None)
    assert share_of(Limits(), 1, 10**9, 10**10) == Limits(1, 75 * 10**7)
    assert share_of(Limits(), 1, 10**10, 10**9) == Limits(1, 6 * 10**8)
    assert share_of(Limits(2, 10**9), 1, 10**10, 1) == Limits(2, 10**9)
    assert share_of(Limits(2, 10**9), 1, 10**9, None) == Limits(2, 75 * 10**7)


def test_many_inputs_are_looked_at_in_part():
    files = [Path(str(i)) for i in range(1001)]
    assert len(checking.some_of(files)) <= checking.MOST_FILES
    assert checking.some_of(files[:3]) == tuple(files[:3]) and checking.some_of([]) == ()


def test_a_cluster_without_workers_is_not_waited_for_long(monkeypatch):
    monkeypatch.setattr(cluster_pool, "PATIENCE_SECONDS", -1.0)
    with connect("local", workers=1) as cluster:
        needs = Needs("fast")
        checked = check_workers(cluster, needs)._replace(members=[])
        waiting = ClusterPool(cluster, checked, needs, deque([1]), prepare_to_count)
        monkeypatch.setattr(waiting.cluster.client, "nthreads", dict)
        with pytest.raises(ClusterError, match=r"^the cluster local has had no worker for -1 s: "):
            next(waiting.results())


def test_another_machine_has_a_journal_of_its_own(command):
    Path("out").mkdir()
    digest = fingerprint(Path("in/a.npy"))["sha256"]
    note_made(Path("out"), "a.ply", digest, host=socket.gethostname())
    note_made(Path("out"), "b.ply", digest, host="another")
    names = sorted(path.name for path in Path("out").iterdir())
    assert len(names) == 2 and names[0] == ".super-sdf-batch"
    assert read_journal(Path("out")).made == {"a.ply": {digest}, "b.ply": {digest}}
    clear_journal(Path("out"))
    assert read_journal(Path("out")).made == {}
    assert [path.name for path in Path("out").iterdir()] == [".super-sdf-batch"]
