"""The evaluation as a whole: kept rows, reports that come out the same, figures as measured."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from solids import cube, saved, sphere, torus

from lab import costs, documents, tables
from lab.__main__ import main as lab
from lab.documents import rendered
from lab.metrics import METRICS, Metric
from lab.rows import Rows
from super_sdf import Mesh, SuperSdfError
from super_sdf.errors import FileError

MACHINE = {
    "processor": "a processor", "cores": 2, "instructions": ["avx2"], "system": "Linux",
    "python": "3.11", "numpy": "2", "onnxruntime": "1.32",
}  # fmt: skip


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    folder = tmp_path / "meshes"
    folder.mkdir()
    for name, mesh in {"box": cube(), "ball": sphere(), "ring": torus()}.items():
        saved(mesh, folder / f"{name}.ply")
    return folder


@pytest.fixture
def command(capsys, monkeypatch):
    """Run ``python -m lab`` in this process; return exit code, stdout and stderr."""

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["lab", *map(str, words)])
        try:
            code = lab()
        except SystemExit as end:
            code = end.code
        return code, *capsys.readouterr()

    return run


def test_killed_and_started_again_it_ends_with_the_same_tables(meshes, tmp_path, command):
    words = ["evaluate", meshes, "--sizes", 8, "--methods", "mc", "--jobs", 0, "--out"]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert command(*words, whole)[0] == 0
    lines = (whole / "results.jsonl").read_text().splitlines(keepends=True)
    cut.mkdir()
    (cut / "results.jsonl").write_text(lines[0] + '{"key": "torn\n')  # killed while writing
    assert command(*words, cut)[0] == 0
    assert (cut / "report.md").read_text() == (whole / "report.md").read_text()
    code, _, err = command(*words, cut)
    assert (code, err) == (0, "")  # nothing is left to measure


def test_a_metric_is_an_entry_of_one_table(meshes, tmp_path, command, monkeypatch):
    words = ("evaluate", meshes, "--sizes", 8, "--methods", "mc", "--jobs", 0, "--out", tmp_path)
    command(*words)
    volume = Metric("volume", "volume %", 100, 0, of=lambda c: c.mesh.volume(), tables="edges",
                    meaning="of the mesh")  # fmt: skip
    monkeypatch.setitem(METRICS, "volume", volume)
    code, text, _ = command(*words)  # rows without it are measured again
    assert code == 0 and "| volume % | lower | of the mesh |" in text
    assert "| closed | volume % |\n" in text and "| 3 of 3 | 10 |\n" in text


def test_a_bad_shape_is_named_and_the_others_are_measured(meshes, tmp_path, command):
    saved(Mesh(cube().vertices, cube().faces[1:]), meshes / "lidless.ply")
    (meshes / "junk.stl").write_text("junk")
    fast = ("--methods", "mc", "ours", "--model", "fast", "--jobs", 2, "--turned", 5)
    code, _, err = command("evaluate", meshes, "--sizes", 8, *fast, "--out", tmp_path / "out")
    assert code == 1
    assert "Left out: lidless: " in err and "is open: 3 edges" in err and "out: junk: " in err
    text = (tmp_path / "out" / "report.md").read_text()
    assert "# Quality of super-sdf on 3 shapes" in text and "Left out, lidless: " in text
    assert "| super-sdf |" in text and "3 of 3" in text and "at random, by seed 5" in text


def test_failures_are_tried_again(tmp_path):
    rows, key = Rows(tmp_path / "rows.jsonl"), {"shape": "box"}
    rows.add(key, {"error": "OSError: disk"})
    assert not rows.is_final(key)
    rows.add(key, {"error": None, "f1": 0.5})
    assert rows.is_final(key)
    assert Rows(tmp_path / "rows.jsonl").get(key) == rows.get(key)


def test_a_process_is_timed(tmp_path):
    grid = costs.write_torus(tmp_path / "torus.npy", 12)
    seconds, peak, _ = costs.run_python(costs.upsample_words(grid, "--spacing", "0.0833"))
    assert seconds > 0.05 and 20 < peak < 2000
    with pytest.raises(SuperSdfError, match=r"upsample none\.npz .* ended with 1: Error: none"):
        costs.run_python(costs.upsample_words(Path("none.npz")))


@pytest.fixture
def speeds(tmp_path):
    rows = [
        {"size": 32, "option": "default", "seconds": 0.5, "peak_mb": 100.0},
        {"size": 64, "option": "default", "seconds": 1.0, "peak_mb": 1234.0},
        {"size": 64, "option": "zoom-cubic", "seconds": 16.2, "peak_mb": 400.0},
    ]
    content = {"name": "speed", "networks": {"base": "0123"}, "commit": "abc", "rows": rows}
    content |= {"machine": MACHINE, "date": "2026-01-01"}
    (tmp_path / "speed.json").write_text(json.dumps(content))
    return tmp_path


def test_tables_and_numbers_stand_where_they_are_marked(speeds):
    text = "a\n<!-- figures: speed.process -->\nold\n<!-- /figures -->\nb"
    assert "| default | 0.50 | 100 | 1.00 | 1,234 |" in rendered(text, speeds).splitlines()
    assert rendered(rendered(text, speeds), speeds) == rendered(text, speeds)
    for marker, shown in {
        "speed.seconds 32 default": "0.50",
        "speed.seconds 64 zoom-cubic over 64 default": "16",
    }.items():
        line = f"it is <!-- figures: {marker} -->?<!-- /figures --> so"
        assert rendered(line, speeds) == line.replace("?", shown)
    assert "2 cores of a processor (avx2)" in documents.shown("speed.about", speeds)
    for marker, said in {
        "spead.process": "there is no figure 'spead'",
        "speed.procss": "there is no table 'speed.procss'",
        "speed.scnds 32": "there is no column 'scnds'",
        "speed.seconds 33 default": "no row has 33 default",
    }.items():
        with pytest.raises(FileError, match=said):
            rendered(f"<!-- figures: {marker} -->x<!-- /figures -->", speeds)


def test_documents_show_what_was_measured():
    texts = {path: path.read_text(encoding="utf-8") for path in documents.documents()}
    differ = [path.name for path, text in texts.items() if rendered(text) != text]
    assert not differ, "run python -m lab documents"


def test_figures_are_measured_kept_and_printed(meshes, tmp_path, command):
    out = tmp_path / "out"
    words = ["figures", "--shapes", meshes, "--parts", meshes, "--sizes", 8, "--jobs", 0]
    code, printed, _ = command(*words, "--only", "simplify", "halves", "--out", out)
    assert code == 0 and "| 8^3 | others | super-sdf |" in printed
    assert "simplify.table" in printed and "| parts | super-sdf, marching |" in printed
    content = documents.read(out / "simplify.json")
    assert len(content["rows"]) == 4 and content["networks"].keys() == {"base"}
    assert tables.label_of("ours/4@base:float32") == "super-sdf, base, float32, 1/4"


def test_the_commands_are_listed(command):
    assert "evaluate" in command("--help")[1]
