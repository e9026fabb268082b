"""The report and the journal of a batch: what they promise when disks fill and others write."""

import json
from pathlib import Path

import pytest
import trimesh
from batches import rows

pytestmark = pytest.mark.usefixtures("grid_folder")


@pytest.mark.parametrize("torn", [b'{"in": "x", "out": "a.p', b"{", b"\xff\xfe"])
def test_a_torn_line_is_cut_off(run_batch, torn):
    run_batch("in")
    lines = Path("out/report.jsonl").read_bytes().splitlines(keepends=True)
    Path("out/report.jsonl").write_bytes(b"".join(lines[:-1]) + torn)
    run_batch("in")
    assert len(rows()) == 4 and rows()[-1]["out"] == json.loads(lines[-1])["out"]


def test_lines_of_others_in_the_report_are_passed_over(run_batch):
    run_batch("in")
    report = Path("out/report.jsonl")
    report.write_bytes(b'nonsense\n[1]\n{"out": 1}\n' + report.read_bytes())
    assert run_batch("in")[2].splitlines()[-1].startswith("nothing to do: 3 done before")


def test_a_file_of_another_origin_is_not_replaced(run_batch):
    Path("out").mkdir()
    Path("out/a.ply").write_text("mine")
    reason = f"{Path('out/a.ply')} exists and was not made by a batch: remove it or use --force"
    words = "nothing to do: 0 done before, 1 refused; 0 meshes closed, 0 open"
    for _ in range(2):
        assert run_batch("in/a.npy") == (1, "", f"Failed: in/a.npy: {reason}\n{words}\n")
        assert Path("out/a.ply").read_text() == "mine" and len(rows()) == 1
    assert run_batch("in/a.npy", "--force")[0] == 0
    assert trimesh.load("out/a.ply").is_watertight
