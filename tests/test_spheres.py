"""The fit to the samples' spheres, and the bounds that they set: closed forms, properties."""

import numpy as np
import pytest
from conftest import ball, trilinear
from solids import box_distance

from super_sdf import SdfGrid, load_network, pipeline, reconstruct, upsample
from super_sdf.refine.band import survey

MIDDLE = 10 - 0.37  # of the ball


def away(points):
    """Return the distances of points (..., 3) from the ball."""
    return np.linalg.norm(points - MIDDLE, axis=-1) - 6


def network_for(grid, error):
    """Return a network that knows the ball, with an error: one number, or some by voxel."""
    places, error = survey(grid).voxel_ijk, np.atleast_2d(error)

    def values(patches, table, voxels, offsets):
        found = 2 * away(places[voxels, None] + offsets / 2)  # in half voxels
        return (found + error[voxels % len(error)]).astype(np.float32)

    return values


def without(monkeypatch, *steps):
    """Leave out steps of the method."""
    for step in steps:
        monkeypatch.setattr(pipeline, step, lambda *_: None)


@pytest.mark.parametrize("bias", [-0.2, 0.1])
def test_a_constant_error_of_the_network_is_corrected(bias):
    field = upsample(ball(), network_for(ball(), bias))
    truth = away(field.positions())
    off = 2 * np.abs(field.distances() - truth)[np.abs(truth) < 0.15]
    assert off.max() < 0.4 * abs(bias) and off.mean() < 0.2 * abs(bias)


def test_noisy_samples_move_nothing(monkeypatch):
    grid = ball()
    noise = np.random.default_rng(0).uniform(-0.3, 0.3, grid.shape)
    grid = SdfGrid.trusted(grid.values + noise, grid.spacing)
    moved = upsample(grid, trilinear).values
    without(monkeypatch, "fit_to_spheres", "keep_within_bounds")
    np.testing.assert_array_equal(upsample(grid, trilinear).values, moved)


@pytest.mark.parametrize(
    "step, other, least",
    [("fit_to_spheres", (), 0.35), ("keep_within_bounds", ("fit_to_spheres",), 0.7)],
)
def test_a_step_improves_an_interpolated_ball(monkeypatch, step, other, least):
    """The bounds without the fit, after which little is left."""

    def error():
        return np.abs(away(reconstruct(ball(), trilinear).vertices)).mean()

    without(monkeypatch, *other)
    improved = error()
    without(monkeypatch, step)
    assert improved < least * error()


def test_a_wall_between_the_samples_is_found():
    """It is a third of a voxel thick and contains no sample: all values are positive."""
    outer = box_distance(np.moveaxis(np.indices((16, 16, 16)), 0, -1) - 7.5, [4.6, 0.17, 4.6])
    assert outer.min() > 0
    mesh = reconstruct(SdfGrid.trusted(outer, (1.0,) * 3, (-7.5,) * 3), load_network())
    assert mesh.is_closed()
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx([9.2, 0.34, 9.2], abs=0.25)
    assert mesh.volume() == pytest.approx(9.2 * 9.2 * 0.34, rel=0.2)


@pytest.mark.parametrize(("factor", "limit"), [(4, 100), (4, 1.7), (8, 3.0)])
def test_bounds_move_no_value_away_from_the_truth_and_many_nearer(monkeypatch, factor, limit):
    """Wherever samples are cut off; values that are the truth stay."""
    without(monkeypatch, "fit_to_spheres")
    grid = SdfGrid.trusted(np.clip(ball().values, -limit, limit), 1.0)
    noisy = network_for(grid, np.random.default_rng(0).normal(0, 0.2, (9999, (factor + 1) ** 3)))
    exact, moved = (upsample(grid, network, factor) for network in (network_for(grid, 0), noisy))
    truth = away(exact.positions())
    np.testing.assert_allclose(exact.distances(), truth, atol=1e-5)
    without(monkeypatch, "keep_within_bounds")
    before, after = (
        np.abs(field.distances() - truth) for field in (upsample(grid, noisy, factor), moved)
    )
    assert (after <= before + 1e-5).mean() > 0.999  # but for means of shared nodes
    assert after.mean() < (0.7 if limit == 100 else 1) * before.mean()
