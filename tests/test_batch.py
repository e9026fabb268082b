"""Many files: each as by itself, bad ones named, and a rerun goes on where the last one ended."""

import hashlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from batches import CONSTANT, FAST, LONE, PLAIN, files, rows
from conftest import ball
from onnx_files import entry

from super_sdf.batch import job as batch_job
from super_sdf.batch.job import Result, Settings
from super_sdf.batch.ledger import fingerprint, is_unchanged
from super_sdf.batch.plan import Batch
from super_sdf.cli.batch_report import describe_progress, duration
from super_sdf.convert import convert
from super_sdf.files.regular import files_of
from super_sdf.network.network import shipped_models

pytestmark = pytest.mark.usefixtures("grid_folder")


def test_folders_are_mirrored_failures_named_and_meshes_those_of_single_runs(run_batch, command):
    code, out, err = run_batch("in")
    assert (code, out) == (1, "")
    assert err == (
        f"Failed: in/bad.npy: {CONSTANT}\n"
        f"Note: 1 have notes on how they were read: see {Path('out/report.jsonl')}\n"
        "3 done, 1 failed; 3 meshes closed, 0 open\n"
    )
    made = {"a.ply": "a.npy", "deep/b.ply": "deep/b.npz", "deep/er/c.d.ply": "deep/er/c.d.npy"}
    assert files().keys() == made.keys() | {"report.jsonl"}
    code, _, _ = command("batch", "in", "--out", "two", *LONE[2:], "--threads", 1, "--jobs", 2)
    assert code == 1 and files("two").keys() == files().keys()
    for mesh, grid in made.items():
        command("upsample", f"in/{grid}", "single.ply", *LONE[2:], "--force")
        single = Path("single.ply").read_bytes()
        assert single == Path("out", mesh).read_bytes() == Path("two", mesh).read_bytes()


def test_the_report_holds_a_row_a_file_and_a_rerun_does_nothing(run_batch):
    run_batch("in")
    by_name = {row["out"]: row for row in rows()}
    assert len(rows()) == len(by_name) == 4
    mesh, row = trimesh.load("out/a.ply"), by_name["a.ply"]
    assert (row["vertices"], row["triangles"]) == (len(mesh.vertices), len(mesh.faces))
    assert row["in"] == os.path.abspath("in/a.npy") and row["status"] == "ok" and row["closed"]
    assert row["content"] == fingerprint(Path("in/a.npy"))
    assert row["output"] == fingerprint(Path("out/a.ply"))
    assert by_name["deep/er/c.d.ply"]["closed"] and by_name["deep/er/c.d.ply"]["capped"]
    bad = by_name["bad.ply"]
    assert (bad["status"], bad["reason"], bad["retry"]) == ("failed", CONSTANT, False)
    before, report = files(), rows()
    code, _, err = run_batch("in")
    assert (code, files(), rows()) == (1, before, report)
    assert err == (
        f"Failed: in/bad.npy: {CONSTANT}\nnothing to do: 3 done before, 1 failed before "
        "(--retry tries again); 3 meshes closed, 0 open\n"
    )
    os.remove("in/bad.npy")
    want = "nothing to do: 3 done before; 3 meshes closed, 0 open\n"
    assert run_batch("in") == (0, "", want)


def test_what_has_changed_is_done_again(run_batch, monkeypatch):
    def redone(*arguments):
        """Return the outputs that another run makes."""
        before = len(rows())
        run_batch("in", *arguments)
        return [row["out"] for row in rows()[before:]]

    run_batch("in")
    np.save("in/a.npy", ball(12, 3.2).values)
    assert redone() == ["a.ply"]
    os.utime("in/a.npy")
    Path("in/a.npy").rename("in/moved.npy")
    Path("in/moved.npy").rename("in/a.npy")
    assert redone() == []
    Path("out/deep/b.ply").unlink()
    assert redone() == ["deep/b.ply"]
    assert redone("--retry") == ["bad.ply"]
    assert len(redone("--offset", 0.5)) == 4
    assert redone("--offset", 0.5, "--threads", 1) == []
    assert run_batch("in/a.npy", "--offset", 100)[0] == 1  # a failure between
    assert redone("--offset", 0.5) == ["a.ply"] and rows()[-1]["status"] == "ok"
    assert "4 to do" in run_batch("in", "--offset", 0.5, "--force", "--dry-run")[2]
    monkeypatch.setattr("super_sdf.batch.plan.__version__", "next")
    assert "4 to do" in run_batch("in", "--offset", 0.5, "--dry-run")[2]


