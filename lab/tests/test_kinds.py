"""Grids that are not exact distances: how they are made, meshed, measured and tabled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from solids import cube, joined, sphere

from lab import kinds as field_methods
from lab.figures import kind_rows
from lab.kinds import (
    AXES,
    BY_METHOD,
    KIND_LABELS,
    KINDS,
    level_set,
    samples_of,
    without_unknown,
)
from lab.measuring import Task, measure_method, measure_on_kind
from lab.shapes import Case, Setting, Shape
from lab.surfaces import closed_isosurface
from super_sdf import Mesh, load_network
from super_sdf.errors import GridError, OutOfMemoryError

SIDE = 3**-0.5  # of the cube whose box diagonal is 1
CUBIC = [name for name, kind in KINDS.items() if kind.ratio == 1]
TASK = Task(Path(), Setting(16), (), "fast")


def mesh_of(name, case, network):
    method, _, kind = name.partition(" on ")
    return BY_METHOD[method](KINDS[kind], case, network)


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


def test_every_method_of_a_kind_has_a_label_and_a_function():
    measured = {method for kind in KINDS.values() for method in kind.methods}
    assert measured == set(KIND_LABELS) == set(BY_METHOD)
    assert all({"mc", "ours"} <= set(kind.methods) for kind in KINDS.values())


@pytest.mark.parametrize("name", CUBIC)
def test_a_kind_keeps_the_side_of_every_sample(name, case):
    field, h = level_set(KINDS[name], values_of(name, case)), case.spacing
    apart = 0.25 * h if KINDS[name].group == "noisy" else 1e-6
    away = np.abs(case.coarse) > apart
    assert field.dtype == np.float32 and field.shape == case.coarse.shape
    assert ((field < 0) == (case.coarse < 0))[away].all() and away.mean() > 0.8


def test_unknown_values_become_those_of_the_nearest_sample():
    values = np.full((5, 5, 5), np.nan, np.float32)
    values[0], values[4] = -1, 2
    filled = without_unknown(values)
    assert (filled[:2] == -1).all() and (filled[3:] == 2).all()
    assert without_unknown(filled) is filled


@pytest.mark.parametrize("noise", [0.1, 0.25])
def test_noise_is_uniform_and_the_same_in_every_run(noise, case):
    found = values_of(f"noise of {noise:g}", case)
    off = (found - case.coarse) / case.spacing
    assert noise * 0.98 < np.abs(off).max() < noise * 1.001
    assert off.std() == pytest.approx(noise / 3**0.5, rel=0.05)
    again = Case(Shape("box", cube()), Setting(16))
    np.testing.assert_array_equal(values_of(f"noise of {noise:g}", again), found)


@pytest.mark.parametrize(("ratio", "axis"), [(1.5, "x"), (1.5, "y"), (5, "z")])
def test_unequal_spacings_are_exact_and_coarse_along_one_axis(ratio, axis, case):
    found = samples_of(KINDS[f"spacing 1:1:{ratio:g}, {axis}"], case)
    number = AXES.index(axis)
    assert found.values.shape[number] == 16 and set(found.values.shape) == {16, 16 * ratio}
    np.testing.assert_allclose(found.spacing * found.values.shape, 1)
    points = np.moveaxis(np.indices(found.values.shape), 0, -1) * found.spacing + found.origin
    np.testing.assert_allclose(points[0, 0, 0], -points[-1, -1, -1])
    np.testing.assert_allclose(found.values, box_distance(points), atol=1e-6)


@pytest.mark.parametrize(
    "name",
    [
        *("mc on exact", "bspline on cut off at 1.5", "ours on share of the voxel"),
        *("ours on d/100, no spacing given", "mc on spacing 1:1:1.5, y"),
        *("ours on spacing 1:1:1.5, y", "spline-finest on spacing 1:1:1.5, x"),
        "spline-coarsest on spacing 1:1:1.5, z",
    ],
)
def test_meshes_are_at_the_place_and_size_of_the_shape(name, case, fast):
    surface = mesh_of(name, case, fast)
    assert surface.mesh.is_closed() and surface.mesh.volume() == pytest.approx(SIDE**3, rel=0.08)
    assert np.abs(surface.mesh.vertices).max() == pytest.approx(SIDE / 2, abs=0.3 * case.spacing)
    assert np.abs(box_distance(surface.mesh.vertices)).mean() < 0.15 * case.spacing


@pytest.mark.parametrize("method", KINDS["mask"].methods)
def test_masks_are_meshed_within_half_a_voxel(method, case, fast):
    mesh = mesh_of(f"{method} on mask", case, fast).mesh
    assert mesh.is_closed()
    assert np.abs(box_distance(mesh.vertices)).mean() < 0.55 * case.spacing


def test_a_surface_that_leaves_the_grid_is_closed():
    inside = np.full((4, 4, 4), -1, np.float32)
    mesh = closed_isosurface(inside, (1, 2, 3), (10, 20, 30))
    assert mesh.is_closed() and mesh.volume() > 0
    np.testing.assert_allclose(mesh.vertices.min(0), [9.5, 19, 28.5])
    np.testing.assert_allclose(mesh.vertices.max(0), [13.5, 27, 40.5])


def test_volume_and_pieces_are_compared_with_the_reference():
    shape = Shape("ball", sphere())
    twice = joined(shape.mesh, Mesh(shape.mesh.vertices / 2 + 2, shape.mesh.faces))
    found = measure_on_kind(shape, twice)
    assert found["volume_off"] == pytest.approx(1 / 8, rel=1e-6)
    assert (found["pieces"], found["pieces_of_reference"], found["closed"]) == (2, 1, True)
    assert "efv" not in found


def refusing(*refused: str):
    """Return a ``make_grid`` that refuses some values of ``field``."""

    def make(values, *, field, **options):
        if field in refused:
            raise GridError(f"not with {field}")
        return field_methods.SdfGrid.trusted(values, options["spacing"], options["origin"])

    return make


def test_a_refusal_is_recorded_and_is_no_failure(case, monkeypatch):
    monkeypatch.setattr(field_methods, "make_grid", refusing("auto", "scaled"))
    found = measure_method(case.shape, case, "ours on d + d^2", TASK)
    assert found["error"] is None and found["refused"] == "not with auto"
    assert found["faces"] == 0 and found["pieces"] == 0 and "taken_as" not in found


def test_scaled_is_said_only_after_a_refusal_and_only_of_scaled_kinds(case, fast, monkeypatch):
    monkeypatch.setattr(field_methods, "make_grid", refusing("auto"))
    facts = mesh_of("ours on d + d^2", case, fast).facts
    assert facts == {"taken_as": "exact", "told": True}
    assert mesh_of("ours on exact", case, fast).facts == {"refused": "not with auto"}
    monkeypatch.setattr(field_methods, "make_grid", refusing())
    facts = mesh_of("ours on d + d^2", case, fast).facts
    assert facts == {"taken_as": "exact", "told": False}


def test_what_does_not_fit_in_memory_is_a_failure_and_no_refusal(case, monkeypatch):
    def full(*_, **__):
        raise OutOfMemoryError("too large")

    monkeypatch.setattr(field_methods, "reconstruct", full)
    found = measure_method(case.shape, case, "ours on exact", TASK)
    assert found == {"error": "too large"}


def test_what_the_values_were_taken_as(case, fast):
    pairs = ("mask", "mask"), ("cut off at 1", "truncated"), ("noise of 0.25", "noisy")
    for name, kind in pairs:
        assert mesh_of(f"ours on {name}", case, fast).facts["taken_as"] == kind


class Known:
    """Results that are made up, by method and kind."""

    def of(self, setting, name):
        method = name.partition(" on ")[0]
        figures = {"f1": 0.5, "nc": 0.9, "closed": True, "pieces": 1, "pieces_of_reference": 1}
        own = {"taken_as": "mask", "told": False} if method == "ours" else {}
        refused = {"refused": "no good"} if method == "ours" else {}
        far = {"mc": 0.01, "ours": 0.02}.get(method, 0.03)
        shapes = {"box": own, "ball": own, "egg": refused}
        return [{**figures, "shape": s, "p2s": far, "volume_off": -0.02, **m}
                for s, m in shapes.items()]  # fmt: skip


def test_refused_grids_are_left_out_of_the_rows_of_a_kind_for_all_methods():
    rows = {row["method"]: row for row in kind_rows(Known(), Setting(32), "shapes", "exact")}
    assert [row["grids"] for row in rows.values()] == [2, 2, 2]
    assert rows["ours"]["refused"] == 1 and rows["ours"]["taken_as"] == "mask"
    assert rows["mc"]["voxels"] == pytest.approx(0.32) and rows["mc"]["volume"] == pytest.approx(2)
    (unequal,) = {r["grids"] for r in kind_rows(Known(), Setting(32), "shapes", "spacing 1:1:5")}
    assert unequal == 6  # three axes
