"""Grids that are not exact distances: how they are made, meshed, measured and tabled."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from solids import cube, joined, saved, sphere

from super_sdf import Mesh, load_network
from super_sdf.errors import GridError, OutOfMemoryError
from super_sdf.evaluation import field_methods, names
from super_sdf.evaluation.cases import Case, Setting, Shape
from super_sdf.evaluation.field_kinds import (
    AXES,
    KINDS,
    RATIOS,
    kinds_at,
    level_set,
    methods_on,
    samples_of,
    without_unknown,
)
from super_sdf.evaluation.field_methods import FIELD_METHODS
from super_sdf.evaluation.field_tables import field_section
from super_sdf.evaluation.measuring import (
    NUMBERS,
    Measurement,
    Task,
    failed_row,
    measure_method,
    measure_on_kind,
)
from super_sdf.evaluation.results import Results
from super_sdf.evaluation.runner import missing_tasks
from super_sdf.evaluation.scope import Scope, find_meshes
from super_sdf.evaluation.store import Store, is_row

SIDE = 3**-0.5  # of the cube whose box diagonal is 1
CUBIC = [name for name, kind in KINDS.items() if kind.is_cubic]


@pytest.fixture(scope="module")
def case() -> Case:
    return Case(Shape("box", cube()), Setting(16))


@pytest.fixture(scope="module")
def fast():
    return load_network("fast", device="cpu")


def values_of(name: str, case: Case) -> np.ndarray:
    return samples_of(KINDS[name], case).values


def box_distance(points: np.ndarray) -> np.ndarray:
    """Return the distance to the cube, by its closed form."""
    off = np.abs(points) - SIDE / 2
    return np.linalg.norm(np.maximum(off, 0), axis=-1) + np.minimum(off.max(-1), 0)


def test_every_group_has_kinds_and_every_method_a_label_and_a_function():
    assert tuple(dict.fromkeys(kind.group for kind in KINDS.values())) == names.FIELD_GROUPS
    measured = {method for kind in KINDS.values() for method in kind.methods}
    assert measured == set(names.FIELD_METHOD_LABELS) == set(field_methods.BY_NAME)
    assert set(methods_on(list(KINDS))) == set(FIELD_METHODS)
    assert len(FIELD_METHODS) == sum(len(kind.methods) for kind in KINDS.values())
    for kind in KINDS.values():
        assert {"mc", "ours"} <= set(kind.methods)


@pytest.mark.parametrize("name", CUBIC)
def test_a_kind_keeps_the_side_of_every_sample(name, case):
    field, h = level_set(KINDS[name], values_of(name, case)), case.spacing
    apart = 0.25 * h if KINDS[name].group == "noisy" else 1e-6
    away = np.abs(case.coarse) > apart
    assert field.dtype == np.float32 and field.shape == case.coarse.shape
    assert ((field < 0) == (case.coarse < 0))[away].all() and away.mean() > 0.8


@pytest.mark.parametrize("cut", [0.5, 0.75, 1, 1.5, 2, 3])
def test_distances_are_cut_off_where_they_are_said_to_be(cut, case):
    found, limit = values_of(f"cut off at {cut:g}", case), cut * case.spacing
    assert (found.min(), found.max()) == pytest.approx((-limit, limit))
    within = np.abs(case.coarse) < limit
    np.testing.assert_array_equal(found[within], case.coarse[within])


def test_uneven_cuts_and_unknown_values(case):
    found, h = values_of("cut off at -1 and 2.5", case), case.spacing
    assert (found.min(), found.max()) == pytest.approx((-h, 2.5 * h))
    unknown = values_of("unknown beyond 2", case)
    np.testing.assert_array_equal(np.isnan(unknown), np.abs(case.coarse) > 2 * h)
    known = ~np.isnan(unknown)
    np.testing.assert_array_equal(unknown[known], case.coarse[known])


def test_unknown_values_become_those_of_the_nearest_sample():
    values = np.full((5, 5, 5), np.nan, np.float32)
    values[0], values[4] = -1, 2
    filled = without_unknown(values)
    assert (filled[:2] == -1).all() and (filled[3:] == 2).all()
    assert without_unknown(filled) is filled


def test_scaled_and_bent_fields_are_by_their_formulas(case):
    d, h = case.coarse.astype(np.float64), case.spacing
    close = {"rtol": 1e-5, "atol": 1e-8}
    np.testing.assert_allclose(values_of("d/100, spacing given", case), d / 100, **close)
    np.testing.assert_allclose(
        values_of("2h tanh(d/2h)", case), 2 * h * np.tanh(d / (2 * h)), **close
    )
    np.testing.assert_allclose(values_of("d + d^2", case), d + d**2, **close)
    factor = values_of("d times 0.5 to 1.5", case)[d != 0] / d[d != 0]
    assert 0.499 < factor.min() < 0.6 and 1.4 < factor.max() < 1.501


@pytest.mark.parametrize("name", ["2h tanh(d/2h)", "d + d^2"])
def test_bends_are_monotone(name, case):
    order = np.argsort(case.coarse, axis=None)
    assert (np.diff(values_of(name, case).ravel()[order]) >= 0).all()


def test_masks_and_densities_are_by_their_formulas(case):
    d, h = case.coarse.astype(np.float64), case.spacing
    mask = values_of("mask", case)
    assert mask.dtype == np.uint8 and (mask == (d <= 0)).all() and mask.any()
    sigmoid = values_of("1/(1 + exp(d/h))", case)
    np.testing.assert_allclose(sigmoid, 1 / (1 + np.exp(d / h)), atol=1e-6)
    share = values_of("share of the voxel", case)
    np.testing.assert_allclose(share, np.clip(0.5 - d / h, 0, 1), atol=1e-6)


@pytest.mark.parametrize("noise", [0.1, 0.25])
def test_noise_is_uniform_and_the_same_in_every_run(noise, case):
    found = values_of(f"noise of {noise:g}", case)
    off = (found - case.coarse) / case.spacing
    assert noise * 0.98 < np.abs(off).max() < noise * 1.001
    assert off.std() == pytest.approx(noise / 3**0.5, rel=0.05)
    again = Case(Shape("box", cube()), Setting(16))
    np.testing.assert_array_equal(values_of(f"noise of {noise:g}", again), found)


@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("axis", AXES)
def test_unequal_spacings_are_exact_and_coarse_along_one_axis(ratio, axis, case):
    found = samples_of(KINDS[f"spacing 1:1:{ratio:g}, {axis}"], case)
    number = AXES.index(axis)
    assert found.values.shape[number] == 16 and set(found.values.shape) == {16, 16 * ratio}
    np.testing.assert_allclose(found.spacing * found.values.shape, 1)
    points = np.moveaxis(np.indices(found.values.shape), 0, -1) * found.spacing + found.origin
    np.testing.assert_allclose(points[0, 0, 0], -points[-1, -1, -1])
    np.testing.assert_allclose(found.values, box_distance(points), atol=1e-6)


def test_unequal_spacings_are_measured_at_the_smallest_size_only():
    assert kinds_at(64, (64, 32), names.FIELD_GROUPS) == CUBIC
    assert kinds_at(32, (64, 32), names.FIELD_GROUPS) == list(KINDS)
    assert kinds_at(32, (32,), ("mask", "exact")) == ["exact", "mask"]


@pytest.mark.parametrize(
    "name",
    [
        *("mc on exact", "ours on exact"),
        *("bspline on cut off at 1.5", "ours on share of the voxel"),
        *("ours on d/100, no spacing given", "ours on d/100, spacing given"),
        *("bspline on 1/(1 + exp(d/h))", "ours on 1/(1 + exp(d/h))"),
        *("mc on spacing 1:1:1.5, y", "ours on spacing 1:1:1.5, y"),
        *("spline-finest on spacing 1:1:1.5, x", "spline-coarsest on spacing 1:1:1.5, z"),
    ],
)
def test_meshes_are_at_the_place_and_size_of_the_shape(name, case, fast):
    surface = FIELD_METHODS[name](case, fast)
    assert surface.mesh.is_closed() and surface.mesh.volume() == pytest.approx(SIDE**3, rel=0.08)
    assert np.abs(surface.mesh.vertices).max() == pytest.approx(SIDE / 2, abs=0.3 * case.spacing)
    assert np.abs(box_distance(surface.mesh.vertices)).mean() < 0.15 * case.spacing


@pytest.mark.parametrize("method", KINDS["mask"].methods)
def test_masks_are_meshed_within_half_a_voxel(method, case, fast):
    mesh = FIELD_METHODS[f"{method} on mask"](case, fast).mesh
    assert mesh.is_closed()
    assert np.abs(box_distance(mesh.vertices)).mean() < 0.55 * case.spacing


def test_a_surface_that_leaves_the_grid_is_closed():
    inside = np.full((4, 4, 4), -1, np.float32)
    mesh = field_methods.closed_isosurface(inside, (1, 2, 3), (10, 20, 30))
    assert mesh.is_closed() and mesh.volume() > 0
    np.testing.assert_allclose(mesh.vertices.min(0), [9.5, 19, 28.5])
    np.testing.assert_allclose(mesh.vertices.max(0), [13.5, 27, 40.5])


def test_volume_and_pieces_are_compared_with_the_reference():
    shape = Shape("ball", sphere())
    twice = joined(shape.mesh, Mesh(shape.mesh.vertices / 2 + 2, shape.mesh.faces))
    found = measure_on_kind(shape, twice)
    assert found["volume_off"] == pytest.approx(1 / 8, rel=1e-6)
    assert (found["pieces"], found["pieces_of_reference"], found["closed"]) == (2, 1, True)
    assert "efv" not in found and set(NUMBERS) - {"seconds"} <= set(found)


def refusing(*refused: str):
    """Return a ``make_grid`` that refuses some values of ``field``."""

    def make(values, *, field, **options):
        if field in refused:
            raise GridError(f"not with {field}")
        return field_methods.SdfGrid.trusted(values, options["spacing"], options["origin"])

    return make


def test_a_refusal_is_recorded_and_is_no_failure(case, fast, monkeypatch, tmp_path):
    monkeypatch.setattr(field_methods, "make_grid", refusing("auto", "scaled"))
    found = measure_method(case.shape, case, "ours on d + d^2", fast)
    assert found["error"] is None and found["refused"] == "not with auto"
    assert found["faces"] == 0 and found["pieces"] == 0 and "taken_as" not in found
    task = Task(tmp_path / "box.ply", "sum", Setting(16), ("ours on d + d^2",), "fast", "digest")
    row = {**task.key("ours on d + d^2"), **found, "notes": []}
    assert is_row(row) and not is_row({**row, "refused": 3})


def test_scaled_is_said_only_after_a_refusal_and_only_of_scaled_kinds(case, fast, monkeypatch):
    monkeypatch.setattr(field_methods, "make_grid", refusing("auto"))
    facts = FIELD_METHODS["ours on d + d^2"](case, fast).facts
    assert facts == {"taken_as": "exact", "told": True}
    assert FIELD_METHODS["ours on exact"](case, fast).facts == {"refused": "not with auto"}
    monkeypatch.setattr(field_methods, "make_grid", refusing())
    facts = FIELD_METHODS["ours on d + d^2"](case, fast).facts
    assert facts == {"taken_as": "exact", "told": False}


def test_what_does_not_fit_in_memory_is_a_failure_and_no_refusal(case, fast, monkeypatch):
    def full(*_, **__):
        raise OutOfMemoryError("too large")

    monkeypatch.setattr(field_methods, "reconstruct", full)
    found = measure_method(case.shape, case, "ours on exact", fast)
    assert found == {"error": "too large"}


def test_what_the_values_were_taken_as(case, fast):
    kinds = {
        "mask": "mask",
        "cut off at 1": "truncated",
        "exact": "exact",
        "noise of 0.25": "noisy",
    }
    for name, kind in kinds.items():
        assert FIELD_METHODS[f"ours on {name}"](case, fast).facts["taken_as"] == kind


def test_a_measurement_of_our_code_is_known_by_it(tmp_path):
    task = Task(tmp_path / "box.ply", "sum", Setting(16), (), "fast", "digest")
    later = replace(task, digest="other")
    for method in ("ours on mask", "spline-coarsest on spacing 1:1:5, x"):
        assert task.key(method) != later.key(method)
    for method in ("mc on mask", "bspline on exact", "mc-gaussian-0.5 on mask"):
        assert task.key(method) == later.key(method)


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    folder = tmp_path / "meshes"
    folder.mkdir()
    for name, mesh in {"box": cube(), "ball": sphere(), "egg": sphere(0.3)}.items():
        saved(mesh, folder / f"{name}.ply")
    return folder


def figures(**changed: object) -> Measurement:
    """Return what ``measure_on_kind`` returns, made up."""
    known = {**dict.fromkeys(NUMBERS, 0.01), "f1": 0.5, "nc": 0.9, "closed": True, "faces": 4}
    counts = {"volume_off": -0.02, "pieces": 1, "pieces_of_reference": 1}
    return {**known, **counts, "error": None, "notes": [], **changed}


def made_up(
    meshes: Path, out: Path, kinds: tuple[str, ...] = ("exact", "mask"), **changed: dict
) -> Results:
    """Return made-up results of some kinds; ``changed`` has entries by shape, then method."""
    scope = Scope(
        find_meshes([meshes]),
        sizes=(32,),
        methods=("mc",),
        experiments=("fields",),
        kinds=kinds,
    )
    store, tasks = Store(out / "results.jsonl"), scope.tasks()
    for task in tasks:
        for method in task.methods:
            own = {"taken_as": "mask", "told": False} if method.startswith("ours") else {}
            more = changed.get(task.path.stem, {}).get(method, {})
            store.add({**task.key(method), **figures(**own, **more)})
    return Results(scope, tasks, store, [])


def test_the_tables_have_a_row_for_each_kind_and_method(meshes, tmp_path):
    changed = {
        "ball": {"ours on mask": {"p2s": 0.02, "volume_off": 0.05}},
        "egg": {"ours on exact": {"refused": "no good"}},
    }
    lines = field_section(made_up(meshes, tmp_path, **changed)).splitlines()
    assert lines[0] == "## Grids that are not exact distances, 3 shapes" and "**32^3**" in lines
    rows = [line.split(" | ")[:3] for line in lines if line.startswith(("| exact", "| mask"))]
    labels = [names.FIELD_METHOD_LABELS[m] for m in KINDS["mask"].methods]
    assert rows[3:] == [["| mask", label, "3"] for label in labels]
    assert rows[:3] == [["| exact", label, "2"] for label in ("MC", "B-spline + MC", "super-sdf")]
    assert (
        "| mask | super-sdf | 3 | 0.4267 | 0.6400 | 0.500 | 0.900 | 3.0 | 5.0 | 3 | 3 of 3 | 0 "
        "| mask 3 | 1 of 3 |"
    ) in lines
    assert "| exact | super-sdf | 2 | 0.3200 |" in "\n".join(lines)
    assert "Further from the truth than MC, mask: ball (0.6400, MC 0.3200)." in lines
    assert "Refused, exact: egg: no good." in lines
    assert "Pieces of the references, of 3 shapes together: 3." in lines


def test_unequal_spacings_are_compared_with_the_coarsest_on_all_axes(meshes, tmp_path):
    changed = {
        "ball": {"ours on spacing 1:1:5, y": {"p2s": 0.03}},
        "egg": {"ours on exact": {"p2s": 0.04}, "mc on spacing 1:1:5, x": {"p2s": 0.05}},
    }
    text = field_section(made_up(meshes, tmp_path, ("exact", "unequal"), **changed))
    assert "| spacing 1:1:5 | super-sdf | 9 | 0.3911 | 0.9600 |" in text
    assert (
        "spacing 1:1:5, error over that of super-sdf with the coarsest spacing on all axes, at "
        "most: MC 1.25 (egg); by hand to the coarsest spacing, cubic spline, super-sdf 1.00 (box); "
        "super-sdf 3.00 (ball)." in text
    )
    (tmp_path / "alone").mkdir()
    alone = field_section(made_up(meshes, tmp_path / "alone", ("unequal",)))
    assert "error over" not in alone


def test_a_failure_on_a_kind_leaves_the_main_table_alone(meshes, tmp_path):
    results = made_up(meshes, tmp_path)
    task = next(t for t in results.tasks if t.path.stem == "egg" and t.setting.size)
    results.store.add(failed_row(task, "mc on mask", "a bug"))
    again = Results(results.scope, results.tasks, results.store, [])
    assert [row["shape"] for row in again.rows(Setting(32), "mc")] == ["ball", "box", "egg"]
    assert [entry.reason for entry in again.left_out] == ["mc on mask (32^3, factor 4): a bug"]
    text = field_section(again)
    assert "| mask | MC | 2 |" in text and "| exact | MC | 3 |" in text
    for method in task.methods:  # the grid did not fit: nothing was measured
        results.store.add(failed_row(task, method, "out of memory"))
    again = Results(results.scope, results.tasks, results.store, [])
    assert [row["shape"] for row in again.rows(Setting(32), "mc")] == ["ball", "box"]
    (entry,) = again.left_out
    assert entry.reason == (
        "mc, mc on exact, bspline on exact, ours on exact, mc on mask, mc-distances on mask, "
        "mc-gaussian-0.5 on mask, mc-gaussian-0.8 on mask, 2 more (32^3, factor 4): out of memory"
    )


def evaluate(*words: object) -> subprocess.CompletedProcess[str]:
    """Run the command as a user does."""
    command = [sys.executable, "-m", "super_sdf", "evaluate", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True)


def test_only_what_is_missing_is_measured(meshes, tmp_path):
    out = tmp_path / "out"
    words = (meshes / "box.ply", "--sizes", 8, "--methods", "mc", "--model", "fast", "--turned", 3)
    words = (*words, "--experiments", "fields", "--no-pictures", "--jobs", 1, "--out", out)
    done = evaluate(*words, "--kinds", "exact")
    assert done.returncode == 0, done.stderr
    first = (out / "results.jsonl").read_text()
    keys = [json.loads(line)["method"] for line in first.splitlines()]
    assert keys == ["floor", "mc", "mc on exact", "bspline on exact", "ours on exact"]
    done = evaluate(*words, "--kinds", "exact", "mask")
    assert done.returncode == 0, done.stderr
    both = (out / "results.jsonl").read_text()
    assert both.startswith(first)
    more = [json.loads(line)["method"] for line in both[len(first) :].splitlines()]
    assert more == [f"{method} on mask" for method in KINDS["mask"].methods]
    report = (out / "report.md").read_text()
    assert "## Grids that are not exact distances, 1 shapes" in report
    assert "| mask | super-sdf | 1 |" in report
    rest = Scope(
        find_meshes([meshes / "box.ply"]),
        sizes=(8,),
        methods=("mc",),
        model="fast",
        turned=3,
        experiments=("fields",),
        kinds=("mask", "noisy"),
    )
    (task,) = missing_tasks(rest.tasks(), Store(out / "results.jsonl"))
    assert {KINDS[m.split(names.ON)[1]].group for m in task.methods} == {"noisy"}