def test_a_mesh_that_was_changed_is_replaced_by_force_only(run_batch):
    run_batch("in/a.npy")
    made = Path("out/a.ply").read_bytes()
    os.utime("out/a.ply")
    assert "nothing to do: 1 done before" in run_batch("in/a.npy")[2]  # as it was made
    Path("out/a.ply").write_bytes(made[:-1] + b"x")
    why = "out/a.ply exists and was changed after a batch made it: remove it or use --force"
    for options in ((), ("--offset", 0.5), ("--retry",)):
        code, _, err = run_batch("in/a.npy", *options)
        assert code == 1 and err.startswith(f"Failed: in/a.npy: {why}\n") and "1 refused" in err
        assert Path("out/a.ply").read_bytes() == made[:-1] + b"x"
    assert "1 to do" in run_batch("in/a.npy", "--dry-run", "--force")[2]
    assert run_batch("in/a.npy", "--force")[0] == 0 and Path("out/a.ply").read_bytes() == made
    assert "nothing to do: 1 done before" in run_batch("in/a.npy")[2]


def test_each_label_has_a_mesh_of_its_own(run_batch):
    labels = np.where(ball(12, 4.0).values < 0, 2**64 - 1, 0).astype(np.uint64)
    labels[5:7, 5:7, 5:7] = 7
    np.save("labels.npy", labels)
    for label in (2**64 - 1, 7):
        assert run_batch("labels.npy", "--label", label)[0] == 0
    assert sorted(files()) == [f"labels-label{2**64 - 1}.ply", "labels-label7.ply", "report.jsonl"]
    Path("list.jsonl").write_text(
        "\n".join(f'{{"in": "labels.npy", "label": {label}}}' for label in (2**64 - 1, 7))
    )
    want = "nothing to do: 2 done before; 2 meshes closed, 0 open\n"
    assert run_batch("list.jsonl") == (0, "", want)


MHD = "ObjectType = Image\nNDims = 3\nDimSize = 12 12 12\nElementType = MET_FLOAT\n"
NRRD = "NRRD0004\ntype: float\ndimension: 3\nsizes: 12 12 12\nendian: little\nencoding: raw\n"
SLICES = "\n".join(f"part {z}.raw" for z in range(12))
HEADERS = {
    "x.mhd": (f"{MHD}ElementDataFile = part of it.raw\n", ["part of it.raw"]),
    "pattern.mhd": (
        f"{MHD}ElementDataFile = p[%02d.raw 0 11 1\n",
        [f"p[{z:02}.raw" for z in range(12)],
    ),
    "x.nrrd": (f"{NRRD}datafile:x.raw\n", ["x.raw"]),
    "list.nhdr": (f"{NRRD}data file: LIST\n{SLICES}\n", SLICES.split("\n")),
}


@pytest.mark.parametrize("name", HEADERS)
def test_the_fingerprint_of_a_header_covers_its_data(name):
    text, parts = HEADERS[name]
    Path(name).write_text(text)
    alone = fingerprint(Path(name))
    Path("other.raw").write_text("of no header")
    assert alone["sha256"] == hashlib.sha256(text.encode()).hexdigest()
    for part in parts:
        Path(part).write_text("x")
    known = fingerprint(Path(name))
    assert known["size"] == alone["size"] + len(parts) and is_unchanged(Path(name), known)
    assert files_of(name) == [Path(name), *sorted(map(Path, parts))]
    for part in parts:
        before = os.stat(part).st_mtime_ns
        Path(part).write_text("y")
        os.utime(part, ns=(before + 1, before + 1))  # such as a copy that keeps its time
        assert not is_unchanged(Path(name), known)
        Path(part).write_text("x")
        assert is_unchanged(Path(name), known)


