"""The evaluation as a whole: kept rows, processes that die, reports that come out the same."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from click.testing import CliRunner
from processes import all_end, wait_for_lines
from solids import cube, saved, sphere, torus

from super_sdf import Mesh, SuperSdfError
from super_sdf.cli.main import cli
from super_sdf.errors import FileError, GridError, OptionError, WriteError
from super_sdf.evaluation import (
    cases,
    experiment_tables,
    measuring,
    methods,
    names,
    peers,
    published,
    report,
    runner,
    scope,
    tables,
    timing,
)
from super_sdf.evaluation import evaluate as whole
from super_sdf.evaluation.cases import Case, Setting, Shape, random_rotation
from super_sdf.evaluation.measuring import Task
from super_sdf.evaluation.results import Results
from super_sdf.evaluation.runner import LeftOut, Runner, complete
from super_sdf.evaluation.scope import Scope, find_meshes, spread
from super_sdf.evaluation.store import KEY_TYPES, Store, is_row
from super_sdf.machine.serving import ClockStarted
from super_sdf.network.network import KIND_MODELS, load_network, shipped_models

KILLED = "was killed by SIGKILL (most likely out of memory)"
QUALITY = ("cd", "f1", "nc", "signed_nc", "p2s", "ecd", "ef1", "field_mse", "faces", "closed")


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    """A folder of three shapes."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    for name, mesh in {"box": cube(), "ball": sphere(), "ring": torus()}.items():
        saved(mesh, folder / f"{name}.ply")
    return folder


def task_of(path: Path, methods: tuple[str, ...] = ("mc",), **options) -> Task:
    return Task(path, "sum", Setting(8), methods, "base", "digest", **options)


def evaluate(*words: object) -> subprocess.CompletedProcess[str]:
    """Run the command as a user does: its processes need a program that can be imported."""
    command = [sys.executable, "-m", "super_sdf", "evaluate", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True)


def quality_of(out: Path) -> dict[tuple, tuple]:
    """Return the figures of quality of each row."""
    rows = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    return {
        tuple(row[name] for name in KEY_TYPES): tuple(row[name] for name in QUALITY) for row in rows
    }


def tables_of(out: Path) -> str:
    """Return the report up to the times."""
    return (out / "report.md").read_text().split("## Time and memory")[0]


def test_killed_and_started_again_it_ends_with_the_same_tables(meshes, tmp_path):
    words = [meshes, "--sizes", 12, 16, "--methods", "mc", "--jobs", 2, "--no-pictures"]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    done = evaluate(*words, "--out", whole)
    assert done.returncode == 0, done.stderr

    command = [sys.executable, "-m", "super_sdf", "evaluate", *map(str, words)]
    child = subprocess.Popen([*command, "--out", str(cut)], stderr=subprocess.DEVNULL)
    store = cut / "results.jsonl"
    wait_for_lines(child, store)
    workers = psutil.Process(child.pid).children(recursive=True)
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert workers and all_end(workers)  # no orphans
    with store.open("a") as file:
        file.write('{"shape": "torn')  # as if killed while writing
    kept = len(store.read_text().splitlines())
    assert kept < len((whole / "results.jsonl").read_text().splitlines())
    done = evaluate(*words, "--out", cut)
    assert done.returncode == 0, done.stderr

    store.write_text(store.read_text().replace('{"shape": "torn\n', ""))
    assert quality_of(cut) == quality_of(whole)
    assert tables_of(cut) == tables_of(whole)
    again = evaluate(*words, "--out", cut)
    assert again.stderr.count(" of ") == 0  # nothing left to measure
    assert tables_of(cut) == tables_of(whole)


def test_a_bad_shape_is_named_and_the_others_are_measured(meshes, tmp_path):
    saved(Mesh(cube().vertices, cube().faces[1:]), meshes / "lidless.ply")
    (meshes / "junk.stl").write_text("junk")
    out = tmp_path / "out"
    done = evaluate(meshes, "--sizes", 8, "--methods", "mc", "ours", "--out", out, "--no-pictures")
    assert done.returncode == 1
    assert "Left out: lidless: " in done.stderr and "is open: 3 edges" in done.stderr
    assert "Left out: junk: " in done.stderr
    text = (out / "report.md").read_text()
    assert "# Quality of super-sdf on 3 shapes" in text and "Left out, lidless: " in text
    assert "| super-sdf |" in text and "3 of 3" in text
    assert (out / "plots" / "time.png").stat().st_size > 5000


