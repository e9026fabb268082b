"""The evaluation as a whole: kept rows, processes that die, reports that come out the same."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from processes import wait_for_lines
from solids import cube, saved, sphere, torus

from lab import costs, evaluate, tables
from lab.__main__ import main as lab
from lab.evaluate import Results
from lab.measuring import Task
from lab.rows import LeftOut, Rows
from lab.shapes import Setting, find_meshes
from super_sdf import Mesh, SuperSdfError

ROOT = Path(__file__).parents[2]
TIMES = ("seconds", "peak_mb")
FAST = ("--methods", "mc", "ours", "--model", "fast", "--jobs", 0)


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    """A folder of three shapes."""
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


def task_of(path: Path, methods: tuple[str, ...] = ("mc",), **options) -> Task:
    return Task(path, Setting(8), methods, **options)


def quality_of(out: Path) -> dict[str, dict]:
    """Return the figures of each row but for times."""
    rows = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    return {
        json.dumps(row["key"]): {name: v for name, v in row.items() if name not in TIMES}
        for row in rows
    }


def test_killed_and_started_again_it_ends_with_the_same_tables(meshes, tmp_path, command):
    (meshes / "ring.ply").unlink()
    words = ["evaluate", meshes, "--sizes", 8, "--methods", "mc", "--jobs", 1]
    words += ["--out"]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert command(*words, whole)[0] == 0
    child = subprocess.Popen(
        [sys.executable, "-m", "lab", *map(str, words), str(cut)],
        cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    store = cut / "results.jsonl"
    wait_for_lines(child, store)
    child.kill()
    child.wait()
    with store.open("a") as file:
        file.write('{"key": "torn')  # as if killed while writing
    assert len(store.read_text().splitlines()) < len(quality_of(whole)) + 1
    assert command(*words, cut)[0] == 0
    store.write_text(store.read_text().replace('{"key": "torn\n', ""))
    assert quality_of(cut) == quality_of(whole)
    texts = [(out / "report.md").read_text().split("## Time")[0] for out in (cut, whole)]
    assert texts[0] == texts[1]
    code, _, err = command(*words, cut)
    assert (code, err) == (0, "")  # nothing is left to measure


def test_a_bad_shape_is_named_and_the_others_are_measured(meshes, tmp_path, command):
    saved(Mesh(cube().vertices, cube().faces[1:]), meshes / "lidless.ply")
    (meshes / "junk.stl").write_text("junk")
    out = tmp_path / "out"
    words = (*FAST, "--turned", 5, "--out", out)
    code, _, err = command("evaluate", meshes, "--sizes", 8, *words)
    assert code == 1
    assert "Left out: lidless: " in err and "is open: 3 edges" in err and "out: junk: " in err
    text = (out / "report.md").read_text()
    assert "# Quality of super-sdf on 3 shapes" in text and "Left out, lidless: " in text
    assert "| super-sdf |" in text and "3 of 3" in text
    assert "turned at random, by seed 5" in text


def test_failures_are_tried_again_but_not_what_ran_out_of_time(tmp_path):
    rows, key = Rows(tmp_path / "rows.jsonl"), {"shape": "box"}
    rows.add(key, {"error": "OSError: disk"})
    assert not rows.is_final(key)
    rows.add(key, {"error": "over the limit of 10 s", "limit": 10.0})
    assert rows.is_final(key, 10.0) and not rows.is_final(key, 20.0)


def row(shape: str, f1: float, **more) -> dict:
    """Return a row that is made up."""
    keys = [column.key for column in tables.BY_KEY.values()]
    figures = {**dict.fromkeys(keys, 0.001), "f1": f1, "closed": True, "outward": True, "faces": 4}
    return {"shape": shape, **figures, "error": None, "notes": [], **more}


def test_a_shape_that_failed_in_a_setting_is_left_out_for_all_methods(meshes, tmp_path):
    rows, like = Rows(tmp_path / "rows.jsonl"), task_of(meshes / "box.ply", ("mc", "ours"))
    tasks = evaluate.tasks_of(find_meshes([meshes]), [Setting(8)], like)
    for task in tasks:
        for method in task.methods:
            rows.add(task.key(method), row(task.path.stem, 0.5, cd=0.25))
    rows.add(tasks[-1].key("ours"), {"error": "out of memory"})
    results = Results(tasks, rows, [LeftOut("lost", "it is")])
    assert results.left_out == [
        LeftOut("lost", "it is"),
        LeftOut("ring", "ours (8^3, factor 4): out of memory"),
    ]
    found = results.by_method(Setting(8), ("mc", "ours", "floor"))
    shapes = {name: [each["shape"] for each in some] for name, some in found.items()}
    assert shapes == {name: ["ball", "box"] for name in ("mc", "ours", "floor")}
    assert found["ours"][0]["excess_cd"] == 0 and len(results.floors) == 3


def test_tables_show_means_gaps_and_what_has_no_surface():
    by_method = {
        "bspline": [row("a", 0.5), row("b", 0.7)],
        "ours": [row("a", 0.8), row("b", 0.6)],
        "bound": [row("a", 1.0), row("b", 0.8)],
        "mc": [row("a", 0.5), row("b", 0.0, faces=0, closed=False, efv=None)],
    }
    halves = {"all": ["a", "b"], "choose": ["b"], "final": []}
    wins, gaps = evaluate.comparisons(by_method, halves)
    assert wins == "super-sdf beats B-spline in F1 on 1 of 2. Not on: b (0.600, B-spline 0.700)."
    assert "| all (2) | 0.7, 33.3 % |" in gaps and "| choose (1) | 0.6, -100.0 % |" in gaps
    assert "final" not in gaps
    lines = tables.surface_table([{"method": "mc", **tables.summary(by_method["mc"])}], 32)
    mine = next(line for line in lines.splitlines() if line.startswith("| MC |"))
    assert "| 0.250 |" in mine and mine.endswith("| 1 of 2 |")
    assert "*PoNQ, published, Thingi30*" in lines
    assert evaluate.odd_meshes(by_method) == ["No surface (a dot stands in), MC: b."]
    label = tables.label_of("ours-marching/4@base:float32")
    assert label == "super-sdf, marching, base, float32, 1/4"


def test_a_process_is_timed(tmp_path):
    grid = costs.write_torus(tmp_path / "torus.npy", 12)
    taken = costs.run_python(costs.upsample_words(grid, "--spacing", "0.0833"))
    assert taken.seconds > 0.05 and 20 < taken.peak_mb < 2000 and not taken.code
    with pytest.raises(SuperSdfError, match=r"upsample none\.npz .* ended with 1: Error: none"):
        costs.run_python(costs.upsample_words(Path("none.npz")))
    assert costs.run_python(["-c", "print('hi')"]).printed == "hi"