def test_the_fingerprint_of_a_network_covers_weights_beside_it_and_is_an_option(run_batch):
    """Their names are those of entries "location" of its tensors; see onnx.proto."""
    names = ["weights.bin", "more weights.bin"]
    found = [entry(1, "location") + entry(2, name) for name in (*names, "not there.bin")]
    Path("own.onnx").write_bytes(b"".join(entry(13, each) for each in found))
    for name in names:
        Path(name).write_text("x")
    assert files_of("own.onnx") == [Path("own.onnx"), *sorted(map(Path, names))]
    shutil.copy(shipped_models()["fast"], "own.onnx")
    run_batch("in/deep", "--model", "own.onnx")
    shutil.copy(shipped_models()["base"], "own.onnx")
    assert "2 to do" in run_batch("in/deep", "--model", "own.onnx", "--dry-run")[2]


def test_an_input_is_never_written_over(run_batch):
    Path("out").mkdir()
    os.link(Path("in/deep/b.npz").absolute(), "out/a.ply")
    before = Path("in/deep/b.npz").read_bytes()
    code, _, err = run_batch("in", "--force")
    want = "Failed: in/a.npy: out/a.ply is the same file as in/deep/b.npz: remove that link\n"
    assert code == 1 and want in err and Path("in/deep/b.npz").read_bytes() == before


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (KeyError("odd\nthing"), "KeyError: 'odd\\nthing'"),
        (MemoryError(), "out of memory: use a smaller --factor or grid"),
    ],
)
def test_what_was_not_the_inputs_fault_stops_nothing_and_is_tried_again(
    run_batch, monkeypatch, error, reason
):
    def fail(source, *rest, **options):
        if source.name == "a.npy":
            raise error
        return convert(source, *rest, **options)

    monkeypatch.setattr(batch_job, "convert", fail)
    code, _, err = run_batch("in")
    assert code == 1 and f"Failed: in/a.npy: {reason}\n" in err
    assert err.endswith("2 done, 2 failed; 2 meshes closed, 0 open\n")
    monkeypatch.setattr(batch_job, "convert", convert)
    assert run_batch("in/a.npy") == (0, "", "1 done, 0 failed; 1 meshes closed, 0 open\n")


def test_two_inputs_for_one_output_are_refused_and_one_named_twice_is_one(run_batch):
    shutil.copy("in/deep/b.npz", "in/a.npz")
    want = (
        "Error: in/a.npy and in/a.npz would both become a.ply: rename one, or give 'out' in a "
        ".jsonl manifest\n"
    )
    assert run_batch("in") == (2, "", want) and not Path("out").exists()
    assert run_batch("in/a.npy", "in/a.npy", Path("in/a.npy").absolute())[0] == 0


def test_a_dry_run_says_what_would_be_done_and_writes_nothing(run_batch):
    code, out, err = run_batch("in", "--dry-run")
    assert code == 0 and f"to do: in/a.npy -> {Path('out/a.ply')}\n" in out
    assert err == "4 to do, 0 done before, 0 failed before, 0 refused\n" and out.count("\n") == 4
    assert not Path("out").exists()
    Path("in/list.txt").write_text("bad.npy\ndeep/b.npz\ndeep/er/c.d.npy")
    run_batch("in/list.txt")
    Path("out/a.ply").write_text("mine")
    np.save("in/new.npy", ball(12, 3.0).values)
    before, counts = files(), "1 to do, 2 done before, 1 failed before, 1 refused\n"
    _, out, err = run_batch("in", "in/new.npy", "--dry-run")
    assert f"done before: in/deep/b.npz -> {Path('out/deep/b.ply')}\n" in out and err == counts
    assert f"failed before: in/bad.npy: {CONSTANT}\n" in out and "refused: in/a.npy: " in out
    code, out, err = run_batch("in", "--dry-run", "--json")
    plan = json.loads(out)
    assert code == 0 and err == counts and files() == before
    assert plan["to_do"] == [{"in": os.path.abspath("in/new.npy"), "out": "new.ply"}]
    assert plan["failed_before"] == [
        {"in": os.path.abspath("in/bad.npy"), "out": "bad.ply", "reason": CONSTANT}
    ]
    assert [entry["out"] for entry in plan["refused"]] == ["a.ply"] and plan["unread"] == []