@pytest.mark.graphics
def test_pictures_of_the_best_and_worst(meshes, tmp_path):
    out = tmp_path / "out"
    done = evaluate(meshes, "--sizes", 8, "--methods", "mc", "ours", "--out", out)
    assert done.returncode == 0, done.stderr
    report = (out / "report.md").read_text()
    shown = [line for line in report.splitlines() if "](pictures/" in line]
    assert len(shown) == 3 and "## All 3 shapes at 8^3, best F1 over" in report
    assert all((out / line.split("(")[1][:-1]).exists() for line in shown)


def test_a_store_keeps_rows_and_forgets_other_protocols(tmp_path):
    path = tmp_path / "rows.jsonl"
    task = task_of(tmp_path / "box.ply")
    store = Store(path)
    store.add({**row("box", 0.5), **task.key("mc")})
    store.add({**row("box", 0.5), **task.key("ours"), "protocol": measuring.PROTOCOL - 1})
    with path.open("a") as file:
        file.write('{"shape": "to')
    again = Store(path)
    assert again.get(task, "mc") == {**row("box", 0.5), **task.key("mc")}
    assert again.get(task, "ours") is None
    again.add({**row("box", 1.0), **task.key("bound")})
    assert Store(path).get(task, "bound")["f1"] == 1.0


def test_a_row_of_another_mesh_network_or_setting_is_another_row(tmp_path):
    task = task_of(tmp_path / "box.ply")
    store = Store(tmp_path / "rows.jsonl")
    store.add({**task.key("ours"), "error": None})
    assert store.get(task, "ours")
    for changed in (
        replace(task, mesh="other"),
        replace(task, digest="other"),
        replace(task, turned=0),
        replace(task, setting=Setting(8, noise=0.5)),
        replace(task, setting=Setting(8, 2)),
    ):
        assert store.get(changed, "ours") is None
    assert task.key("mc") == replace(task, digest="other").key("mc")  # not made by our code


def test_rows_of_earlier_versions_are_read(tmp_path):
    """Rows without the column ``turned`` and the newer figures: tables show "-" for these."""
    task = task_of(tmp_path / "box.ply")
    later = ("turned", "efv", "edge_distance", "angle_near", "angle_beyond", "min_angle", "slivers")
    known = {**row("box", 0.5), **task.key("mc")}
    old = {name: value for name, value in known.items() if name not in later}
    assert len(old) == len(known) - len(later)
    path = tmp_path / "rows.jsonl"
    path.write_text(json.dumps(old) + "\n")
    found = Store(path).get(task, "mc")
    assert found == old and Store(path).is_final(task, "mc")
    table = tables.edge_table({"MC": [found]}).splitlines()[-1]
    assert table == "| MC | - | 0.001 | - | - | - | - | 4 | - | - |"
    assert tables.surface_table({"mc": [found]}, 8)
    assert tables.mean_of([found, known], "efv") == 0.001


@pytest.mark.parametrize("seed", [0, 3])
def test_a_shape_is_turned_by_its_name_and_a_seed(meshes, seed):
    path = meshes / "box.ply"
    plain, turned, again = Shape.read(path), Shape.read(path, seed), Shape.read(path, seed)
    np.testing.assert_array_equal(turned.mesh.vertices, again.mesh.vertices)
    assert np.linalg.norm(np.ptp(turned.mesh.vertices, axis=0)) == pytest.approx(1)
    # Still a cube, but smaller in its box.
    side = turned.mesh.volume() ** (1 / 3)
    assert side < 0.99 * plain.mesh.volume() ** (1 / 3)
    np.testing.assert_allclose(np.linalg.norm(turned.mesh.vertices, axis=1), side * 0.75**0.5)
    other = saved(cube(), meshes / "cube.ply")
    for differs in (Shape.read(path, seed + 1), Shape.read(other, seed)):
        assert np.abs(turned.mesh.vertices - differs.mesh.vertices).max() > 0.01


def test_turns_are_rotations_and_favour_no_direction():
    random = np.random.default_rng(0)
    turns = np.array([random_rotation(random) for _ in range(4000)])
    np.testing.assert_allclose(
        turns @ turns.transpose(0, 2, 1), np.eye(3)[None] + 0 * turns, atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(turns), 1)
    np.testing.assert_allclose(turns.mean(0), 0, atol=0.03)
    np.testing.assert_allclose((turns**2).mean(0), 1 / 3, atol=0.02)


def test_turned_shapes_are_measured_turned(meshes, tmp_path):
    words = ("--sizes", 8, "--methods", "mc", "--no-pictures", "--limit", 1, "--jobs", 1)
    out = tmp_path / "out"
    for turn in ((), ("--turned", 5), ("--turned", 5)):
        done = evaluate(meshes / "box.ply", *words, *turn, "--out", out)
        assert done.returncode == 0, done.stderr
    assert done.stderr.count(" of ") == 0  # the second time nothing is left to measure
    assert "The shapes are turned at random, by seed 5." in (out / "report.md").read_text()
    lines = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    assert [line["turned"] for line in lines] == [None, None, 5, 5]
    floors = [line["cd"] for line in lines if line["method"] == "floor"]
    assert floors[1] < 0.9 * floors[0]  # of a smaller cube


