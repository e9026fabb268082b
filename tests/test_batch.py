"""Many files: each as by itself, bad ones named, and a rerun goes on where the last one ended."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import pytest
import trimesh
from conftest import ball

from super_sdf.batch import job as batch_job
from super_sdf.batch.fingerprint import fingerprint, is_unchanged
from super_sdf.batch.inputs import find_jobs
from super_sdf.batch.job import Result
from super_sdf.batch.lock import FolderLock, remove_parts
from super_sdf.batch.plan import Batch, Settings
from super_sdf.batch.pool import Pool
from super_sdf.batch.workers import Loading, choose_workers
from super_sdf.chunks import count_cores
from super_sdf.cli_batch_report import describe_progress, duration
from super_sdf.convert import ConvertOptions, convert
from super_sdf.errors import FileError

LONE = ("--jobs", 1, "--factor", 2, "--quality", "fast", "--spacing", 1, "--origin", 0)
CONSTANT = "every value is 1: a constant field has no surface"


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """A folder of its own with three good grids and a bad one below ``in``."""
    monkeypatch.chdir(tmp_path)
    Path("in/deep/er").mkdir(parents=True)
    np.save("in/a.npy", ball(12, 3.0).values)
    np.savez("in/deep/b.npz", values=ball(12, 3.5).values)
    np.save("in/deep/er/c.d.npy", ball(12, 4.0).values[:7])
    np.save("in/bad.npy", np.ones((4, 4, 4)))
    return tmp_path


@pytest.fixture
def run(command):
    """Run the batch; return exit code and what it says, without the time."""

    def go(*arguments, out="out"):
        code, said, err = command("batch", *arguments, "--out", out, *LONE)
        return code, said, re.sub(r"; [\d.]+ s\n$", "\n", err)

    return go


def rows(folder="out"):
    """Return the report's rows."""
    return [json.loads(line) for line in Path(folder, "report.jsonl").read_text().splitlines()]


