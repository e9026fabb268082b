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
from super_sdf.batch.pool import Death
from super_sdf.threads import Resources
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
    for member in (*psutil.Process(process.pid).children(recursive=True), process):
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


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_batch_that_is_ended_or_killed_leaves_no_workers(monkeypatch, tmp_path, number):
    larger_grids(9)
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # where a killed one leaves the workers' folder
    process = start_batch(*LOCAL, "--jobs", 2)
    workers = workers_of(process)
    assert len(workers) >= 2
    process.send_signal(number)
    _, err = process.communicate(timeout=PATIENCE)
    assert all_end(workers)
    if number == signal.SIGTERM:
        assert process.returncode == 128 + number
        assert err.startswith("Error: ended by SIGTERM: ") and err.count("\n") == 1
        assert err.endswith("of 13 are done and kept; run it again to go on\n")
        assert not list(Path("out").rglob(".*.part"))


def test_workers_at_an_address_write_the_same_bytes_until_the_scheduler_is_lost(
    command, scheduler, start_worker
):
    worker, (address, process) = start_worker(), scheduler
    code, _, err = command("batch", "in", "--out", "out", *QUICK, "--cluster", address)
    assert code == 1 and ", 1 failed; 3 meshes closed" in err
    command("batch", "in", "--out", "plain", *PLAIN, *FAST)
    assert meshes("out") == meshes("plain") and len(meshes("out")) == 3
    assert worker.poll() is None  # it stays for others
    larger_grids(9)
    batch = start_batch("--cluster", address, lines=6)
    end(process)
    _, err = batch.communicate(timeout=PATIENCE)
    want = f"Error: the connection to the Dask scheduler at {address} was lost: "
    assert batch.returncode == 1 and err == f"{want}run it again when the scheduler is back\n"
    assert 4 < len(rows()) < 13
    code, _, err = command("batch", "in", "--out", "out", *FAST, *PLAIN)
    assert code == 1 and len(rows()) == 13 and len(meshes("out")) == 12


def test_no_worker_and_one_with_another_version_are_named(
    command, scheduler, start_worker, tmp_path, monkeypatch
):
    monkeypatch.setattr(connecting, "FIRST_WORKER_SECONDS", 0.1)
    words = ("batch", "in", "--out", "out", *QUICK, "--cluster", scheduler[0])
    want = f"the Dask scheduler at {scheduler[0]} has no workers: start some with "
    assert command(*words) == (1, "", f"Error: {want}'dask worker {scheduler[0]}'\n")
    Path("other/super_sdf").mkdir(parents=True)
    Path("other/super_sdf/__init__.py").write_text('__version__ = "0.0.1"\n')
    start_worker(tmp_path / "other")
    fault = f"has super-sdf 0.0.1, and here is {__version__}: install the same version there and"
    code, _, err = command(*words)
    assert code == 1 and err.startswith("Error: worker tcp://127.0.0.1:")
    assert err.endswith(f" {fault} here\n") and err.count("\n") == 1 and not meshes("out")


def test_an_address_where_nobody_listens_is_named(command, monkeypatch):
    monkeypatch.setattr(connecting, "CONNECT_SECONDS", 0.3)

    def said(address):
        code, _, err = command("batch", "in", "--out", "out", "--cluster", address)
        assert code == 1 and err.startswith(f"Error: no Dask scheduler answers at {address}")
        return err.removeprefix(f"Error: no Dask scheduler answers at {address}")

    want = ": start one with 'dask scheduler' and workers with 'dask worker ADDRESS', or give "
    want += "'local' or another address\n"
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        assert said(f"tcp://127.0.0.1:{bound.getsockname()[1]}") == want
    with socket.create_server(("127.0.0.1", 0)) as silent:
        assert said(f"tcp://127.0.0.1:{silent.getsockname()[1]}") == want
    assert said("nothing://here").startswith(" (")