def test_failures_are_tried_again_but_not_what_ran_out_of_time(tmp_path):
    task = task_of(tmp_path / "box.ply", limit=10.0)
    store = Store(tmp_path / "rows.jsonl")
    store.add({**task.key("mc"), "error": "OSError: disk"})
    assert not store.is_final(task, "mc")
    store.add({**task.key("mc"), "error": "over the limit of 10 s", "limit": 10.0})
    assert store.is_final(task, "mc")
    assert not store.is_final(task_of(tmp_path / "box.ply", limit=20.0), "mc")


def prepare_to_die():
    return die


def die(task: Task, tell) -> None:
    """Stand in for a process that is killed after its first row."""
    tell(ClockStarted())
    row = {**task.key(task.methods[0]), "error": None}
    tell(row)
    if len(task.methods) > 2:
        os.kill(os.getpid(), signal.SIGKILL)
    for method in task.methods[1:]:
        tell({**row, "method": method})


def prepare_to_sleep():
    return sleep


def sleep(task: Task, tell) -> None:
    """Stand in for a process that does not end."""
    tell(ClockStarted())
    time.sleep(60)


def test_a_process_that_dies_fails_one_method_and_the_rest_go_on(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "prepare", prepare_to_die)
    task = task_of(saved(cube(), tmp_path / "box.ply"), ("mc", "ours", "bspline", "bound"))
    store = Store(tmp_path / "rows.jsonl")
    seen = []
    assert complete([task], store, 1, lambda *step: seen.append(step[:2])) == []
    errors = {name: store.get(task, name)["error"] for name in task.methods}
    assert errors == {
        "mc": None,
        "ours": f"its process {KILLED}",
        "bspline": None,
        "bound": None,
    }
    assert "f1" not in store.get(task, "ours")  # a failure is no score
    assert seen == [(1, 1)]


def test_a_process_over_its_limit_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "prepare", prepare_to_sleep)
    task = task_of(saved(cube(), tmp_path / "box.ply"), limit=0.2)
    (_, row), (_, end) = Runner([task], 1).results()
    assert row["error"] == "over the limit of 0.2 s" and row["limit"] == 0.2
    assert end is None


def prepare_to_crash():
    return crash


def crash(task: Task, tell) -> None:
    """Stand in for a reader that takes its process down."""
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_mesh_that_crashes_its_reader_is_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "prepare", prepare_to_crash)
    tasks = [task_of(tmp_path / "box.ply"), task_of(tmp_path / "box.ply", ("ours", "bound"))]
    seen = []
    left_out = complete(
        tasks, Store(tmp_path / "rows.jsonl"), 1, lambda *step: seen.append(step[:2])
    )
    assert left_out == [LeftOut("box", f"while it was read its process {KILLED}")]
    assert seen == [(1, 2), (2, 2)]


def test_a_process_killed_before_it_had_its_shape_is_tried_once_more(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "prepare", prepare_to_crash_once)
    path = saved(cube(), tmp_path / "box.ply")
    tasks = [task_of(path), task_of(path, ("ours", "bound"))]
    store = Store(tmp_path / "rows.jsonl")
    assert complete(tasks, store, 2) == []
    assert all(store.get(task, name)["error"] is None for task in tasks for name in task.methods)


def prepare_to_crash_once():
    return crash_once


def crash_once(task: Task, tell) -> None:
    """Stand in for a process that somebody kills."""
    marker = task.path.with_suffix(f".{task.methods[0]}")
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    tell(ClockStarted())
    for method in task.methods:
        tell({**task.key(method), "error": None})


def test_without_room_for_a_process_it_ends_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(runner.make_context().Process, "start", no_process)
    with pytest.raises(SuperSdfError, match="no process can be started: Too many open files"):
        list(Runner([task_of(tmp_path / "box.ply")], 1).results())


def no_process(self) -> None:
    raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))


def test_where_nothing_can_be_forked_processes_are_spawned(monkeypatch):
    monkeypatch.setattr(multiprocessing, "get_all_start_methods", lambda: ["spawn"])
    assert runner.make_context().get_start_method() == "spawn"


def test_a_bug_in_the_reading_names_the_shape(tmp_path, monkeypatch):
    def broken(*_):
        raise ValueError("no luck")

    monkeypatch.setattr(Shape, "read", broken)
    left_out = runner.work(task_of(tmp_path / "box.ply"), None)
    assert left_out.shape == "box"
    assert left_out.reason.startswith("ValueError: no luck (test_evaluation.py:")