def files(folder="out"):
    """Return what is in a folder and not hidden, with the times of change."""
    found = sorted(path for path in Path(folder).rglob("[!.]*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.stat().st_mtime_ns for path in found}


def test_folders_are_mirrored_failures_named_and_meshes_those_of_single_runs(run, command):
    code, out, err = run("in")
    assert (code, out) == (1, "")
    assert err == (
        f"Failed: in/bad.npy: {CONSTANT}\n"
        f"Note: spacing, origin or sign of 1 was inferred: see {Path('out/report.jsonl')}\n"
        "3 done, 1 failed; 2 meshes closed, 1 open\n"
    )
    made = {"a.ply": "a.npy", "deep/b.ply": "deep/b.npz", "deep/er/c.d.ply": "deep/er/c.d.npy"}
    assert files().keys() == made.keys() | {"report.jsonl"}
    for mesh, grid in made.items():
        command("upsample", f"in/{grid}", "single.ply", *LONE[2:], "--force")
        assert Path("single.ply").read_bytes() == Path("out", mesh).read_bytes()


def test_several_processes_make_the_same(run, command):
    options = (*LONE[2:], "--threads", 1)
    run("in", "--threads", 1)
    code, _, _ = command("batch", "in", "--out", "two", *options, "--jobs", 2)
    assert code == 1 and files("two").keys() == files().keys()
    for name in files().keys() - {"report.jsonl"}:
        assert Path("two", name).read_bytes() == Path("out", name).read_bytes()


def test_the_report_holds_a_row_a_file(run):
    run("in")
    by_name = {row["out"]: row for row in rows()}
    assert len(rows()) == len(by_name) == 4
    mesh, row = trimesh.load("out/a.ply"), by_name["a.ply"]
    assert (row["vertices"], row["triangles"]) == (len(mesh.vertices), len(mesh.faces))
    assert row["in"] == os.path.abspath("in/a.npy") and row["status"] == "ok" and row["closed"]
    assert row["content"] == fingerprint(Path("in/a.npy"))
    assert row["output"] == fingerprint(Path("out/a.ply"))
    assert not by_name["deep/er/c.d.ply"]["closed"]
    bad = by_name["bad.ply"]
    assert (bad["status"], bad["reason"], bad["retry"]) == ("failed", CONSTANT, False)


def test_a_rerun_does_nothing_and_says_so(run):
    run("in")
    before, report = files(), rows()
    code, _, err = run("in")
    assert (code, files(), rows()) == (1, before, report)
    assert err == (
        f"Failed: in/bad.npy: {CONSTANT}\nnothing to do: 3 done before, 1 failed before "
        "(--retry tries again); 2 meshes closed, 1 open\n"
    )
    os.remove("in/bad.npy")
    want = "nothing to do: 3 done before; 2 meshes closed, 1 open\n"
    assert run("in") == (0, "", want)


def redone(run, *arguments):
    """Return the outputs that another run makes."""
    before = len(rows())
    run("in", *arguments)
    return [row["out"] for row in rows()[before:]]


def test_what_has_changed_is_done_again(run, monkeypatch):
    run("in")
    np.save("in/a.npy", ball(12, 3.2).values)
    assert redone(run) == ["a.ply"]
    os.utime("in/a.npy")
    Path("in/a.npy").rename("in/moved.npy")
    Path("in/moved.npy").rename("in/a.npy")
    assert redone(run) == []
    Path("out/deep/b.ply").unlink()
    assert redone(run) == ["deep/b.ply"]
    mesh = bytearray(Path("out/a.ply").read_bytes())
    mesh[-1] ^= 1
    Path("out/a.ply").write_bytes(mesh)
    assert redone(run) == ["a.ply"]
    assert redone(run, "--retry") == ["bad.ply"]
    assert len(redone(run, "--offset", 0.5)) == 4
    assert redone(run, "--offset", 0.5, "--threads", 1) == []
    assert len(redone(run, "--offset", 0.5, "--force")) == 4
    monkeypatch.setattr("super_sdf.batch.plan.__version__", "next")
    assert len(redone(run, "--offset", 0.5)) == 4


def test_another_network_file_is_another_option(run, command):
    from super_sdf.network import shipped_models

    shutil.copy(shipped_models()["fast"], "own.onnx")
    run("in", "--model", "own.onnx")
    assert redone(run, "--model", "own.onnx") == []
    shutil.copy(shipped_models()["base"], "own.onnx")
    assert len(redone(run, "--model", "own.onnx")) == 4


@pytest.mark.parametrize("torn", [b'{"in": "x", "out": "a.p', b"{", b"\xff\xfe"])
def test_a_torn_line_is_cut_off(run, torn):
    run("in")
    lines = Path("out/report.jsonl").read_bytes().splitlines(keepends=True)
    Path("out/report.jsonl").write_bytes(b"".join(lines[:-1]) + torn)
    run("in")
    assert len(rows()) == 4 and rows()[-1]["out"] == json.loads(lines[-1])["out"]


def test_lines_of_others_in_the_report_are_passed_over(run):
    run("in")
    report = Path("out/report.jsonl")
    report.write_bytes(b'nonsense\n[1]\n{"out": 1}\n' + report.read_bytes())
    assert run("in")[2].splitlines()[-1].startswith("nothing to do: 3 done before")


def test_what_was_not_the_inputs_fault_is_tried_again(run, monkeypatch):
    def fail(*_, **__):
        raise MemoryError

    monkeypatch.setattr(batch_job, "convert", fail)
    code, _, err = run("in/a.npy")
    want = "Failed: in/a.npy: out of memory: use a smaller --factor or grid\n"
    assert (code, err) == (1, want + "0 done, 1 failed; 0 meshes closed, 0 open\n")
    monkeypatch.setattr(batch_job, "convert", convert)
    assert run("in/a.npy") == (0, "", "1 done, 0 failed; 1 meshes closed, 0 open\n")


def test_a_bug_that_one_file_shows_is_named_and_stops_nothing(run, monkeypatch):
    right = batch_job.convert

    def fail(source, *rest, **options):
        if source.name == "a.npy":
            raise KeyError("odd\nthing")
        return right(source, *rest, **options)

    monkeypatch.setattr(batch_job, "convert", fail)
    code, _, err = run("in")
    assert code == 1 and "Failed: in/a.npy: KeyError: 'odd\\nthing'\n" in err
    assert err.endswith("2 done, 2 failed; 1 meshes closed, 1 open\n")


def test_two_inputs_for_one_output_are_refused(run, command):
    shutil.copy("in/deep/b.npz", "in/a.npz")
    want = (
        "Error: in/a.npy and in/a.npz would both become a.ply: rename one, or give 'out' in a "
        ".jsonl manifest\n"
    )
    assert run("in") == (2, "", want)
    assert not Path("out").exists()
    assert run("in/a.npy", "in/a.npy", Path("in/a.npy").absolute())[0] == 0  # one and the same


def test_a_file_of_another_origin_is_not_replaced(run):
    Path("out").mkdir()
    Path("out/a.ply").write_text("mine")
    reason = f"{Path('out/a.ply')} exists and is of no batch: remove it or use --force"
    words = "nothing to do: 0 done before, 1 refused; 0 meshes closed, 0 open"
    for _ in range(2):
        assert run("in/a.npy") == (1, "", f"Failed: in/a.npy: {reason}\n{words}\n")
        assert Path("out/a.ply").read_text() == "mine" and len(rows()) == 1
    assert run("in/a.npy", "--force")[0] == 0
    assert trimesh.load("out/a.ply").is_watertight


def test_a_dry_run_says_what_would_be_done_and_writes_nothing(run):
    want = f"to do: in/a.npy -> {Path('out/a.ply')}\n"
    code, out, err = run("in", "--dry-run")
    assert code == 0 and want in out and out.count("\n") == 4
    assert err == "4 to do, 0 done before, 0 failed before, 0 refused\n"
    assert not Path("out").exists()
    run("in")
    Path("out/a.stl").write_text("mine")
    before = files()
    _, out, err = run("in", "in/a.npy", "--dry-run")
    assert f"done before: in/a.npy -> {Path('out/a.ply')}\n" in out
    assert f"failed before: in/bad.npy: {CONSTANT}\n" in out
    assert err == "0 to do, 3 done before, 1 failed before, 0 refused\n"
    _, out, err = run("in/a.npy", "--dry-run", "--format", "stl")
    assert out.startswith("refused: in/a.npy: ") and err.endswith(" 1 refused\n")
    assert files() == before


def test_fail_fast_begins_nothing_after_a_failure(run):
    Path("list.jsonl").write_text('{"in": "in/bad.npy"}\n{"in": "in/a.npy"}')
    np.save("in/bad.npy", np.ones((30, 30, 30)))  # the largest goes first
    for _ in range(2):
        code, _, err = run("list.jsonl", "--fail-fast")
        assert code == 1
        assert err.endswith("\n0 done, 1 failed, 1 not begun; 0 meshes closed, 0 open\n")
    assert len(rows()) == 1


def test_json_is_the_summary(run):
    code, out, err = run("in", "--json", "--quiet")
    facts = json.loads(out)
    assert code == 1 and err == f"Failed: in/bad.npy: {CONSTANT}\n"
    assert facts.pop("seconds") > 0
    assert facts == {
        **{"done": 3, "done_before": 0, "failed": 1, "not_begun": 0, "closed": 2, "open": 1},
        "failures": [{"in": os.path.abspath("in/bad.npy"), "out": "bad.ply", "reason": CONSTANT}],
        "report": str(Path("out/report.jsonl")),
    }


def test_that_something_was_inferred_or_noisy_is_said_once(command):
    noise = np.random.default_rng(0).uniform(-0.3, 0.3, (12, 12, 12))
    np.save("in/noisy.npy", ball(12, 4.0).values + noise)
    _, _, err = command("batch", "in", "--out", "out", *LONE[:6])
    report = Path("out/report.jsonl")
    assert f"Note: spacing, origin or sign of 4 was inferred: see {report}\n" in err
    assert f"Warning: 1 are from noisy or contradictory values: see {report}\n" in err
    assert "Note" not in command("batch", "in", "--out", "out", *LONE[:6])[2]


def test_of_many_failures_twenty_are_shown(run):
    for i in range(23):
        shutil.copy("in/bad.npy", f"in/bad{i}.npy")
    _, _, err = run("in/bad*.npy")
    assert err.count("Failed: ") == 20
    assert f"and 4 more, see {Path('out/report.jsonl')}\n" in err


def test_patterns_keep_the_folders_below_their_fixed_part(run):
    assert run("in/**/*.np?", "--cap", "--dry-run")[2].startswith("4 to do")
    run("in/de*/**/*.npy")
    assert files().keys() == {"deep/er/c.d.ply", "report.jsonl"}
    Path("in/x[1].npy").write_bytes(Path("in/a.npy").read_bytes())
    assert run("in/x[1].npy", out="other")[0] == 0  # a file of that name goes before a pattern


def test_a_list_names_files_from_where_it_lies(run):
    Path("in/list.txt").write_text("# two of them\n\n deep/b.npz\n../in/a.npy\nnone.npy\n")
    code, _, err = run("in/list.txt")
    assert code == 1 and files().keys() == {"deep/b.ply", "a.ply", "report.jsonl"}
    assert f"Failed: {Path('in/none.npy')} does not exist\n" in err
    assert run("in/list.txt")[2].splitlines()[-1].startswith("nothing to do: 2 done before, 1 fail")
    np.save("in/none.npy", ball(12, 3.0).values)
    assert run("in/list.txt")[0] == 0


def test_a_list_of_objects_has_options_of_its_own(run, command):
    np.save("in/a.npy", -2 * ball(12, 3.0).values)
    line = {"in": "in/a.npy", "out": "x/y.stl", "spacing": 2, "origin": [1, 2, 3], "factor": 4}
    other = {"in": "in/deep/er/c.d.npy", "cap": True, "inside": "negative"}
    lines = [{**line, "inside": "positive", "offset": 1}, other]
    Path("list.jsonl").write_text("\n".join(map(json.dumps, lines)))
    assert run("list.jsonl") == (0, "", "2 done, 0 failed; 2 meshes closed, 0 open\n")
    options = ("--spacing", 2, "--origin", "1,2,3", "--inside", "positive", "--offset", 1)
    command("upsample", "in/a.npy", "single.stl", *options, "--quality", "fast")
    assert Path("single.stl").read_bytes() == Path("out/x/y.stl").read_bytes()


LISTS = {
    "{": "list.jsonl, line 1 is no JSON: Expecting property name enclosed in double quotes: "
    "line 1 column 2 (char 1)",
    "[1]": 'list.jsonl, line 1 is [1]: give an object, {"in": "a.npy"}',
    "": "list.jsonl names no file: give a path a line",
    '{"out": "a.ply"}': "list.jsonl, line 1: 'in' is None: give the path of a grid",
    '{"in": "a.npy", "Factor": 2}': "list.jsonl, line 1: 'Factor' is unknown: give in, out, "
    "factor, spacing, origin, inside, offset, cap",
    '\n{"in": "a.npy", "factor": 3}': "list.jsonl, line 2: factor is 3: give an even number from "
    "2 to 16 (an odd one has no node on the samples)",
    '{"in": "a.npy", "factor": true}': "list.jsonl, line 1: 'factor' is True: give a whole number",
    '{"in": "a.npy", "spacing": [1, 2]}': "list.jsonl, line 1: 'spacing' is [1, 2]: give one "
    "number, or a list of three",
    '{"in": "a.npy", "offset": "1"}': "list.jsonl, line 1: 'offset' is '1': give a number",
    '{"in": "a.npy", "inside": "out"}': "list.jsonl, line 1: 'inside' is 'out': give one of auto, "
    "negative, positive",
    '{"in": "a.npy", "cap": 1}': "list.jsonl, line 1: 'cap' is 1: give true or false",
    '{"in": "a.npy", "out": "a.xyz"}': "list.jsonl, line 1: 'out' is 'a.xyz': give a file, one of "
    ".ply, .stl, .obj, .off, .glb, .3mf",
    '{"in": "a.npy", "out": "../a.ply"}': "list.jsonl, line 1: 'out' is '../a.ply': give a path "
    "within the output folder",
}


@pytest.mark.parametrize("text", LISTS)
def test_a_list_without_meaning_is_refused_before_the_work(run, text):
    Path("list.jsonl").write_text(text)
    assert run("list.jsonl") == (2, "", f"Error: {LISTS[text]}\n")
    assert not Path("out").exists()


ARGUMENTS = {
    "nothing": "nothing does not exist: give grids, folders, patterns or a manifest",
    "none.npy": "none.npy does not exist: give grids, folders, patterns or a manifest",
    "in/*.vdb": "in/*.vdb holds no .npy or .npz file",
    "empty": "empty holds no .npy or .npz file",
    "odd.vdb": "odd.vdb is neither a grid (.npy, .npz) nor a manifest (.txt, .jsonl)",
}


@pytest.mark.parametrize("argument", ARGUMENTS)
def test_arguments_that_name_no_grid_are_refused(run, argument):
    Path("empty").mkdir()
    Path("odd.vdb").write_text("")
    assert run("in", argument) == (2, "", f"Error: {ARGUMENTS[argument]}\n")


def test_options_are_checked_before_the_work(run, command):
    code, _, err = command("batch", "in", "--out", "out", "--factor", 3)
    assert code == 2 and err.startswith("Error: factor is 3: give an even number")
    assert command("batch", "in")[0] == 2
    Path("taken").write_text("")
    want = "Error: taken cannot be written: File exists\n"
    assert run("in", out="taken") == (1, "", want)
    want = "Error: no model 'none': give an ONNX file or one of: fast, base, best\n"
    assert run("in", "--model", "none") == (1, "", want) and not Path("out").exists()
    Path("bad.onnx").write_text("x")
    code, _, err = command("batch", "in", "--out", "out", "--jobs", 2, "--model", "bad.onnx")
    assert code == 1 and err.startswith("Error: bad.onnx is no ONNX file that onnxruntime can run")


def test_an_interrupt_is_one_line_and_keeps_what_is_done(run, monkeypatch):
    right, done = batch_job.convert, []

    def interrupt(*arguments, **options):
        if done:
            raise KeyboardInterrupt
        done.append(right(*arguments, **options))
        return done[0]

    monkeypatch.setattr(batch_job, "convert", interrupt)
    want = "Error: interrupted: 1 of 4 are done and kept; run it again to go on\n"
    assert run("in") == (130, "", want)
    assert len(files()) == 2 and len(rows()) == 1


def test_a_folder_belongs_to_one_batch_at_a_time(run):
    with FolderLock(Path("out")):
        want = "Error: out is in use by another batch: wait for it, or give another\n"
        assert run("in") == (1, "", want)
        assert run("in", "--dry-run")[0] == 0
    assert run("in")[0] == 1 and rows()


def test_what_a_killed_batch_left_is_removed_and_nothing_else(run):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    Path("out/deep").mkdir(parents=True)
    stale = Path(f"out/deep/.b.ply.{ended.pid}.part")
    kept = [f"out/.x.ply.{ended.pid}.part", "out/b.part"]
    for path in (stale, *map(Path, kept)):
        path.write_text("half")
    Path("out/deep/b.ply").write_text("was moved into place, and not yet in the report")
    Path("out/.super-sdf-batch").write_text('"deep/b.ply"\n"to')
    assert run("in/", "--dry-run")[2].startswith("4 to do") and stale.exists()
    assert run("in")[2].endswith("3 done, 1 failed; 2 meshes closed, 1 open\n")
    assert not stale.exists() and all(map(os.path.exists, kept))
    assert rows()[-1]["out"] == "deep/b.ply"  # last: it may be what ended the run
    assert Path("out/.super-sdf-batch").read_text() == ""


def start_batch(*options):
    """Start a batch as a process, and return it when its report has some lines."""
    arguments = ["batch", "in", "--out", "out", "--jobs", 2, "--threads", 1, *options]
    words = [sys.executable, "-m", "super_sdf.cli", *map(str, arguments)]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    report = Path("out/report.jsonl")
    while not report.exists() or report.read_bytes().count(b"\n") < 2:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.01)
    return process


def is_over(process):
    """Say whether a process has ended, if only its parent has still to hear of it."""
    with suppress(psutil.NoSuchProcess):
        return process.status() == psutil.STATUS_ZOMBIE
    return True


def larger_grids(count):
    """Write grids that take a moment."""
    for i in range(count):
        np.save(f"in/more{i}.npy", ball(32, 10 + i / 8).values)


def test_killed_on_the_way_it_goes_on(command):
    larger_grids(8)
    process = start_batch("--quality", "fast")
    workers = psutil.Process(process.pid).children()
    assert len(workers) >= 2
    process.kill()
    process.communicate()
    limit = time.monotonic() + 10
    while not all(map(is_over, workers)) and time.monotonic() < limit:
        time.sleep(0.01)
    assert all(map(is_over, workers))  # no orphans
    for mesh in Path("out").rglob("[!.]*.ply"):
        assert len(trimesh.load(mesh).faces) > 0
    finished = Path("out/report.jsonl").read_text().count("\n")
    code, _, err = command("batch", "in", "--out", "out", "--quality", "fast")
    assert code == 1 and f", {finished} done before" in err
    assert len(rows()) == 12 == len({row["out"] for row in rows()})
    assert not list(Path("out").rglob(".*.part"))


def test_a_dead_worker_costs_its_file_alone(run):
    larger_grids(6)
    folder, options = Path("out"), ConvertOptions(4, (1.0,), (0.0,))
    jobs, victims = find_jobs(["in/more*.npy"], ".ply", options), []
    pool = Pool(iter(jobs), folder, Loading("fast", "float32", "cpu", 1), lambda job: None)
    results = []
    for result in pool.results(2):
        results.append(result)
        if not victims:
            victims = list(pool.busy.values())[:1]
            os.kill(victims[0].process.pid, signal.SIGKILL)
    assert sorted(r.job.target for r in results) == sorted(j.target for j in jobs)
    failed = [result for result in results if result.row["status"] != "ok"]
    (job,) = [victim.job for victim in victims]  # what it was at in the end
    assert [result.job for result in failed] == [job] and failed[0].row["retry"]
    assert failed[0].failure() == (
        f"{job.source}: the process that converted it died of SIGKILL (for want of memory, mostly)"
    )
    assert not list(folder.rglob(".*.part"))


def test_content_is_read_only_where_time_or_path_differ(monkeypatch):
    path = Path("in/a.npy")
    known = fingerprint(path)
    assert known["size"] == path.stat().st_size and is_unchanged(path, known, same_path=False)
    assert fingerprint(Path("in")) is None and is_unchanged(Path("in/none"), None)
    assert not is_unchanged(path, None) and not is_unchanged(Path("in/none"), known)
    assert not is_unchanged(path, {**known, "sha256": "", "mtime_ns": 0})
    monkeypatch.setattr("super_sdf.batch.fingerprint.fingerprint", lambda path: 1 / 0)
    assert is_unchanged(path, known) and not is_unchanged(path, {**known, "size": 1})


def test_parts_of_a_given_process_are_removed_even_while_others_live():
    Path(f".a.ply.{os.getppid()}.part").touch()
    remove_parts([Path("a.ply")])
    assert Path(f".a.ply.{os.getppid()}.part").exists()
    remove_parts([Path("a.ply")], os.getppid())
    assert not Path(f".a.ply.{os.getppid()}.part").exists()


def test_as_many_processes_as_cores_and_memory_allow(monkeypatch):
    monkeypatch.setattr("super_sdf.batch.workers.count_cores", lambda: 8)
    monkeypatch.setattr("super_sdf.batch.workers.free_memory", lambda: 3_500_000_000)
    assert choose_workers("cpu", 100) == 3
    monkeypatch.setattr("super_sdf.batch.workers.free_memory", lambda: None)
    assert [choose_workers("cpu", jobs) for jobs in (0, 5, 100)] == [1, 5, 8]
    assert choose_workers("cuda", 100) == 1 and count_cores() >= 1


def test_progress_has_rate_and_time_left(run, monkeypatch):
    result = Result(None, {})
    batch = Batch(Settings(Path("out")), done=[result] * 9, failed=[result], seconds=5.0)
    batch.work, batch.work_done = 400.0, 100.0
    assert describe_progress(batch, 30) == "10/30, 2 files/s, 15 s left, 1 failed"
    assert [duration(s) for s in (0.04, 59, 200, 7300)] == ["0.0 s", "59 s", "3 min", "2 h 2 min"]
    monkeypatch.setattr("super_sdf.cli_batch_report.sys.stderr.isatty", lambda: True)
    _, _, err = run("in")
    assert err.startswith("0/4\r") and "\r1/4, " in err and "\r\x1b[KFailed: in/bad" in err


def test_a_lock_refused_is_a_file_error():
    with FolderLock(Path("out")), pytest.raises(FileError, match="in use by another batch"):
        FolderLock(Path("out"))
