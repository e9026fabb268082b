"""The table of gaps: halves, baselines from another report, and what does not count."""

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
    key |= {"digest": "", "protocol": PROTOCOL} | others
    return {"key": key, "f1": f1, "nc": f1 / 2, "p2s_back": 1 - f1, "error": None}


def report(folder, figures, shapes=MESHES, more=()):
    """Write a report of methods with their F1; return its folder."""
    folder.mkdir()
    rows = [row(path.stem, method, f1) for path in shapes for method, f1 in figures.items()]
    (folder / ROWS).write_text("".join(json.dumps(one) + "\n" for one in (*more, *rows)))
    return folder


@pytest.fixture
def baselines(tmp_path):
    """A report in which ours closes half of the gap, besides rows that must not count."""
    more = [row("shape-0", "ours", 0.0, digest="old"), row("shape-1", "ours", 0.1, noise=0.5)]
    return report(tmp_path / "base", {"ours": 0.6, "bspline": 0.4, "bound": 0.8}, more=more)


def test_the_gap_is_that_of_the_means_in_the_first_report_with_a_measurement(baselines, tmp_path):
    rows = list(gaps.gap_rows(MESHES, [baselines]))
    halves = [["32^3", "all", "3"], ["32^3", "choose", "1"], ["32^3", "final", "2"]]
    assert [cells[:3] for cells in rows] == halves
    assert rows[0][3:] == ["0.6000", "50.0 %", "0.3000", "50.0 %", "4,000.0000", "50.0 %"]
    best = report(tmp_path / "best", {"ours": 0.7})
    assert next(gaps.gap_rows(MESHES, [best, baselines]))[3:5] == ["0.7000", "75.0 %"]
    assert next(gaps.gap_rows(MESHES, [baselines, best]))[3:5] == ["0.6000", "50.0 %"]
    two = report(tmp_path / "two", {"bound": 0.8}, MESHES[:2])
    rest = report(tmp_path / "rest", {"ours": 0.5, "bspline": 0.5})
    assert next(gaps.gap_rows(MESHES, [two, rest]))[2] == "2"  # that all three have


def test_a_report_that_is_mistyped_or_lacks_the_baselines_is_refused(
    baselines, tmp_path, monkeypatch, capsys
):
    said = f"{tmp_path / 'bset'} has no results.jsonl: give the --out of python -m lab evaluate"
    with pytest.raises(FileError, match=f"^{re.escape(said)}$"):
        list(gaps.gap_rows(MESHES, [tmp_path / "bset", baselines]))
    monkeypatch.setattr(gaps, "find_meshes", lambda paths: MESHES)
    best = report(tmp_path / "best", {"ours": 0.7})
    monkeypatch.setattr("sys.argv", ["gaps", "FOLDER", str(best)])
    with pytest.raises(SystemExit) as ended:
        gaps.main()
    said = "no report has ours, bspline and bound at 32, 64 or 128: measure them first\n"
    assert ended.value.code == 2 and capsys.readouterr().err.endswith(said)