def prepare_to_refuse():
    return refuse


def refuse(task: Task, tell) -> LeftOut:
    return LeftOut(task.path.stem, "no good")


def test_a_shape_is_left_out_once(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "prepare", prepare_to_refuse)
    tasks = [task_of(tmp_path / "box.ply"), task_of(tmp_path / "box.ply", ("ours",))]
    assert complete(tasks, Store(tmp_path / "rows.jsonl"), 1) == [LeftOut("box", "no good")]


def test_each_shape_is_measured_by_each_method_once(meshes):
    paths = find_meshes([meshes])
    experiments = ("factors", "noise", "iterated", "scale", "meshers")
    asked = Scope(paths, sizes=(32,), experiments=experiments)
    tasks = asked.tasks()
    keys = [tuple(task.key(m).values()) for task in tasks for m in task.methods]
    assert len(keys) == len(set(keys))
    settings = {task.setting for task in tasks}
    assert {Setting(32, factor) for factor in (2, 4, 8, 16)} <= settings
    assert Setting(32, noise=1.0) in settings and Setting(32, passes=2) in settings
    assert {Setting(32, scale=scale) for scale in (0.25, 0.5, 0.75)} <= settings


def test_every_name_has_a_method_and_a_label():
    assert tuple(names.METHOD_LABELS) == tuple(methods.METHODS)
    assert tuple(names.PEER_LABELS) == tuple(peers.PEERS)
    assert tuple(names.MESHERS) == tuple(methods.BY_MESHER)
    assert set(methods.MESHED_METHODS) >= {"ours", "bound"}
    ours = {*methods.MESHED_METHODS, *methods.SIMPLIFIED_METHODS, *peers.MATCHED_METHODS}
    assert set(names.OF_OUR_CODE) <= {*ours, *names.BY_HAND_LABELS, names.PROCESS}
    assert len(names.MATCHED) == len(names.PEER_LABELS) * len(methods.BY_MESHER)
    assert set(names.MATCHED) <= set(names.LABELS)
    for name in names.EXPERIMENTS:
        scope.experiment(name, (32,))
    with pytest.raises(OptionError, match="experiment is 'x': give one of factors, noise"):
        scope.experiment("x", (32,))


def test_shapes_are_spread_over_the_list():
    paths = tuple(Path(str(n)) for n in range(10))
    assert spread(paths, 3) == (paths[0], paths[3], paths[6])
    assert spread(paths, 20) == paths


def test_two_shapes_of_one_name_are_refused(meshes, tmp_path):
    twin = saved(cube(), tmp_path / "box.stl")
    with pytest.raises(Exception, match="two meshes are named 'box'"):
        find_meshes([meshes, twin])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.ply"], "Error: none.ply does not exist"),
        ([".", "--sizes", "2"], "Error: size is 2: give at least 4 samples along an axis"),
        ([".", "--factor", "3"], "Error: factor is 3"),
        ([".", "--model", "none"], "Error: no model 'none': give an ONNX file"),
        (["empty"], "Error: empty holds no mesh: give .ply"),
        (["pipe"], "Error: pipe/a.ply is a named pipe: give a file"),
        (["/dev/zero"], "Error: /dev/zero is a device: give a file"),
        (["pipe/a.ply"], "Error: pipe/a.ply is a named pipe: give a file"),
        (["x" * 300], f"Error: {'x' * 300} does not exist: the name is longer"),
        ([".", "--turned", "-1"], "Error: turned is -1: give a seed of 0 or more"),
        ([".", "--peer-size", "0"], "Error: peer size is 0: give at least 4 samples"),
        ([".", "--peer-limit", "nan"], "Error: peer limit is nan: give more than 0 seconds"),
        ([".", "--peer-limit", "-1"], "Error: peer limit is -1: give more than 0 seconds"),
    ],
)
def test_what_makes_no_sense_is_said_in_one_line(words, message, meshes, monkeypatch):
    monkeypatch.chdir(meshes)
    (meshes / "empty").mkdir()
    (meshes / "pipe").mkdir()
    os.mkfifo(meshes / "pipe" / "a.ply")
    result = CliRunner().invoke(cli, ["evaluate", *words, "--out", "out", "--quiet"])
    assert result.exit_code != 0
    assert result.output.splitlines()[-1].startswith(message)
    assert not Path("out").exists()


def row(name: str, f1: float, **figures: object) -> measuring.Measurement:
    known = dict.fromkeys((*measuring.NUMBERS, *measuring.OPTIONAL_NUMBERS, "excess_cd"), 0.001)
    said = {"shape": name, "f1": f1, "closed": True, "outward": True, "faces": 4, "error": None}
    return {**known, **said, "notes": [], **figures}


