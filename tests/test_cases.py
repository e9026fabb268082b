"""The truth that is measured against, and the baselines against SciPy and each other."""

from __future__ import annotations

import re

import numpy as np
import pytest
from conftest import trilinear
from scipy import ndimage
from solids import cube, saved, sphere, torus

from super_sdf import Mesh, load_network, pipeline
from super_sdf.errors import NoSurfaceError
from super_sdf.evaluation import methods
from super_sdf.evaluation.cases import Case, Setting, Shape
from super_sdf.evaluation.measuring import Task, measure_method, measure_task
from super_sdf.evaluation.metrics import distance_or_dot
from super_sdf.truth.solid import Solid


def case_of(mesh: Mesh, setting: Setting) -> Case:
    """Return a mesh, put into the frame and sampled."""
    return Case(Shape("some", mesh), setting)


@pytest.mark.parametrize("order", [1, 3])
def test_upsampling_keeps_samples_and_straight_lines(order):
    coarse = np.random.default_rng(1).random((16, 16, 16))
    fine = methods.interpolate_spline(coarse, 4, order)
    np.testing.assert_allclose(fine[2::4, 2::4, 2::4], coarse, atol=1e-6)
    ramp = np.broadcast_to(np.arange(32.0)[:, None, None], (32, 32, 32))
    middle = methods.interpolate_spline(ramp, 4, order)[40:-40, 64, 64]
    np.testing.assert_allclose(middle, np.arange(40, 89) / 4 - 0.5, atol=1e-4)


def test_upsampling_is_that_of_scipy():
    coarse = np.random.default_rng(2).random((6, 6, 6))
    position = np.meshgrid(*[np.arange(25) / 4 - 0.5] * 3, indexing="ij")
    expected = ndimage.map_coordinates(coarse, position, order=3, mode="nearest")
    np.testing.assert_allclose(methods.interpolate_spline(coarse, 4, 3), expected, atol=1e-5)


@pytest.mark.parametrize("setting", [Setting(12, 2), Setting(12, 4), Setting(12, 4, scale=0.5)])
def test_the_truth_is_exact_near_the_surface_and_right_in_sign(setting):
    case = case_of(cube(), setting)
    nodes = np.indices(case.truth.shape).reshape(3, -1).T
    exact = case.shape.solid.signed_distance(nodes * case.fine + case.low)
    exact = exact.reshape(case.truth.shape)
    # On the very surface the winding number may say either; the distance there is 0.
    away = np.abs(exact) > 1e-6
    assert (np.sign(case.truth) == np.sign(exact))[away].all()
    near = np.abs(exact) < 3**0.5 * case.fine
    np.testing.assert_allclose(np.abs(case.truth[near]), np.abs(exact[near]), atol=1e-6)
    np.testing.assert_allclose(case.truth[case.band & away], exact[case.band & away], atol=1e-6)


@pytest.fixture
def unfitted(monkeypatch):
    """Leave the network's values as they are."""
    monkeypatch.setattr(pipeline, "fit_to_spheres", lambda *_: None)
    monkeypatch.setattr(pipeline, "keep_within_bounds", lambda *_: None)


@pytest.mark.usefixtures("unfitted")
def test_ours_with_a_trilinear_network_is_the_trilinear_baseline():
    case = case_of(sphere(), Setting(16))
    ours = methods.our_surface(case, trilinear)
    baseline = methods.spline_surface(case, trilinear, order=1)
    near = case.band & (np.abs(baseline.field()) < case.spacing)  # patches are cut off at 3 h
    np.testing.assert_allclose(ours.field()[near], baseline.field()[near], atol=1e-6)
    assert ours.mesh.is_closed()
    assert ours.mesh.volume() == pytest.approx(baseline.mesh.volume(), rel=1e-3)
    assert distance_or_dot(Solid(baseline.mesh), ours.mesh.vertices).max() < case.fine / 4


