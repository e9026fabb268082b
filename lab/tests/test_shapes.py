"""The truth that is measured against, and the baselines against SciPy and each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from solids import cube, saved, torus

from lab import methods
from lab.measuring import Task, measure_method
from lab.shapes import Case, Setting, Shape, normalise
from lab.surfaces import interpolate_spline
from super_sdf import Mesh

TASK = Task(Path(), Setting(8), ())


def test_upsampling_is_that_of_scipy():
    coarse = np.random.default_rng(2).random((6, 6, 6))
    position = np.meshgrid(*[np.arange(25) / 4 - 0.5] * 3, indexing="ij")
    expected = ndimage.map_coordinates(coarse, position, order=3, mode="nearest")
    np.testing.assert_allclose(interpolate_spline(coarse, 4, 3), expected, atol=1e-5)


@pytest.mark.parametrize("setting", [Setting(12, 2), Setting(12, 4), Setting(12, 4, scale=0.5)])
def test_the_truth_is_exact_near_the_surface_and_right_in_sign(setting):
    _, case = shape_and_case(cube(), setting)
    nodes = np.indices(case.truth.shape).reshape(3, -1).T
    exact = case.shape.solid.signed_distance(nodes * case.fine + case.low)
    exact = exact.reshape(case.truth.shape)
    # On the very surface the winding number may say either; the distance there is 0.
    away = np.abs(exact) > 1e-6
    assert (np.sign(case.truth) == np.sign(exact))[away].all()
    near = np.abs(exact) < 3**0.5 * case.fine
    np.testing.assert_allclose(np.abs(case.truth[near]), np.abs(exact[near]), atol=1e-6)
    np.testing.assert_allclose(case.truth[case.band & away], exact[case.band & away], atol=1e-6)


@pytest.mark.parametrize("method", methods.METHODS)
def test_every_method_finds_the_torus_where_it_is(method):
    row = measure_method(*shape_and_case(torus(), Setting(24)), method, TASK)
    assert row["error"] is None and row["closed"] and row["outward"]
    assert row["p2s"] < 0.05 / 24 and row["nc"] > 0.98
    assert row["seconds"] > 0


def test_the_bound_is_better_than_ours_and_ours_than_the_coarse_grid():
    shape, case = shape_and_case(cube(), Setting(20))
    rows = {name: measure_method(shape, case, name, TASK) for name in ("mc", "ours", "bound")}
    assert rows["mc"]["p2s"] > rows["ours"]["p2s"] > rows["bound"]["p2s"]
    assert rows["mc"]["f1"] < rows["ours"]["f1"] < rows["bound"]["f1"] + 0.001  # of random points


def shape_and_case(mesh: Mesh, setting: Setting) -> tuple[Shape, Case]:
    shape = Shape("some", normalise(mesh))
    return shape, Case(shape, setting)


@pytest.mark.parametrize("seed", [0, 3])
def test_a_shape_is_turned_by_its_name_and_a_seed(tmp_path, seed):
    path, other = (saved(cube(), tmp_path / f"{name}.ply") for name in ("box", "cube"))
    plain, turned, again = Shape.read(path), Shape.read(path, seed), Shape.read(path, seed)
    np.testing.assert_array_equal(turned.mesh.vertices, again.mesh.vertices)
    assert np.linalg.norm(np.ptp(turned.mesh.vertices, axis=0)) == pytest.approx(1)
    side = turned.mesh.volume() ** (1 / 3)  # still a cube, but smaller in its box
    assert side < 0.99 * plain.mesh.volume() ** (1 / 3)
    np.testing.assert_allclose(np.linalg.norm(turned.mesh.vertices, axis=1), side * 0.75**0.5)
    for differs in (Shape.read(path, seed + 1), Shape.read(other, seed)):
        assert np.abs(turned.mesh.vertices - differs.mesh.vertices).max() > 0.01


def test_ours_with_fewer_triangles_and_another_mesher():
    shape, case = shape_and_case(cube(), Setting(12))
    task = replace(TASK, model="fast")
    whole, quarter, plain, within = (
        measure_method(shape, case, name, task)
        for name in ("ours", "ours/4", "ours-marching@fast:float32", "ours/within")
    )
    assert whole["faces"] / 8 < quarter["faces"] <= whole["faces"] / 4  # a cube has few steps
    assert whole["efv"] > plain["efv"] and whole["closed"]
    assert within["faces"] < whole["faces"] / 3 and within["closed"]
    case.triangles["dual-contouring"] = 300
    assert measure_method(shape, case, "ours/dual-contouring", task)["faces"] <= 300
    error = measure_method(shape, case, "none", task)["error"]
    assert error.startswith("method is 'none': give one of mc, ")
