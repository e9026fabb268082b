"""Bad and odd inputs end in one line, or in a mesh that is what it says; a sample of the corpus.

All of it: ``python -m lab corpus --whole``, and ``--fields 10000``.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from conftest import trilinear
from corpus.case import Case, upsample
from corpus.command import THEMES, make_cases, spread
from corpus.judge import faults_of_mesh, judge, snapshot, try_case
from corpus.meshes import CORNERS, FACES, binary_ply
from corpus.random_fields import faults_of_field, faults_of_pieces, make_fields, mesh_of_field
from corpus.running import Child, Run, kept_sessions, run_here

from super_sdf import load_network
from super_sdf.network.onnx import ort
from super_sdf.options import MESHERS

EACH = 25  # cases of a theme
ALONE = 20  # of all that may hang or crash
FIELDS = 84


@pytest.fixture(scope="module")
def cases() -> list[Case]:
    return make_cases()


@pytest.fixture
def kept(monkeypatch):
    """Load each network once."""
    monkeypatch.setattr(ort, "InferenceSession", kept_sessions())


@pytest.mark.usefixtures("kept")
@pytest.mark.parametrize("theme", [theme.__name__.rpartition(".")[2] for theme in THEMES])
def test_bad_and_odd_inputs_end_in_a_line_or_a_mesh(theme, cases):
    chosen = spread([case for case in cases if case.theme == theme and not case.alone], EACH)
    outcomes = [try_case(case, run_here) for case in chosen]
    assert [(o.case.name, fault) for o in outcomes for fault in o.faults] == []


def test_what_may_hang_or_crash_ends_in_a_line_too(cases):
    child = Child()
    try:
        chosen = spread([case for case in cases if case.alone], ALONE)
        outcomes = [try_case(case, child.run) for case in chosen]
    finally:
        child.stop()
    assert [(o.case.name, fault) for o in outcomes for fault in o.faults] == []


@pytest.mark.parametrize("mesher", MESHERS)
@pytest.mark.parametrize("stand_in", [True, False])
def test_random_fields_become_closed_manifolds(stand_in, mesher):
    network = trilinear if stand_in else load_network("fast", threads=1)
    fields = list(make_fields(FIELDS))[stand_in::2]
    assert [fault for field in fields for fault in faults_of_field(field, network, mesher)] == []


@pytest.mark.parametrize("mesher", MESHERS)
def test_random_fields_in_slabs_and_bricks_are_closed_where_they_are_called_so(mesher):
    network, faults = load_network("fast", threads=1), []
    for number, field in enumerate(make_fields(FIELDS // 10)):
        whole = mesh_of_field(field, network, mesher)
        faults += faults_of_pieces(field, network, mesher, 2 + number % 5, whole)
    assert faults == []


def test_the_corpus_is_large_and_the_same_each_time(cases):
    names = [case.name for case in cases]
    assert len(names) > 4000 and len(set(names)) == len(names)
    again = [(case.name, case.words, list(case.files)) for case in make_cases()]
    assert again == [(case.name, case.words, list(case.files)) for case in cases]


def faults_of(folder: Path, run: Run, **made: bytes) -> list[str]:
    """Return what the judge says of a run that made these files beside its input."""
    case = upsample("none/none", {"in.npy": b"x", "there.ply": b"y"}, target="there.ply")
    case.build(folder)
    before = snapshot(folder)
    for name, data in made.items():
        (folder / name.replace("_", ".")).write_bytes(data)
    return [fault.kind for fault in judge(case, run, folder, before)]


@pytest.mark.parametrize(
    "run, kinds",
    [
        (Run(1, "", "Error: why\n"), []),
        (Run(1, "", "Error: why\nand why\n"), ["not one line"]),
        (Run(1, "", ""), ["not one line"]),
        (Run(3, "", "Error: why\n"), ["code"]),
        (Run(1, "", "Error: ValueError: why\n"), ["bug named"]),
        (Run(1, "", "", "grid.py:check: ValueError: why"), ["traceback"]),
        (Run(1, "", "", "grid.py:check: HangError: "), ["hang"]),
        (Run(-11, "", "", "crash: "), ["crash"]),
        (Run(1, "", "Error: why\n", warned=("overflow",)), ["warning"]),
        (Run(1, "", "Error: why\n", grown=3 << 30), ["memory"]),
        (Run(0, "", ""), ["nothing made"]),
    ],
)
def test_the_judge_knows_each_way_to_end(run, kinds, tmp_path):
    assert faults_of(tmp_path, run) == kinds


def test_the_judge_sees_what_is_left_made_and_overwritten(tmp_path):
    failed = Run(1, "", "Error: why\n")
    mesh = binary_ply()
    assert faults_of(tmp_path, failed, **{"_there_ply_123_part": b""}) == ["left over"]
    assert faults_of(tmp_path, failed, other_ply=b"") == ["made unasked"]
    assert faults_of(tmp_path, failed, in_npy=b"") == ["made unasked"]
    ended = Run(0, "", "there.ply: 8 vertices, 12 triangles\n")
    assert faults_of(tmp_path, ended, there_ply=mesh) == ["overwritten"]
    assert faults_of(tmp_path, failed, there_ply=mesh) == [
        "made in spite of failure",
        "overwritten",
    ]
    few = Run(0, "", "there.ply: 9 vertices, 12 triangles\n")
    assert faults_of(tmp_path, few, there_ply=mesh) == ["overwritten", "mesh"]


def test_meshes_are_judged_as_others_read_them(tmp_path):
    def faults(vertices, faces, may_be_open=False):
        path = tmp_path / "mesh.ply"
        path.write_bytes(binary_ply(np.asarray(vertices), np.asarray(faces)))
        return faults_of_mesh(path, may_be_open=may_be_open)

    assert faults(CORNERS, FACES) == []
    assert faults(CORNERS, FACES[:-1]) == ["open edges that nothing was said of"]
    assert faults(CORNERS, FACES[:-1], may_be_open=True) == []
    assert faults(CORNERS * [1, 1, np.nan], FACES) == ["8 vertices are not finite"]
    assert "triangles that have collapsed" in faults(CORNERS * [1, 1, 0], FACES)
    assert "vertices at the same position" in faults(CORNERS * [1, 1, 0], FACES)


def test_a_hang_and_a_crash_are_seen_in_a_child(tmp_path):
    child = Child()
    try:
        os.mkfifo(tmp_path / "in.npy")
        child.process.kill()
        assert child.run(("info",), tmp_path).trace.startswith("crash")
        assert child.run(("--version",), tmp_path).out.startswith("super-sdf, version")
    finally:
        child.stop()