@pytest.mark.usefixtures("unfitted")
def test_a_second_pass_starts_from_the_first():
    """Trilinear interpolation of linear distances is exact, however often; the cube is the rest."""
    case = case_of(cube(), Setting(16))
    again = methods.refined_grid(case.grid, trilinear, 4)
    assert again.shape == (65, 65, 65) and again.voxel_size == pytest.approx(case.fine)
    np.testing.assert_allclose(again.origin, case.low, atol=1e-12)
    position = [np.arange(65) / 4 - 0.5] * 3
    expected = ndimage.map_coordinates(
        case.coarse, np.meshgrid(*position, indexing="ij"), order=1, mode="nearest"
    )
    near = np.abs(again.values) < case.spacing / 2
    np.testing.assert_allclose(again.values[near], expected[near], atol=1e-6)


@pytest.mark.parametrize("method", methods.METHODS)
def test_every_method_finds_the_torus_where_it_is(method):
    row = measure_method(*shape_and_case(torus(), Setting(24)), method, load_network())
    assert row["error"] is None and row["closed"] and row["outward"]
    assert row["p2s"] < 0.05 / 24 and row["nc"] > 0.98
    assert row["seconds"] > 0


def test_the_bound_is_better_than_ours_and_ours_than_the_coarse_grid():
    shape, case = shape_and_case(cube(), Setting(20))
    network = load_network()
    rows = {name: measure_method(shape, case, name, network) for name in ("mc", "ours", "bound")}
    assert rows["mc"]["p2s"] > rows["ours"]["p2s"] > rows["bound"]["p2s"]
    assert rows["mc"]["f1"] < rows["ours"]["f1"] < rows["bound"]["f1"] + 0.001  # of random points


def test_noise_is_seeded_bounded_and_only_where_asked():
    clean, noisy, again = (case_of(torus(), Setting(16, noise=noise)) for noise in (0, 0.5, 0.5))
    np.testing.assert_array_equal(clean.grid.values, clean.coarse)
    np.testing.assert_array_equal(noisy.grid.values, again.grid.values)
    np.testing.assert_array_equal(noisy.coarse, clean.coarse)
    error = np.abs(noisy.grid.values - clean.coarse)
    assert 0.24 / 16 < error.max() <= 0.25 / 16 + 1e-7


def test_a_scale_is_the_longest_side_over_that_of_the_grid():
    case = case_of(Mesh(cube().vertices * [3, 1, 1], cube().faces), Setting(32, scale=0.25))
    longest = 3 / np.sqrt(11)
    assert case.side == pytest.approx(4 * longest)
    assert (case.coarse[:, 16, 16] < 0).sum() == 8


def test_a_method_that_raises_has_no_figures_and_is_named(monkeypatch):
    def broken(case, network):
        raise ValueError("no luck\nat all")

    monkeypatch.setitem(methods.METHODS, "mc", broken)
    row = measure_method(*shape_and_case(cube(), Setting(8)), "mc", trilinear)
    assert row.keys() == {"error"}
    assert re.fullmatch(r"ValueError: no luck \(test_cases\.py:\d+\)", row["error"])


def test_a_surface_that_is_not_found_counts_as_a_dot():
    thin = Mesh(cube().vertices * [1, 1, 1e-4], cube().faces)  # no sample lies in it
    row = measure_method(*shape_and_case(thin, Setting(8)), "mc", trilinear)
    assert row["error"] is None and row["f1"] < 1e-4 and row["faces"] == 0 and not row["closed"]

    def nothing(*_, **__):
        raise NoSurfaceError("no surface at 0")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(methods, "reconstruct", nothing)
        row = measure_method(*shape_and_case(cube(), Setting(8)), "ours", trilinear)
    assert row["error"] is None and row["f1"] == 0 and row["faces"] == 0


def test_a_lattice_beyond_memory_fails_its_methods_and_not_the_shape(tmp_path):
    path = saved(cube(), tmp_path / "box.ply")
    task = Task(path, "sum", Setting(8000, 16), ("mc", "bound"), "base", "digest")
    rows = list(measure_task(task, Shape.read(path)))
    assert [row["method"] for row in rows] == ["mc", "bound"]
    assert all("measuring 8000^3 refined to " in row["error"] for row in rows)
    assert all("f1" not in row for row in rows)  # that is no score


def shape_and_case(mesh: Mesh, setting: Setting) -> tuple[Shape, Case]:
    """Return a shape and its case in a setting."""
    shape = Shape("some", mesh)
    return shape, Case(shape, setting)