DAMAGED = [
    b"no json",
    b"[1, 2]",
    b"3",
    b"null",
    b'{"shape": "to',
    b'{"a":' * 100_000,
    b"[" * 100_000,
    b'{"protocol": 2}',
    b"\xff\xfe\x00",
    b"9" * 6000,
]


def test_what_is_no_row_is_passed_over(tmp_path):
    path, task = tmp_path / "rows.jsonl", task_of(tmp_path / "box.ply")
    good = {**row("box", 0.5), **task.key("mc")}
    assert is_row(good)
    changes = [
        {name: value} for name in good for value in ([], {"a": 1}, "9", 10**400, float("nan"))
    ]
    odd = [{**good, **change} for change in changes]
    odd = [found for found in odd if not is_row(found)]
    assert len(odd) > 0.7 * len(changes)
    lines = [*DAMAGED, *(json.dumps(found).encode() for found in odd)]
    path.write_bytes(b"\n".join([*lines, json.dumps(good).encode(), b'{"shape": "torn']))
    store, kept = Store(path), path.read_bytes()
    assert list(store.rows.values()) == [good] and kept.endswith(b"torn")
    other = {**good, "method": "bound"}
    store.add(other)  # in place of what a killed process left unfinished
    line = json.dumps(other).encode() + b"\n"
    assert path.read_bytes() == kept.removesuffix(b'{"shape": "torn') + line


def test_rows_that_cannot_be_kept_end_it_in_one_line():
    store = Store(Path("/dev/null"))
    store.file.path = Path("/dev/full")
    with pytest.raises(WriteError, match=r"^/dev/full cannot be written: No space left on"):
        store.add(row("box", 0.5, **task_of(Path("box.ply")).key("mc")))


def test_a_failure_is_left_out_of_its_table_and_named(meshes, tmp_path):
    results = made_up(meshes, tmp_path, methods=("mc", "ours"), peers=("rfta",))
    task = next(task for task in results.tasks if task.path.stem == "ring" and task.setting.size)
    results.store.add({**task.key("ours"), "error": "out of memory"})
    again = Results(results.scope, results.tasks, results.store, [LeftOut("lost", "it is")])
    assert again.left_out == [
        LeftOut("lost", "it is"),
        LeftOut("ring", "ours (32^3, factor 4): out of memory"),
    ]
    by_method = again.by_method(Setting(32))
    shapes = {name: [found["shape"] for found in rows] for name, rows in by_method.items()}
    assert shapes == {name: ["ball", "box"] for name in ("mc", "ours", "floor")}
    assert len(again.rows(Setting(0, 0), "floor")) == 3


def test_a_size_that_does_not_fit_is_no_score(meshes, tmp_path):
    out = tmp_path / "out"
    words = ("--sizes", 8, 20000, "--methods", "mc", "--out", out, "--no-pictures", "--limit", 1)
    done = evaluate(meshes, *words)
    assert done.returncode == 1
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("Left out: ")]
    assert line.startswith("Left out: ball: mc (20000^3, factor 4): measuring 20000^3 refined to ")
    text = (out / "report.md").read_text()
    assert f"Left out, {line.removeprefix('Left out: ')}." in text
    large = text.split("## 20000^3")[1]
    assert "| MC | - | - |" in large and "0.000" not in large.split("##")[0]


@pytest.mark.parametrize(
    ("count", "title"),
    [
        (1, "## The shape at 8^3"),
        (3, "## All 3 shapes at 8^3, best F1 over the floor's first"),
        (10, "## The 5 best and the 5 worst shapes at 8^3, by F1 over the floor's"),
    ],
)
def test_the_pictures_are_called_what_they_show(count, title):
    assert report.extremes_title(count, Setting(8)) == title


def test_a_folder_that_no_evaluation_made_is_refused(meshes, tmp_path):
    out = tmp_path / "out"
    words = [meshes, "--sizes", 8, "--methods", "mc", "--out", out, "--quiet", "--limit", 1]
    arguments = ["evaluate", *map(str, words), "--no-pictures"]
    out.mkdir()
    (out / "report.md").write_text("mine")
    refused = CliRunner().invoke(cli, arguments)
    assert refused.exit_code == 1
    assert refused.output == (
        f"Error: {out} holds 'report.md' and no results.jsonl, so no evaluation made it: give a "
        "new or an empty folder\n"
    )
    assert [path.name for path in out.iterdir()] == ["report.md"]
    (out / "report.md").unlink()
    done = evaluate(*arguments[1:])
    assert done.returncode == 0, done.stderr
    (out / "notes.md").write_text("mine")
    (out / "plots" / "mine.png").write_text("mine")
    assert CliRunner().invoke(cli, arguments).exit_code == 0  # nothing is left to measure
    assert (out / "notes.md").read_text() == (out / "plots" / "mine.png").read_text() == "mine"
    for name in ("report.md", "shapes.md", "results.jsonl"):
        ours = (out / name).read_bytes()
        (out / name).write_text("mine")
        refused = CliRunner().invoke(cli, arguments)
        message = f"Error: {out / name} was not written by an evaluation: move it or use another"
        assert refused.exit_code == 1 and refused.output.startswith(message)
        assert (out / name).read_text() == "mine"
        (out / name).write_bytes(ours)


