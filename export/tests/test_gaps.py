"""The table of gaps: halves, baselines from another report, and what does not count."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path

import pytest

from export import gaps
from lab.evaluate import ROWS
from lab.measuring import PROTOCOL
from lab.shapes import Setting
from super_sdf.errors import FileError

MESHES = [Path(f"shape-{n}.ply") for n in range(3)]


def row(shape, method, f1, **others):
    """A measurement at 32^3 unless ``others`` say otherwise; NC and distance are made from F1."""
    key = {"shape": shape, "mesh": "", "turned": None, **asdict(Setting(32)), "method": method}
    key |= {"digest": "", "protocol": PROTOCOL}
    figures = {"f1": f1, "nc": f1 / 2, "p2s_back": 1 - f1, "error": None}
    changed = {name: value for name, value in others.items() if name in key}
    return {"key": key | changed, **figures, **others}


def write_report(folder, rows):
    """Write a report's measurements; return its folder."""
    folder.mkdir()
    (folder / ROWS).write_text("".join(json.dumps(one) + "\n" for one in rows))
    return folder


@pytest.fixture
def baselines(tmp_path):
    """A report in which ours closes half of the gap, besides rows that must not count."""
    shapes = [path.stem for path in MESHES]
    figures = {"ours": 0.6, "bspline": 0.4, "bound": 0.8}
    rows = [row(name, method, f1) for name in shapes for method, f1 in figures.items()]
    noisy = [row(name, "ours", 0.1, noise=0.5) for name in shapes]
    return write_report(
        tmp_path / "base", [row(shapes[0], "ours", 0.0, digest="old"), *rows, *noisy]
    )


def test_the_gap_is_that_of_the_means_for_all_shapes_and_each_half(baselines):
    rows = list(gaps.gap_rows(MESHES, [baselines]))
    assert [cells[:3] for cells in rows] == [
        ["32^3", "all", "3"],
        ["32^3", "choose", "1"],
        ["32^3", "final", "2"],
    ]
    assert rows[0][3:] == ["0.6000", "50.0 %", "0.3000", "50.0 %", "4,000.0000", "50.0 %"]


def test_the_first_report_with_a_measurement_counts(baselines, tmp_path):
    better = [row(path.stem, "ours", 0.7) for path in MESHES]
    best = write_report(tmp_path / "best", better)
    assert next(gaps.gap_rows(MESHES, [best, baselines]))[3:5] == ["0.7000", "75.0 %"]
    assert next(gaps.gap_rows(MESHES, [baselines, best]))[3:5] == ["0.6000", "50.0 %"]


def test_only_shapes_that_all_three_have_count(baselines, tmp_path):
    two = write_report(tmp_path / "two", [row(path.stem, "bound", 0.8) for path in MESHES[:2]])
    ours = [row(path.stem, m, 0.5) for path in MESHES for m in ("ours", "bspline")]
    assert next(gaps.gap_rows(MESHES, [two, write_report(tmp_path / "rest", ours)]))[2] == "2"


def test_a_mistyped_report_is_refused_not_left_out(baselines, tmp_path):
    said = f"{tmp_path / 'bset'} has no results.jsonl: give the --out of python -m lab evaluate"
    with pytest.raises(FileError, match=f"^{re.escape(said)}$"):
        list(gaps.gap_rows(MESHES, [tmp_path / "bset", baselines]))


def test_a_report_without_the_baselines_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gaps, "find_meshes", lambda paths: MESHES)
    report = write_report(tmp_path / "best", [row("shape-0", "ours", 0.7)])
    monkeypatch.setattr("sys.argv", ["gaps", "FOLDER", str(report)])
    with pytest.raises(SystemExit) as ended:
        gaps.main()
    assert ended.value.code == 2
    said = "no report has ours, bspline and bound at 32, 64 or 128: measure them first\n"
    assert capsys.readouterr().err.endswith(said)