def test_json_is_the_summary_and_fail_fast_begins_nothing_after_a_failure(run_batch):
    code, out, err = run_batch("in", "--json", "--quiet", "--open")
    facts = json.loads(out)
    assert code == 1 and err == f"Failed: in/bad.npy: {CONSTANT}\n"
    assert facts.pop("seconds") > 0
    assert facts == {
        **{"done": 3, "done_before": 0, "failed": 1, "not_begun": 0, "closed": 2, "open": 1},
        "made_again": {"outputs": 0, "options": []},
        "failures": [{"in": os.path.abspath("in/bad.npy"), "out": "bad.ply", "reason": CONSTANT}],
        "report": str(Path("out/report.jsonl")),
    }
    Path("list.jsonl").write_text('{"in": "in/bad.npy"}\n{"in": "in/a.npy"}')
    np.save("in/bad.npy", np.ones((30, 30, 30)))  # the largest goes first
    for _ in range(2):
        code, _, err = run_batch("list.jsonl", "--fail-fast", out="new")
        assert code == 1
        assert err.endswith("\n0 done, 1 failed, 1 not begun; 0 meshes closed, 0 open\n")
    assert len(rows("new")) == 1


def test_what_was_noisy_is_said_once_and_of_many_failures_twenty(run_batch, command):
    noise = np.random.default_rng(0).uniform(-0.3, 0.3, (12, 12, 12))
    np.save("in/noisy.npy", ball(12, 4.0).values + noise)
    words = ("batch", "in", "--out", "out", *PLAIN[:4], *FAST)
    report, (_, _, err) = Path("out/report.jsonl"), command(*words)
    assert f"Note: 4 have notes on how they were read: see {report}\n" in err
    assert f"Warning: 1 are from noisy or contradictory values: see {report}\n" in err
    assert "Note" not in command(*words)[2]
    for i in range(23):
        shutil.copy("in/bad.npy", f"in/bad{i}.npy")
    _, _, err = run_batch("in/bad*.npy", out="more")
    assert err.count("Failed: ") == 20
    assert f"and 4 more, see {Path('more/report.jsonl')}\n" in err


def test_options_are_checked_before_the_work(run_batch, command):
    code, _, err = command("batch", "in", "--out", "out", "--factor", 3)
    assert code == 2 and err.startswith("Error: --factor is 3: give an even number")
    assert command("batch", "in")[0] == 2
    Path("taken").write_text("")
    want = "Error: taken cannot be written: File exists\n"
    assert run_batch("in", out="taken") == (1, "", want)
    want = "Error: no model 'none': give an ONNX file or one of: fast, base, best\n"
    assert run_batch("in", "--model", "none") == (1, "", want) and not Path("out").exists()
    Path("bad.onnx").write_text("x")
    code, _, err = command("batch", "in", "--out", "out", "--jobs", 2, "--model", "bad.onnx")
    assert code == 1 and err.startswith("Error: bad.onnx is no ONNX file that onnxruntime can run")


def test_progress_has_rate_and_time_left(run_batch, monkeypatch):
    result = Result(None, {})
    batch = Batch(Settings(Path("out")), done=[result] * 9, failed=[result], seconds=5.0)
    batch.work, batch.work_done = 400.0, 100.0
    assert describe_progress(batch, 30) == "10/30, 2 files/s, 15 s left, 1 failed"
    assert [duration(s) for s in (0.04, 59, 200, 7300)] == ["0.0 s", "59 s", "3 min", "2 h 2 min"]
    monkeypatch.setattr("super_sdf.cli.batch_report.sys.stderr.isatty", lambda: True)
    _, _, err = run_batch("in")
    assert err.startswith("0/4\r") and "\r1/4, " in err and "\r\x1b[KFailed: in/bad" in err
