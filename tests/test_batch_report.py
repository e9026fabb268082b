"""The report and the journal of a batch: what they promise when disks fill and others write."""

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh
from batches import LONE, rows

from super_sdf.batch import job as batch_job
from super_sdf.batch.ledger import is_row

pytestmark = pytest.mark.usefixtures("grid_folder")


@pytest.mark.parametrize("torn", [b'{"in": "x", "out": "a.p', b"\xff\xfe"])
def test_a_torn_line_is_cut_off(run_batch, torn):
    run_batch("in")
    lines = Path("out/report.jsonl").read_bytes().splitlines(keepends=True)
    Path("out/report.jsonl").write_bytes(b"".join(lines[:-1]) + torn)
    run_batch("in")
    assert len(rows()) == 4 and rows()[-1]["out"] == json.loads(lines[-1])["out"]


def test_a_file_of_another_origin_is_not_replaced_nor_one_that_appears_meanwhile(
    run_batch, monkeypatch
):
    Path("out").mkdir()
    Path("out/a.ply").write_text("mine")
    reason = f"{Path('out/a.ply')} exists and was not made by a batch: remove it or use --force"
    words = "nothing to do: 0 done before, 1 refused; 0 meshes closed, 0 open"
    for _ in range(2):
        assert run_batch("in/a.npy") == (1, "", f"Failed: in/a.npy: {reason}\n{words}\n")
        assert Path("out/a.ply").read_text() == "mine" and len(rows()) == 1
    assert run_batch("in/a.npy", "--force")[0] == 0
    assert trimesh.load("out/a.ply").is_watertight
    right = batch_job.convert

    def interfere(source, target, *rest, **options):
        target.write_text("mine")
        return right(source, target, *rest, **options)

    monkeypatch.setattr(batch_job, "convert", interfere)
    for _ in range(2):
        assert run_batch("in/a.npy", out="new")[0] == 1
        assert Path("new/a.ply").read_text() == "mine"


@pytest.mark.parametrize(
    "text", [b"a,b\n1,2", b'{"in": "a.npy"}', b'{"in": "a.npy"}\n{"in": "b', b"[]\n", b"\0\0\0\n"]
)
def test_a_report_of_others_is_left_alone(run_batch, text):
    Path("out").mkdir()
    Path("out/report.jsonl").write_bytes(text)
    want = (
        f"Error: {Path('out/report.jsonl')} is not a batch's report: move it, or give another "
        "folder for the meshes\n"
    )
    for option in ((), ("--force",), ("--dry-run",)):
        assert run_batch("in", *option) == (1, "", want)
    assert Path("out/report.jsonl").read_bytes() == text and list(Path("out").glob("*.ply")) == []


@pytest.mark.parametrize("text", [b"", b"{", b'{"in": "/x", "out": "a'])
def test_a_report_that_was_just_begun_is_gone_on_with(run_batch, text):
    Path("out").mkdir()
    Path("out/report.jsonl").write_bytes(text)
    assert run_batch("in/a.npy")[0] == 0 and len(rows()) == 1


@pytest.mark.parametrize("name", ["report.jsonl", ".super-sdf-batch"])
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_pipes_and_folders_of_the_batchs_names_are_refused(run_batch, name, make):
    Path("out").mkdir()
    make(Path("out", name))
    code, _, err = run_batch("in")
    assert code == 1 and err.startswith(f"Error: {Path('out', name)} is ") and err.count("\n") == 1


def test_rows_with_wrong_types_and_lines_of_others_are_passed_over(run_batch):
    run_batch("in/a.npy")
    (row,) = rows()
    wrong = {
        **{"in": 1, "out": ["a.ply"], "status": None, "reason": {}, "retry": "no", "options": 0},
        **{"content": "x", "output": {"sha256": 1}, "closed": None},
    }
    damaged = [{**row, key: value} for key, value in wrong.items()]
    assert is_row(row) and not any(map(is_row, damaged))
    lines = [b"nonsense", b"[1]", 100_000 * b"[", b'{"reason": 1' + 5000 * b"0" + b"}"]
    report = Path("out/report.jsonl")
    lines += [report.read_bytes().strip(), *(json.dumps(each).encode() for each in damaged)]
    report.write_bytes(b"a\rb\n" + b"\n".join(lines) + b"\n")
    before = report.read_bytes()
    assert run_batch("in/a.npy")[2].startswith("nothing to do: 1 done before")
    assert report.read_bytes() == before


def limited(size):
    """Convert in a process whose files have so many bytes at most; return code and stderr."""
    words = [sys.executable, "-m", "super_sdf", "batch", "in/a.npy", "in/deep", "--out", "out"]
    done = subprocess.run(
        [*words, *map(str, LONE)],
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)),
    )
    return done.returncode, done.stderr


def test_a_row_without_room_is_an_error_and_not_torn(run_batch):
    run_batch("in/a.npy")
    mesh, first = Path("out/a.ply"), Path("out/report.jsonl").read_bytes()
    row = first.replace(b'"in": "', b'"in": "' + 2 * mesh.stat().st_size * b"x")
    Path("out/report.jsonl").write_bytes(row)  # now there is room for meshes, and not for rows
    code, err = limited(len(row) + 100)
    assert code == 1
    assert err == f"Error: {Path('out/report.jsonl')} cannot be written: File too large\n"
    assert Path("out/report.jsonl").read_bytes() == row
    assert len(list(Path("out").rglob("*.ply"))) == 2
    Path("out/report.jsonl").write_bytes(first)
    assert run_batch("in/a.npy", "in/deep")[0] == 0  # the mesh without a row is known again
    assert Path("out/.super-sdf-batch").read_bytes() == b""


def test_a_mesh_without_room_fails_by_its_name_and_leaves_nothing():
    code, err = limited(4000)
    assert code == 1
    want = f"Failed: in/a.npy: {Path('out/a.ply')} cannot be written: File too large\n"
    assert want in err and "Traceback" not in err
    assert [path.name for path in Path("out").rglob("*.p*")] == []


def test_only_its_own_content_makes_a_mesh_the_batchs(run_batch):
    """A batch was killed before it could write the row."""
    run_batch("in/a.npy")
    os.remove("out/report.jsonl")
    Path("out/.super-sdf-batch").write_text('"a.ply"\n')
    mesh = Path("out/a.ply").read_bytes()
    Path("out/a.ply").write_bytes(mesh + b" ")
    assert "out/a.ply exists and is not what this batch makes: remove" in run_batch("in/a.npy")[2]
    assert Path("out/a.ply").read_bytes() == mesh + b" "
    Path("out/a.ply").write_bytes(mesh)
    assert run_batch("in/a.npy")[0] == 0
    os.remove("out/report.jsonl")
    assert "exists and was not made by a batch" in run_batch("in/a.npy")[2]


def test_nothing_outside_the_folder_is_removed(run_batch):
    Path("out").mkdir()
    Path(".x.ply.1.part").touch()
    lines = [json.dumps(name) for name in ("../x.ply", os.path.abspath("x.ply"), [1], "y.ply")]
    damaged = ["\n".join(lines).encode(), 100_000 * b"[", b"\xff", b'"to']
    Path("out/.super-sdf-batch").write_bytes(b"\n".join(damaged))
    Path("out/.y.ply.1.part").touch()
    assert run_batch("in/a.npy")[0] == 0
    assert Path(".x.ply.1.part").exists() and not Path("out/.y.ply.1.part").exists()