def test_an_interrupt_says_what_is_kept(meshes, tmp_path, monkeypatch, command):
    def interrupt(tasks, store, *_):
        store.add(row("box", 0.5, **tasks[0].key("mc")))
        raise KeyboardInterrupt

    monkeypatch.setattr("super_sdf.evaluation.evaluate.complete", interrupt)
    out = tmp_path / "out"
    code, _, err = command("evaluate", meshes, "--out", out)
    assert (code, err) == (
        130,
        f"Error: interrupted: results so far are kept in {out / 'results.jsonl'}; run the same "
        "command again to resume\n",
    )


def made_up(meshes: Path, out: Path, **options: object) -> Results:
    """Results of a scope as if measured: F1 falls with noise and grows with everything else."""
    asked = Scope(find_meshes([meshes]), sizes=(32,), **options)
    store = Store(out / "results.jsonl")
    tasks = asked.tasks()
    for task in tasks:
        for method in task.methods:
            f1 = 0.5 + task.setting.factor / 100 - task.setting.noise / 10
            cost = {"seconds": 1.0, "peak_mb": 10.0, "notes": []}
            late = {"error": "over the limit of 1 s", "limit": 1.0} if method == "rfta" else {}
            key = task.key(method)
            store.add({**key, **row(task.path.stem, f1), **cost, **key, **late})
    return Results(asked, tasks, store, [])


def test_experiments_stand_beside_what_is_published(meshes, tmp_path):
    from super_sdf.evaluation.report import write_report

    options = {
        "experiments": ("factors", "noise", "iterated", "scale"),
        "peers": ("rfta", "dual-contouring"),
        "peer_limit": 1.0,
        "experiment_shapes": 2,
    }
    results = made_up(meshes, tmp_path, **options)
    timings = {32: [{"seconds": 0.25, "peak_mb": 200.0}, {"seconds": 0.75, "peak_mb": 300.0}]}
    path = write_report(results, tmp_path, timings, up="z", pictures=False)
    lines = path.read_text().splitlines()
    assert "| 50 % | 0.490 | 0.490 | 0.490 | 0.000 | 0.430 | 0.487 | 0.057 |" in lines
    assert any(line.startswith("| 16 | super-sdf | 100.000 | 0.660 |") for line in lines)
    assert any(line.startswith("| 32^3 -> 128^3 -> 512^3 |") for line in lines)
    assert any("| 1.317 | 0.824 | 0.952 |" in line for line in lines)  # the paper's, iterated
    scaled = next(line for line in lines if line.startswith("| 0.25, 32^3 | super-sdf |"))
    assert scaled.endswith("| 13.826 | 0.425 | 0.871 |")
    assert "| 32^3 | super-sdf | 0.50 | 0.25 | 0.75 | 300 |" in lines
    assert any(line.startswith("| 32^3 | *PoNQ, published, Thingi30* | 0.97 |") for line in lines)
    rfta = next(line for line in lines if line.startswith("| RFTA |"))
    assert rfta.endswith("| 0 of 0 | 0 of 3 |")
    assert "RFTA, box: over the limit of 1 s." in lines


def test_every_mesher_has_rows_of_ours_and_of_its_bound(meshes, tmp_path, monkeypatch):
    for module in (names, scope, experiment_tables):
        monkeypatch.setattr(module, "MESHERS", ("marching", "other"))
    results = made_up(meshes, tmp_path, experiments=("meshers",), experiment_shapes=2)
    methods = {(task.setting.factor, task.methods) for task in results.tasks if task.setting.size}
    assert (2, ("ours", "bound", "ours-other", "bound-other")) in methods
    section = experiment_tables.mesher_section(results).splitlines()
    assert section[0] == "## Meshers, 2 shapes"
    rows = section[section.index("") + 1 :]
    rows = [line for line in rows if line.startswith("| 32^3")]
    simple = ("super-sdf, 1/4", "super-sdf, 1/16")
    assert [line.split(" | ")[:3] for line in rows] == [
        [f"| 32^3, factor {factor}", mesher, label]
        for factor in (1, 2, 4)
        for mesher in ("marching", "other")
        for label in (
            "super-sdf",
            *(simple if factor == 4 else ()),
            "bound: true distance at the nodes",
        )
    ]
    assert rows[0].endswith("| 0.510 | 0.001 | 10.00 | 10.00 | 0.001 | 0.001 | 0.001 | 0.00 | "
                               "0.00 | 4 | 0.10 | 0.00 | 2 of 2 |")  # fmt: skip


