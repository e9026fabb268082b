"""Many files: each as by itself, bad ones named, and a rerun goes on where the last one ended."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import processes
import psutil
import pytest
import trimesh
from batches import CONSTANT, FAST, LONE, files, rows
from conftest import ball
from processes import COMMAND, PATIENCE, all_end, larger_grids, start_command, wait_for_lines

import super_sdf
from super_sdf.batch import work as batch_work
from super_sdf.batch.inputs import find_jobs
from super_sdf.batch.work import Death, work_in_processes
from super_sdf.convert import convert
from super_sdf.errors import SuperSdfError
from super_sdf.files.formats import GRID_SUFFIXES
from super_sdf.files.meshes import MESH_SUFFIXES
from super_sdf.network.network import shipped_models
from super_sdf.options import BATCH_LISTS, Options

pytestmark = pytest.mark.usefixtures("grid_folder")
SMALL = (*FAST, "--factor", 2, "--spacing", 1)


@pytest.fixture
def batch(command):
    """Run a batch on a single process; return the exit code, the summary, and what stderr says."""

    def go(*words, out="out"):
        network = () if "--model" in words else FAST
        code, said, err = command("batch", *words, "--out", out, *LONE[:-2], *network, "--json")
        return code, json.loads(said), err

    return go


def contents():
    """Return the bytes of the outputs."""
    return {name: Path("out", name).read_bytes() for name in files() if name != "report.jsonl"}


def is_made(row):
    """Return whether the files of a row are there with the content that it says."""
    known = {row["out"]: row["output"]} if "sha256" in row["output"] else row["output"]
    found = {name: hashlib.sha256(Path("out", name).read_bytes()).hexdigest() for name in known}
    return all(found[name] == each["sha256"] for name, each in known.items())


# Files, folders, patterns, lists


def test_folders_are_mirrored_failures_named_and_meshes_those_of_single_runs(batch, command):
    code, facts, err = batch("in")
    assert code == 1 and f"Failed: in/bad.npy: {CONSTANT}\n" in err
    assert (facts["done"], facts["failed"], facts["closed"]) == (3, 1, 3)
    made = {"a.ply": "a.npy", "deep/b.ply": "deep/b.npz", "deep/er/c.d.ply": "deep/er/c.d.npy"}
    assert contents().keys() == made.keys()
    assert not list(Path("out").rglob(".super-sdf-parts"))
    for mesh, grid in made.items():
        command("upsample", f"in/{grid}", "single.ply", *LONE[2:], "--force")
        assert Path("single.ply").read_bytes() == Path("out", mesh).read_bytes()
    by_name = {row["out"]: row for row in rows()}
    assert len(rows()) == len(by_name) == 4 and is_made(by_name["a.ply"])
    assert by_name["a.ply"]["in"] == os.path.abspath("in/a.npy") and by_name["a.ply"]["closed"]
    assert by_name["a.ply"]["precision"] == "int8"  # that ran; asked was for "auto"
    assert by_name["a.ply"]["triangles"] == len(trimesh.load("out/a.ply").faces)
    bad = by_name["bad.ply"]
    assert (bad["status"], bad["reason"], bad["retry"]) == ("failed", CONSTANT, False)
    before = files(), rows()
    code, facts, err = batch("in")
    assert code == 1 and facts["done_before"] == 3 and (files(), rows()) == before
    assert (facts["done"], facts["failed"], facts["failed_before"]) == (0, 0, 1)
    assert facts["notes"] == {"taken as inside": 1, "the solid runs out of the grid": 1}
    assert "Notes: taken as inside (1), the solid runs out of the grid (1); see out/repo" in err


def test_what_has_changed_is_done_again(batch):
    def redone(*arguments):
        """Return the outputs that another run makes."""
        before = len(rows())
        batch("in", *arguments)
        return [row["out"] for row in rows()[before:]]

    batch("in")
    np.save("in/a.npy", ball(12, 3.2).values)
    assert redone() == ["a.ply"]
    os.utime("in/a.npy")
    assert redone() == []
    Path("out/deep/b.ply").unlink()
    assert redone() == ["deep/b.ply"]
    assert redone("--retry") == ["bad.ply"]
    assert redone() == [] and len(redone("--offset", 0.5)) == 4
    assert redone("--offset", 0.5, "--threads", 1) == []
    assert len(batch("in", "--offset", 0.25, "--dry-run")[1]["to_do"]) == 4
    assert len(redone("--offset", 0.5, "--force")) == 4
    shutil.copy(shipped_models()["fast"], "own.onnx")
    batch("in/deep", "--model", "own.onnx", out="own")
    shutil.copy(shipped_models()["base"], "own.onnx")
    assert len(batch("in/deep", "--model", "own.onnx", "--dry-run", out="own")[1]["to_do"]) == 2


def test_files_that_no_batch_made_or_that_were_changed_are_replaced_by_force_only(batch):
    Path("out").mkdir()
    Path("out/a.ply").write_text("mine")
    for _ in range(2):
        code, _, err = batch("in/a.npy")
        assert code == 1 and "out/a.ply exists and was not made by a batch: remove it or" in err
        assert Path("out/a.ply").read_text() == "mine" and len(rows()) == 1
    assert batch("in/a.npy", "--force")[0] == 0
    made = Path("out/a.ply").read_bytes()
    Path("out/a.ply").write_bytes(made[:-1] + b"x")
    for options in ((), ("--offset", 0.5), ("--retry",)):
        assert "was changed after a batch made it: remove it or" in batch("in/a.npy", *options)[2]
        assert Path("out/a.ply").read_bytes() == made[:-1] + b"x"
    assert batch("in/a.npy", "--force")[0] == 0 and Path("out/a.ply").read_bytes() == made
    assert batch("in/a.npy", "--offset", 0.5)[0] == 0  # its own, of other options
    Path("out/a.ply").unlink()
    Path("out/a.ply").symlink_to("../in/a.npy")
    assert "out/a.ply is a link: remove it" in batch("in/a.npy", "--force")[2]
    assert Path("in/a.npy").stat().st_size > 1000


def test_what_another_did_meanwhile_or_a_bug_costs_one_file_alone_and_is_tried_again(
    batch, monkeypatch
):
    def disturb(source, *rest, **options):
        if source.name == "a.npy":
            Path("out/a.ply").write_text("mine")
        if source.name == "b.npz":
            raise KeyError("odd\nthing")
        return convert(source, *rest, **options)

    with monkeypatch.context() as patch:
        patch.setattr(batch_work, "convert", disturb)
        for _ in range(2):
            code, facts, err = batch("in")
            assert code == 1 and "Failed: in/deep/b.npz: KeyError: 'odd\\nthing'\n" in err
            assert Path("out/a.ply").read_text() == "mine"
        assert facts["done_before"] == 1
    assert batch("in/deep/b.npz")[0] == 0


def test_two_inputs_for_one_output_are_refused_and_one_named_twice_is_one(batch, command):
    shutil.copy("in/deep/b.npz", "in/a.npz")
    _, _, err = command("batch", "in", "--out", "out")
    assert "in/a.npy and in/a.npz would both become a.ply: rename one, or give 'out' in" in err
    assert not Path("out").exists()
    assert batch("in/a.npy", "in/a.npy", Path("in/a.npy").absolute())[1]["done"] == 1


def test_a_dry_run_says_what_would_be_done_and_writes_nothing(batch):
    assert batch("in", "--dry-run")[1]["to_do"][0].keys() == {"in", "out"}
    assert not Path("out").exists()
    Path("in/list.txt").write_text("bad.npy\ndeep/b.npz\ndeep/er/c.d.npy")
    batch("in/list.txt")
    Path("out/a.ply").write_text("mine")
    np.save("in/new.npy", ball(12, 3.0).values)
    before, plan = files(), batch("in", "--dry-run")[1]
    assert [entry["out"] for entry in plan["to_do"]] == ["new.ply"] and files() == before
    assert [entry["reason"] for entry in plan["failed_before"]] == [CONSTANT]
    assert [entry["out"] for entry in plan["refused"]] == ["a.ply"]


def test_patterns_keep_the_folders_below_their_fixed_part_and_links_in_a_circle_end(batch):
    for name in "abc":
        Path("in", name).symlink_to(Path("in").absolute())
        Path("in/deep", name).symlink_to("..")
    for words in ("in/**/*.np?", "in"):
        assert len(batch(words, "--dry-run")[1]["to_do"]) == 4
    assert len(batch("in/a/*.npy", "--dry-run")[1]["to_do"]) == 2  # named: followed
    Path("in/.hidden").mkdir()
    shutil.copy("in/a.npy", "in/.hidden/a.npy")
    assert len(batch("in/**", "--dry-run")[1]["to_do"]) == 4
    jobs = find_jobs(["in/de*/er/*.npy", "in/.h*/*.npy"], ".ply", Options(), None)
    assert [job.target for job in jobs] == ["deep/er/c.d.ply", ".hidden/a.ply"]
    assert len(find_jobs(["in"], ".ply", Options(), None)) == 5


def test_a_name_chooses_among_the_arrays_of_each_file(batch):
    Path("frames").mkdir()
    for name in ("1.npz", "2.npz"):
        values = ball(12, 3.0).values
        np.savez(f"frames/{name}", density=-values, speed=values)
    Path("frames/list.txt").write_text("2.npz\n1.npz:speed")
    facts = batch("frames/1.npz", "frames/list.txt", "--grid", "density", "--level", 0)[1]
    assert facts["done"] == 3 and contents().keys() == {"1.ply", "2.ply", "1-speed.ply"}
    assert batch("frames/1.npz", "--grid", "speed", "--level", 0)[1]["done"] == 1  # in its place
    err = batch("frames/1.npz", out="other")[2]
    say = "holds several arrays, density, speed: give --grid density, say"
    assert f"Failed: frames/1.npz: {say}\n" in err and rows("other")[0]["reason"] == say


def test_lists_name_files_from_where_they_lie_and_objects_have_options_of_their_own(batch, command):
    Path("in/list.txt").write_bytes(b"\xef\xbb\xbf# some\r\n\r\n deep/b.npz\r\nnone.npy\n")
    code, _, err = batch("in/list.txt")
    assert code == 1 and contents().keys() == {"deep/b.ply"}
    assert "Failed: in/none.npy: does not exist\n" in err
    np.save("in/a.npy", -2 * ball(12, 3.0).values)
    line = {"in": "in/a.npy", "out": "x/y.stl", "spacing": 2, "origin": [1, 2, 3], "factor": 4}
    lines = [{**line, "inside": "positive", "offset": 1}, {"in": "in/deep/er/c.d.npy"}]
    Path("list.jsonl").write_text("\n".join(map(json.dumps, lines)))
    assert batch("list.jsonl")[1]["done"] == 2
    options = ("--spacing", 2, "--origin", "1,2,3", "--inside", "positive", "--offset", 1)
    command("upsample", "in/a.npy", "single.stl", *options, "--quality", "fast")
    assert Path("single.stl").read_bytes() == Path("out/x/y.stl").read_bytes()


LISTS = {
    "": "list.jsonl names no file: give a path a line",
    '{"in": "a",}': "list.jsonl, line 1: no JSON from character 12 on, '}': give an object such as",
    "[]": 'list.jsonl, line 1: it is []: give an object such as {"in": "a.npy"}\n',
    '{"in": "a.npy", "labels": 2}': "list.jsonl, line 1: labels is 2: give all, or some labels",
    '{"out": "a.ply"}': "list.jsonl, line 1: 'in' is None: give the path of a grid",
    '{"in": "a\\u0000.npy"}': "list.jsonl, line 1: 'in' is 'a\\x00.npy': give the path of a grid",
    '\n{"in": "a.npy", "factor": 3}': "list.jsonl, line 2: factor is 3: give an even number",
    '{"in": "a.npy", "Factor": 2}': "list.jsonl, line 1: 'Factor' is unknown: give in, out, "
    + BATCH_LISTS[0],
    '{"in": "a.npy", "out": "a.xyz"}': "list.jsonl, line 1: 'out' is 'a.xyz': give a file, one of "
    + MESH_SUFFIXES[0],
    '{"in": "a.npy", "out": "a/../../b.ply"}': "list.jsonl, line 1: 'out' is 'a/../../b.ply': give",
}
KINDS = ", ".join(GRID_SUFFIXES)
NO_GRIDS = {
    "none.npy": "none.npy does not exist: give grids, folders or lists\n",
    "in/*.raw": f"in/*.raw holds no grid ({KINDS})\n",
    "empty": f"empty holds no grid ({KINDS})\n",
    "odd.raw": f"odd.raw is neither a grid ({KINDS}) nor a list (.txt, .jsonl)\n",
}


@pytest.mark.parametrize("words", [*LISTS, *NO_GRIDS], ids=range(len(LISTS) + len(NO_GRIDS)))
def test_lists_and_arguments_without_meaning_are_refused_before_the_work(command, words):
    Path("list.jsonl").write_text(words)
    Path("empty").mkdir()
    Path("odd.raw").write_text("")
    given = words if words in NO_GRIDS else "list.jsonl"
    code, out, err = command("batch", "in/a.npy", given, "--out", "out")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"Error: {(LISTS | NO_GRIDS)[words]}") and not Path("out").exists()


def test_odd_files_and_names_fail_alone(batch):
    os.mkfifo("in/pipe.npy")
    Path("in/loop.npz").symlink_to("loop.npz")
    os.link("in/bad.npy", b"in/bad\n\xff.npy")
    long = 300 * "n"
    Path("in/list.jsonl").write_text(
        f'{{"in": "{long}.npy"}}\n{{"in": "a.npy", "out": "m{long}.ply"}}'
    )
    code, facts, err = batch("in", "in/list.jsonl")
    assert code == 1 and (facts["done"], facts["failed"]) == (3, 6), err
    assert "Failed: in/pipe.npy: is no regular file: give a file\n" in err
    assert "Failed: in/loop.npz: cannot be read: " in err
    assert "Failed: in/bad\\n\\udcff.npy: every value is 1" in err
    assert f"{Path('out', 'm' + long)}.ply cannot be written: File name too long\n" in err


# The report


@pytest.mark.parametrize("torn", [b'{"in": "x", "out": "a.p', b"\xff\xfe"])
def test_a_torn_line_is_cut_off_and_its_file_made_again(batch, torn):
    batch("in")
    lines = Path("out/report.jsonl").read_bytes().splitlines(keepends=True)
    Path("out/report.jsonl").write_bytes(b"".join(lines[:-1]) + torn)
    batch("in", "--force")
    assert {row["out"] for row in rows()[:4]} == {row["out"] for row in map(json.loads, lines[:3])}
    assert len(rows()) == 7


def test_a_batch_that_was_killed_before_it_moved_a_mesh_makes_it_again(batch, monkeypatch):
    right = os.replace

    def die(part, path):
        return sys.exit(9) if Path(path) == Path("out/a.ply") else right(part, path)

    with monkeypatch.context() as patch, pytest.raises(json.JSONDecodeError):
        patch.setattr(os, "replace", die)
        batch("in/a.npy")
    assert len(rows()) == 1 and not Path("out/a.ply").exists()
    assert batch("in/a.npy")[1]["done"] == 1 and is_made(rows()[-1])


@pytest.mark.parametrize("text", [b"a,b\n1,2\n", b'{"in": "a.npy"}\n{"in": "b', b"[]\n"])
def test_a_report_of_others_is_left_alone(command, text):
    Path("out").mkdir()
    Path("out/report.jsonl").write_bytes(text)
    said = command("batch", "in", "--out", "out", "--force")
    assert said[0] == 1 and "out/report.jsonl is not a batch's report: move it, or give" in said[2]
    assert Path("out/report.jsonl").read_bytes() == text and not list(Path("out").glob("*.ply"))


# Processes


def answer(task):
    """Answer a number by its square, and die at a word."""
    if task == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if task == "ended":
        os._exit(3)
    if task == "no network":
        raise SuperSdfError(task)
    return task * task


def worked(tasks, count=2):
    """Return what came of tasks in processes."""
    left = list(tasks)
    return dict(work_in_processes(lambda: left.pop(0) if left else None, answer, count))


def test_a_death_is_the_result_of_its_task_alone():
    deaths = {
        "killed": Death("was killed by SIGKILL (most likely out of memory)"),
        "ended": Death("ended with exit code 3"),
    }
    assert worked([1, *deaths, 2, 3]) == {1: 1, 2: 4, 3: 9, **deaths}
    with pytest.raises(SuperSdfError, match="no network"):
        worked([1, "no network"])


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_batch_that_is_ended_or_killed_leaves_no_process_and_goes_on(number, batch):
    larger_grids(8)
    words = ("batch", "in", "--out", "out", "--jobs", 2, "--threads", 1, *SMALL)
    process = start_command(*words, "--json")
    wait_for_lines(process, Path("out/report.jsonl"))
    workers = psutil.Process(process.pid).children()
    process.send_signal(number)
    out, err = process.communicate(timeout=PATIENCE)
    assert len(workers) >= 2 and all_end(workers)
    if number != signal.SIGKILL:
        facts = json.loads(out)
        assert process.returncode == 128 + number and err.strip() == f"Error: {facts['error']}"
        assert " done, " in err and err.endswith(" s; run it again to go on\n")
        assert facts["done"] and facts["done"] + facts["failed"] + facts["to_do"] == 12
        assert not Path("out/.super-sdf-parts").exists()
    finished = len(rows())
    facts = batch("in", "--spacing", 1, "--origin", "0")[1]
    assert facts["failed"] + facts["failed_before"] == 1 and facts["closed"] == 11
    assert len(rows()) >= 12 and finished >= 2 and not Path("out/.super-sdf-parts").exists()


def test_ctrl_c_while_workers_start_is_one_line():
    """A terminal sends it to the workers, too."""
    process = start_command("batch", "in", "--out", "out", "--jobs", 2, *SMALL, "--factor", 16)
    workers = psutil.Process(process.pid).children

    def import_numpy():
        return any("numpy" in each.path for one in workers() for each in one.memory_maps())

    assert processes.wait_until(import_numpy)
    os.killpg(process.pid, signal.SIGINT)
    err = process.communicate(timeout=PATIENCE)[1].strip()
    assert process.returncode == 130 and err.startswith("Error: ") and "\n" not in err


@pytest.mark.skipif(sys.version_info < (3, 11), reason="PYTHONSAFEPATH is of Python 3.11")
def test_nothing_of_the_current_folder_is_run(tmp_path_factory):
    """Files there have names of modules of Python and of libraries; the command lies elsewhere."""
    for name in ("abc", "io", "multiprocessing", "runpy", "struct", "numpy", "psutil", "signal"):
        Path(f"{name}.py").write_text("open('ran.txt', 'a')\nraise ImportError")
    script = tmp_path_factory.mktemp("elsewhere") / "command.py"
    script.write_text(COMMAND.replace("main()", "if __name__ == '__main__': main()"))
    words = ("batch", "in", "--out", "out", "--jobs", 2, *SMALL)
    sources = str(Path(super_sdf.__file__).parent.parent)
    call, env = [sys.executable, script, *map(str, words)], os.environ | {"PYTHONPATH": sources}
    env.pop("PYTHONSAFEPATH", None)  # of a batch before, in this process
    done = subprocess.run(call, env=env, stderr=subprocess.PIPE, text=True)
    assert "3 done, 1 failed" in done.stderr and not Path("ran.txt").exists()


HOLD = "import sys; from pathlib import Path; from super_sdf.batch.record import folder_lock\n"
HOLD += "with folder_lock(Path('out')): print('held', flush=True); sys.stdin.read()"


def test_a_lock_is_exclusive_among_processes_and_ends_with_its_own(batch, command):
    words = [sys.executable, "-c", HOLD]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"held\n"
        want = "Error: out is in use by another batch: wait for it, or give another\n"
        assert command("batch", "in/a.npy", "--out", "out", *LONE) == (1, "", want)
        assert batch("in/a.npy", "--dry-run")[0] == 0
        holder.kill()
        holder.wait()
        assert batch("in/a.npy")[0] == 0


# Labels


@pytest.fixture
def cases():
    """Write six label images with three organs that touch; two have no third one."""
    Path("cases").mkdir()
    for number in range(6):
        at = np.stack(np.indices((12,) * 3), -1)
        middles = 6 + np.array([[-2, 0, 0], [2, 0, 0.2], [0, 2, number / 3 - 1]])
        far = np.linalg.norm(at[..., None, :] - middles, axis=-1)
        labels = np.where(far.min(-1) < 3, far.argmin(-1) + 1, 0).astype(np.uint8)
        labels[(labels == 3) & (number % 3 == 2)] = 0
        np.savez(f"cases/{number}.npz", values=labels, spacing=(1, 0.75, 2))
    Path("organs.csv").write_text("1,liver\n2,spleen\n3,aorta\n")


def test_each_case_has_the_files_of_upsample_and_a_row(cases, command):
    def run(*words):
        given = ("--names", "organs.csv", "--format", "stl", *FAST, "--factor", 2, "--json")
        code, out, err = command("batch", *words, "--out", "out", "--labels", "all", *given)
        return code, json.loads(out), err

    code, facts, _ = run("cases")
    assert code == 0 and (facts["done"], facts["closed"]) == (6, 16)
    assert len(contents()) == 16 and all(map(is_made, rows()))
    words = ("--labels", "all", "--names", "organs.csv", *FAST, "--factor", 2, "--json", "-q")
    single = json.loads(command("upsample", "cases/2.npz", "one.stl", *words)[1])["labels"]
    row = next(row for row in rows() if row["out"] == "2-*.stl")
    assert [each["name"] for each in row["labels"]] == ["liver", "spleen"]
    for ours, theirs in zip(row["labels"], single, strict=True):
        assert Path("out", ours["output"]).read_bytes() == Path(theirs["output"]).read_bytes()
        assert {**ours, "output": 0} == {**theirs, "output": 0}
    assert run("cases")[1]["done_before"] == 6
    Path("out/1-liver.stl").unlink()  # as if killed between two files
    shutil.copy("cases/2.npz", "cases/0.npz")
    facts = run("cases")[1]
    assert (facts["done"], facts["done_before"]) == (2, 4) and Path("out/1-liver.stl").exists()
    assert {row["out"]: row["beside"] for row in rows()[-2:]} == {
        "0-*.stl": ["0-aorta.stl"],
        "1-*.stl": [],
    }
    Path("out/3-spleen.stl").write_text("mine")
    code, _, err = run("cases")
    assert code == 1 and "out/3-spleen.stl exists and was changed after a batch made it" in err


def test_formats_with_parts_listed_labels_and_names_in_lists(cases, command):
    entries = [
        {"in": "cases/0.npz", "out": "x/a.3mf", "labels": ["liver", 2]},
        {"in": "cases/2.npz", "labels": ["aorta", 1]},
        {"in": "cases/1.npz", "label": 2},
    ]
    Path("list.jsonl").write_text("\n".join(map(json.dumps, entries)))
    words = ("batch", "list.jsonl", "--names", "organs.csv", "--format", "glb", *FAST)
    code, _, err = command(*words, "--factor", 2, "--out", "out")
    assert code == 0, err
    assert contents().keys() == {"cases/1-label2.glb", "cases/2.glb", "x/a.3mf"}
    missing = {row["out"]: row.get("missing") for row in rows()}
    assert missing["cases/2.glb"] == [{"label": 3, "name": "aorta"}]
    Path("list.jsonl").write_text('{"in": "cases/0.npz", "labels": ["lung"]}')
    code, _, err = command(*words, "--out", "new")
    assert code == 2 and "labels has 'lung': give numbers, or names of" in err
