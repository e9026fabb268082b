"""Figures are measured once, quoted as measured, and of one network and machine each."""

from __future__ import annotations

import json
import sys

import pytest
from solids import cube, saved, torus

from lab import documents, figures, quoted
from lab.__main__ import main as lab
from lab.documents import rendered
from super_sdf.errors import FileError

MACHINE = {
    "processor": "a processor", "cores": 2, "instructions": ["avx2"], "system": "Linux",
    "python": "3.11", "numpy": "2", "onnxruntime": "1.32",
}  # fmt: skip


def figure(folder, name: str, rows: list[dict]) -> None:
    """Write a figure's file."""
    content = {"name": name, "networks": {"base": "0123"}, "commit": "abc", "date": "2026-01-01"}
    content |= {"machine": MACHINE, "rows": rows}
    (folder / f"{name}.json").write_text(json.dumps(content))


@pytest.fixture
def speeds(tmp_path):
    """A folder with figures of speed."""
    rows = [
        {"size": 32, "option": "default", "seconds": 0.5, "peak_mb": 100.0},
        {"size": 64, "option": "default", "seconds": 1.0, "peak_mb": 1234.0},
        {"size": 64, "option": "scipy", "seconds": 16.2, "peak_mb": 400.0},
        {"size": 64, "option": "fast", "seconds": 0.92, "peak_mb": 200.0},
    ]
    figure(tmp_path, "speed", rows)
    return tmp_path


def test_tables_and_numbers_stand_where_they_are_marked(speeds):
    text = "a\n<!-- figures: speed.process -->\nold\n<!-- /figures -->\nb"
    assert rendered(text, speeds).splitlines()[3:6] == [
        "|  | 32^3 | 64^3 |",
        "| --- | ---: | ---: |",
        "| default | 0.50 | 1.00 |",
    ]
    assert rendered(rendered(text, speeds), speeds) == rendered(text, speeds)
    for marker, shown in {
        "speed.seconds 32 default": "0.50",
        "speed.peak_mb 64 default": "1,234",
        "speed.seconds 64 scipy over 64 default": "16",
        "speed.seconds 64 default over 32 default": "2.0",
    }.items():
        line = f"it is <!-- figures: {marker} -->?<!-- /figures --> so"
        assert rendered(line, speeds) == line.replace("?", shown)
    for known, shown in (("", "(not measured)"), (".9", ".9")):  # what is not measured stays
        line = f"it is <!-- figures: quality.f1 32 base -->{known}<!-- /figures --> so"
        assert f"-->{shown}<!--" in rendered(line, speeds)
    assert "2 cores of a processor (avx2)" in quoted.shown("speed.about", speeds)


@pytest.mark.parametrize(
    ("marker", "said"),
    [
        ("spead.process", "there is no figure 'spead'"),
        ("speed.procss", "there is no table 'speed.procss'"),
        ("speed.scnds 32", "there is no column 'scnds'"),
        ("speed.seconds 33 default", "no row has 33 default"),
    ],
)
def test_a_marker_that_means_nothing_is_named(speeds, marker, said):
    with pytest.raises(FileError, match=said):
        rendered(f"<!-- figures: {marker} -->x<!-- /figures -->", speeds)
    with pytest.raises(FileError, match="is not ended"):
        rendered("<!-- figures: speed.process -->", speeds)


def test_documents_show_what_was_measured():
    differ = []
    for path in documents.documents():
        text = path.read_text(encoding="utf-8")
        if rendered(text) != text:
            differ.append(path.name)
    assert not differ, "run python -m lab documents"


@pytest.fixture
def shapes(tmp_path):
    """A folder of two shapes."""
    for name, mesh in {"box": cube(), "ring": torus()}.items():
        saved(mesh, tmp_path / f"{name}.ply")
    return tmp_path


def run(monkeypatch, *words: object) -> int:
    monkeypatch.setattr(sys, "argv", ["lab", "figures", *map(str, words)])
    return lab()


def test_figures_are_measured_kept_and_printed(shapes, tmp_path, monkeypatch, capsys):
    words = ("--shapes", shapes, "--parts", shapes, "--sizes", 8, "--jobs", 0, "--only", "simplify")
    out = tmp_path / "out"
    assert run(monkeypatch, *words, "--out", out) == 0
    printed = capsys.readouterr().out
    assert "simplify.table" in printed and "| CAD parts, marching | CAD parts, sharp |" in printed
    content = quoted.read(out / "simplify.json")
    assert len(content["rows"]) == 8 and content["networks"].keys() == {"base"}
    (out / "simplify.json").unlink()
    monkeypatch.setattr("lab.rows.measure_task", None)  # nothing is measured again
    assert run(monkeypatch, *words, "--out", out) == 0
    assert quoted.read(out / "simplify.json")["rows"] == content["rows"]