def test_coarser_lattices_and_fewer_triangles_are_measured_at_the_smallest_size(meshes):
    asked = Scope(find_meshes([meshes]), sizes=(64, 32), experiments=("meshers",))
    measured = {(task.setting.size, task.setting.factor): task.methods for task in asked.tasks()}
    assert {key for key in measured if key[0]} == {(32, 1), (32, 2), (32, 4), (64, 4)}
    assert "ours-sharp/4" in measured[32, 4]
    assert "ours-sharp/4" not in measured[64, 4]


def test_edges_have_a_table_for_each_size(meshes, tmp_path):
    results = made_up(meshes, tmp_path, methods=("mc", "ours"))
    lines = report.edge_section(results).splitlines()
    assert "**32^3, factor 4**" in lines
    assert "| super-sdf | 3 | 0.001 | 0.001 | 0.001 | 0.00 | 0.00 | 4 | 0.10 | 0.00 |" in lines
    shapes = tables.shape_table(results.by_method(Setting(32))).splitlines()
    titles = [cell.strip() for cell in shapes[0].split("|")]
    assert {"EFv", "edge distance", "angle near", "slivers %"} <= set(titles)
    assert len(titles) == len(set(titles[1:-1])) + 2


def test_the_command_is_timed_as_a_process(monkeypatch):
    monkeypatch.setattr(timing, "RUNS", 1)
    figures = timing.time_shape(Shape("ring", torus()), Setting(12))
    assert figures["seconds"] > 0.05 and 20 < figures["peak_mb"] < 2000
    with pytest.raises(SuperSdfError, match=r"super_sdf upsample none\.npz x\.ply ended with 1"):
        timing.run_command(["upsample", "none.npz", "x.ply"])


FAKE_PSUTIL = """
from types import SimpleNamespace
Error = OSError
def Process(pid):
    return SimpleNamespace(memory_info=lambda: SimpleNamespace(peak_wset=7_000_000))
"""


def test_on_windows_the_peak_is_read_while_the_process_runs(tmp_path, monkeypatch):
    (tmp_path / "psutil.py").write_text(FAKE_PSUTIL)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(timing, "LAUNCHER", "import os; del os.wait4\n" + timing.LAUNCHER)
    seconds, peak, printed = timing.run_python(["-c", "import time; time.sleep(.1); print('hi')"])
    assert seconds > 0.1 and peak == 7 and printed == "hi\n"
    with pytest.raises(SuperSdfError, match="ended with 3"):
        timing.run_python(["-c", "raise SystemExit(3)"])


def test_gaps_and_wins_are_what_they_are_called():
    by_method = {
        "bspline": [row("a", 0.5), row("b", 0.7)],
        "ours": [row("a", 0.8), row("b", 0.6)],
        "bound": [row("a", 1.0), row("b", 0.8)],
    }
    assert "F1 33 %" in tables.gap_line(by_method)
    assert tables.win_line(by_method) == (
        "super-sdf beats B-spline in F1 on 1 of 2. Not on: b (0.600, B-spline 0.700)."
    )


def test_tables_show_means_and_name_what_has_no_surface():
    rows = [row("a", 0.5), row("b", 0.0, faces=0, closed=False)]
    table = tables.surface_table({"mc": rows}, 32)
    mine = next(line for line in table.splitlines() if line.startswith("| MC |"))
    assert "| 0.250 |" in mine and mine.endswith("| 1 of 2 | 2 of 2 |")
    assert "*PoNQ, published, Thingi30*" in table
    assert tables.empty_lines({"mc": rows}) == ["No surface (a dot stands in), MC: b."]


def test_published_figures_are_in_their_tables_order():
    """In the paper more samples are better, and so is its method than B-spline."""
    for size in (32, 64, 128):
        cd, f1, nc = np.array(published.SURFACES[size][published.PAPER])
        base = published.SURFACES[size]["B-spline + MC"]
        assert cd < base[0] and f1 > base[1] and nc >= base[2]
    assert all(ours > mc for mc, ours in published.NOISE_F1.values())