def test_workers_of_this_machine_leave_no_folder_and_are_not_waited_for_long(monkeypatch, tmp_path):
    """Nor do they open a dashboard."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr(crew_module, "PATIENCE_SECONDS", -1.0)
    with connect("local", workers=1) as cluster:
        scheduler = cluster.client.scheduler_info()
        assert os.listdir(tempfile.tempdir)
        opened = [process["services"] for process in (scheduler, *scheduler["workers"].values())]
        with Crew(cluster, Needs("fast"), prepare_to_wait, pytest.fail) as crew:
            monkeypatch.setattr(cluster.client, "nthreads", dict)
            want = r"^the cluster local has had no worker for -1 s: "
            with pytest.raises(ClusterError, match=want):
                list(crew.completed(deque(range(3))))
    assert opened == [{}, {}] and not os.listdir(tempfile.tempdir)


def test_what_cannot_be_asked_is_refused_and_a_dry_run_connects_to_nothing(command, monkeypatch):
    def asked(*words):
        return command("batch", "in", "--out", "out", "--cluster", *words)

    address = "tcp://10.0.0.1:8786"
    want = f"Error: --jobs 2 is for workers of this machine: those at {address} are as many as "
    want += "were started there; give only one of --jobs and that --cluster\n"
    assert asked(address, "--jobs", 2) == (2, "", want)
    want = "Error: --cluster is empty: give local or the address of a Dask scheduler\n"
    assert asked(" ") == (2, "", want)
    code, _, err = asked("no:1", "--dry-run")
    assert code == 0 and err.startswith("4 to do, ")
    monkeypatch.setattr("super_sdf.machine.extras.find_spec", lambda name: None)
    want = "--cluster needs distributed: pip install -e '.[cluster]' in a clone of super-sdf"
    assert asked("local") == (1, "", f"Error: {want}\n") and not Path("out").exists()


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
    """The others are done by the worker that takes the place of the only one."""
    with (
        connect("local", workers=1, threads=1) as cluster,
        Crew(cluster, Needs("fast"), prepare_to_count, pytest.fail) as crew,
    ):
        results = dict(crew.completed(deque(range(12))))
        assert list(crew.in_order(range(5, 9))) == [(2 * task, 1) for task in range(5, 9)]
    lost = Death("was lost 2 times by the cluster (most likely out of memory)")
    assert results.pop(3) == lost and results.pop(4) == Death("ended with OSError: four")
    assert results == {task: (2 * task, 1) for task in range(12) if task not in (3, 4)}


def prepare_to_wait(limits):
    """Return work that takes longer than it takes to look which workers there are."""
    return lambda task, check_wanted: time.sleep(0.12) or os.getpid()


def test_a_worker_that_comes_later_is_checked_and_used_or_named(monkeypatch):
    monkeypatch.setattr(crew_module, "LOOK_SECONDS", 0.1)
    needs = Needs("fast")
    with connect("local", workers=2, threads=1) as cluster:
        checked = check_workers(cluster, needs)
        (first, limits), (second, _) = checked.members.items()
        known = replace(checked, members={first: limits})
        monkeypatch.setattr(crew_module, "check_workers", lambda *_: known)
        for fault in ("", "is odd"):
            if fault:
                found = replace(checked, members={}, faults={second: fault})
                monkeypatch.setattr(crew_module, "check_some", lambda *_, found=found: found)
            tasks, warnings, pids = deque(range(4)), [], set()
            with Crew(cluster, needs, prepare_to_wait, warnings.append) as crew:
                for _, pid in crew.completed(tasks):
                    pids.add(pid)
                    if not warnings and len(pids) < 2:
                        tasks.append(0)  # until the other was looked at
            assert len(pids) == (1 if fault else 2)
            assert warnings == ([f"worker {second} is odd; it is not used"] if fault else [])


FAULTS = {
    "": {},
    "does not see the network x.onnx: put it where all machines see it": {"models": {"x.onnx": ""}},
    "has another file of the network base.onnx: copy the": {"models": {"base.onnx": "0"}},
    "lacks nowhere: install there what is installed here": {"modules": ("nowhere",)},
    "does not see /no/file: put the inputs where all machines see them by this path": {
        "sizes": {Path("/no/file"): 1}
    },
    "sees another /dev/null: its folder has to be the same": {"sizes": {Path("/dev/null"): 7}},
    "does not see the output folder /: write to a folder that all machines share under ": {
        "probe": (Path("/no file"), "text")
    },
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_a_worker_lacks_is_said(fault):
    path, changes = Path("in/a.npy").resolve(), dict(FAULTS[fault])
    needs = Needs("fast", modules=changes.pop("modules", ()), folder=Path.cwd())
    here = Expected(needs, needs.digests_of_models(), {path: path.stat().st_size}, None, True)
    found = checking.what_is_lacking(here._replace(**changes))
    assert found.startswith(fault) and bool(found) == bool(fault)


def test_workers_without_the_package_or_with_other_sources_or_versions_are_named():
    missing = ModuleNotFoundError("No module named 'super_sdf'")
    want = f"does not have super-sdf: install version {__version__} of it there"
    assert checking.judge_version(missing) == want and checking.judge_version(__version__) == ""
    want = f"cannot import super-sdf (SyntaxError: no): install {__version__} there"
    assert checking.judge_version(SyntaxError("no")) == want
    want = f"has other sources of super-sdf {__version__} than are here: install the same state "
    assert checking.judge_sources("0") == f"{want}there and restart it"
    assert checking.judge_sources(checking.digest_of_sources()) == ""
    here = checking.versions()
    own = checking.Report("", "host", here)
    other = own._replace(versions={**here, "numpy": "numpy 1.26.0"})
    want = f"worker tcp://a and 1 other have numpy 1.26.0, and here is {here['numpy']}: results may"
    warnings = checking.warnings_of({"tcp://a": other, "tcp://b": own, "tcp://c": other})
    assert warnings == [f"{want} differ in their last bits"]


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


def test_local_workers_that_do_not_start_are_one_line(monkeypatch):
    def fail(*given, **named):
        raise RuntimeError("Nanny failed to start.")

    monkeypatch.setattr(connecting, "SpecCluster", fail)
    said = r"^the local workers do not start \(Nanny failed to start.\): run it again, with fewer "
    with pytest.raises(ClusterError, match=said), connecting.connect("local", workers=1):
        pass