def fake_peer(monkeypatch, runs: list[str]) -> None:
    """Put a peer in place of RFTA that takes a cube for every shape and notes that it ran."""

    def run(case, network):
        runs.append(case.shape.name)
        return methods.Surface(cube())

    monkeypatch.setitem(peers.PEERS, "rfta", peers.Peer("rfta", run))


def test_a_peer_is_run_once_and_its_mesh_kept(meshes, tmp_path, monkeypatch):
    runs: list[str] = []
    fake_peer(monkeypatch, runs)
    kept, shape = tmp_path / "kept", Shape.read(meshes / "ball.ply")
    for _ in range(2):
        case = Case(shape, Setting(8), kept)
        surface = peers.PEERS["rfta"](case, None)
        assert np.array_equal(surface.mesh.vertices, cube().vertices)
        assert np.array_equal(surface.mesh.faces, cube().faces) and surface.seconds > 0
    assert runs == ["ball"]
    peers.PEERS["rfta"](Case(shape, Setting(9), kept), None)  # of other samples
    assert runs == ["ball", "ball"] and len(list(kept.glob("ball-*-rfta-*.ply"))) == 2
    next(kept.glob("ball-8-*.json")).unlink()
    with pytest.raises(FileError, match="cannot be read"):
        peers.PEERS["rfta"](Case(shape, Setting(8), kept), None)


def test_ours_beside_a_peer_has_as_many_triangles(meshes, monkeypatch):
    fake_peer(monkeypatch, [])
    case = Case(Shape.read(meshes / "ball.ply"), Setting(12, 2))
    method = peers.MATCHED_METHODS["ours/rfta"]
    with pytest.raises(FileError, match="no mesh of rfta is kept: run it again"):
        method(case, load_network("fast", device="cpu"))
    peers.PEERS["rfta"](case, None)
    found = method(case, load_network("fast", device="cpu")).mesh
    assert len(found.faces) <= 12 and found.is_closed()


@pytest.mark.parametrize("mesher", names.OURS_MESHED)
def test_with_factor_1_the_corners_of_voxels_have_values_of_the_refined_field(meshes, mesher):
    case = Case(Shape.read(meshes / "ball.ply"), Setting(12, 1))
    name = names.OURS_MESHED[mesher]
    network = load_network("fast", device="cpu")
    one = methods.MESHED_METHODS[name](case, network).mesh
    coarse = methods.METHODS["mc"](case, network).mesh
    assert one.is_closed() and 0.5 < len(one.faces) / len(coarse.faces) < 2
    apart = case.shape.solid.distance(one.vertices).max()
    assert apart < 0.5 * case.shape.solid.distance(coarse.vertices).max() + 0.1 * case.spacing
    quarter = methods.SIMPLIFIED_METHODS[names.simplified(name, 4)](case, network).mesh
    assert len(quarter.faces) == pytest.approx(len(one.faces) / 4, rel=0.1)


@pytest.mark.parametrize("name", KIND_MODELS)
def test_rows_are_measured_again_with_another_network_for_a_kind(name, tmp_path, monkeypatch):
    files = shipped_models()
    before = measuring.digest_of_ours("fast")
    other = tmp_path / "other.onnx"
    other.write_bytes(files[name].read_bytes() + b"0")
    monkeypatch.setattr(measuring, "shipped_models", lambda: {**files, name: other})
    assert measuring.digest_of_ours("fast") != before


def test_rows_of_one_precision_do_not_count_for_the_other(meshes):
    default, same, other = (
        measuring.digest_of_ours("base", precision) for precision in ("auto", "int8", "float32")
    )
    assert default == same != other
    paths = (meshes / "box.ply",)
    tasks = Scope(paths, (8,), methods=("ours",), precision="float32").tasks()
    assert {(task.precision, task.digest) for task in tasks} == {("float32", other)}


def test_a_process_is_timed_with_the_network_and_precision_of_the_task(meshes, monkeypatch):
    given = []
    monkeypatch.setattr(whole, "time_shape", lambda *words: given.append(words[2]) or {})
    whole.time_task(task_of(meshes / "box.ply", precision="float32"))
    assert given == [["--model", "base", "--precision", "float32"]]


def test_a_noisy_grid_that_is_refused_costs_only_ours(meshes, monkeypatch):
    def refuse(*values, **options):
        raise GridError("no distances")

    monkeypatch.setattr(cases, "make_grid", refuse)
    path = meshes / "ball.ply"
    task, shape = task_of(path, ("mc", "trilinear", "bound", "ours")), Shape.read(path)
    noisy = replace(task, setting=Setting(8, noise=0.5))
    *others, ours = measuring.measure_task(noisy, shape)
    assert all(row["error"] is None and row["f1"] > 0 for row in others)
    assert ours["error"] == "no distances"
    assert list(measuring.measure_task(task, shape))[-1]["error"] is None
