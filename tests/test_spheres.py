"""The fit to the samples' spheres, and the bounds that they set: closed forms, properties."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import ball, trilinear

from super_sdf import SdfGrid, load_network, pipeline, reconstruct
from super_sdf.refine.band import HALF_BAND, MAX_DISTANCE, neighbour_table
from super_sdf.refine.bounds import bounded_values, keep_within_bounds, samples_around
from super_sdf.refine.nodes import VoxelIndex, average_shared, block_ijk, share_parts
from super_sdf.refine.spheres import find_foot_points, fit_to_spheres, spheres_of_band
from super_sdf.refine.survey import survey

CENTRE_OF_BALL = 10 - 0.37


def blocks_of(grid, factor=4):
    """Return spheres, index, parts and node positions (Q, D, 3) in half voxels of a grid."""
    band = survey(grid)
    table = neighbour_table(band.voxel_ijk, grid.shape)
    voxels = np.flatnonzero(band.decoded).astype(np.int32)
    row_of = pipeline.nodes.rows_among(voxels, len(table))
    own_ijk = band.voxel_ijk[voxels]
    exact = np.flatnonzero(band.exact)
    spheres = spheres_of_band(band.voxel_ijk, band.patches, exact, band.shape, band.limits)
    position = 2 * own_ijk + block_ijk(factor)[:, None] * (2 / factor) - 1
    touched = spheres, VoxelIndex(own_ijk, band.shape)
    return touched, share_parts(row_of[table[voxels]]), position


def distance_to_ball(nodes):
    """Return blocks of distances to the ball in half voxels, with the column of zeros."""
    exact = np.linalg.norm(nodes - 2 * CENTRE_OF_BALL, axis=2) - 12
    return np.pad(exact.astype(np.float32), ((0, 0), (0, 1)))


def fitted(blocks, parts, touched):
    moved = blocks.copy()
    fit_to_spheres(moved, parts, 4, *touched)
    return moved


def is_near(spheres):
    """Return which samples lie in the band; the others are a voxel farther away."""
    return np.abs(spheres.distance) < MAX_DISTANCE


@pytest.mark.parametrize("factor", [2, 8])
def test_foot_points_lie_on_the_surface(factor):
    (spheres, index), _, position = blocks_of(ball(), factor)
    feet = find_foot_points(distance_to_ball(position), factor, spheres, index)
    assert len(feet.rows) == len(spheres)
    assert np.abs(feet.values).max() < 0.12 / factor  # linear interpolation of a curved field
    near = is_near(spheres)
    assert feet.weights[near].min() > 0.95
    assert feet.weights[~near].mean() < 0.85  # farther away, they say less


@pytest.mark.parametrize("limit", [100, 2.1, 1.5])
def test_samples_a_voxel_beyond_the_band_have_spheres_unless_they_were_cut_off(limit):
    grid = ball()
    rescaled = 2 * grid.values
    (spheres, _), _, _ = blocks_of(SdfGrid.trusted(np.clip(grid.values, -limit, limit), 1.0))
    assert np.abs(spheres.distance).max() < 2 * limit
    np.testing.assert_allclose(spheres.distance, rescaled[tuple(spheres.centre.T)], atol=1e-5)
    if limit == 100:
        apart, near = np.abs(rescaled), is_near(spheres)
        np.testing.assert_array_equal(spheres.centre[near], np.argwhere(apart < MAX_DISTANCE))
        beyond = np.argwhere((apart >= MAX_DISTANCE) & (apart < MAX_DISTANCE + 2))
        np.testing.assert_array_equal(spheres.centre[~near], beyond)
        outwards = spheres.centre - CENTRE_OF_BALL
        outwards /= np.linalg.norm(outwards, axis=1)[:, None]
        assert (outwards * spheres.direction.T).sum(1).min() > 0.95


@pytest.mark.parametrize("bias", [-0.2, 0.1])
def test_a_constant_error_is_corrected_and_exact_samples_are_kept(bias):
    (spheres, index), parts, position = blocks_of(ball())
    exact = distance_to_ball(position)
    biased = exact + np.float32(bias)
    biased[:, -1] = 0
    moved = fitted(biased, parts, (spheres, index))
    off = np.abs(moved - exact)[np.abs(exact) < 0.3]
    assert off.max() < 0.4 * abs(bias)
    assert off.mean() < 0.2 * abs(bias)
    rows = index.find(spheres.centre)
    np.testing.assert_array_equal(moved[62, rows[rows >= 0]], spheres.distance[rows >= 0])
    assert (rows >= 0).sum() == moved.shape[1] - 1


def test_noisy_samples_move_nothing_and_bad_or_truncated_ones_are_not_exact():
    grid = ball()
    noise = np.random.default_rng(0).uniform(-0.3, 0.3, grid.shape)
    samples, parts, position = blocks_of(SdfGrid.trusted(grid.values + noise, grid.spacing))
    assert not len(samples[0])
    blocks = distance_to_ball(position)
    np.testing.assert_array_equal(fitted(blocks, parts, samples), blocks)
    band = survey(SdfGrid.trusted(np.clip(grid.values, -0.25, 0.25), grid.spacing))
    np.testing.assert_array_equal(band.exact, np.abs(band.patches[:, 13]) < 0.5)
    grid.values[3, 9, 9] += 3  # near the surface
    band = survey(grid)
    assert 0 < (~band.lipschitz).sum() <= 27
    near = np.abs(band.patches[:, 13]) < 2.8
    np.testing.assert_array_equal(band.exact, near & band.lipschitz)


@pytest.mark.parametrize(
    "step, other, least",
    [("fit_to_spheres", "", 0.35), ("keep_within_bounds", "fit_to_spheres", 0.7)],
)
def test_a_step_improves_an_interpolated_ball(monkeypatch, step, other, least):
    """The bounds without the fit, after which little is left."""

    def error():
        mesh = reconstruct(ball(), trilinear)
        return np.abs(np.linalg.norm(mesh.vertices - CENTRE_OF_BALL, axis=1) - 6).mean()

    if other:
        monkeypatch.setattr(pipeline, other, lambda *_: None)
    improved = error()
    monkeypatch.setattr(pipeline, step, lambda *_: None)
    assert improved < least * error()


def test_a_wall_between_the_samples_is_found():
    """It is a third of a voxel thick and contains no sample: all values are positive."""
    ijk = np.indices((16, 16, 16)) - 7.5
    beyond = np.abs(ijk) - np.array([4.6, 0.17, 4.6])[:, None, None, None]
    outer = np.linalg.norm(np.maximum(beyond, 0), axis=0) + np.minimum(beyond.max(0), 0)
    assert outer.min() > 0
    mesh = reconstruct(SdfGrid.trusted(outer, (1.0,) * 3, (-7.5,) * 3), load_network())
    assert mesh.is_closed()
    thickness = np.ptp(mesh.vertices, axis=0)
    assert thickness == pytest.approx([9.2, 0.34, 9.2], abs=0.25)
    assert mesh.volume() == pytest.approx(9.2 * 9.2 * 0.34, rel=0.2)


def decoded_blocks(grid, factor=4):
    """Return the band, its decoded voxels, and their distances to the ball (n, Q), half voxels."""
    band = survey(grid)
    voxel_ijk = band.voxel_ijk[band.decoded]
    node = voxel_ijk[:, None] + block_ijk(factor) / factor - 0.5
    exact = 2 * (np.linalg.norm(node - CENTRE_OF_BALL, axis=2) - 6.0)
    return band, voxel_ijk, exact.astype(np.float32)


def around(voxel_ijk, trusted):
    """Return the samples round the blocks of voxels, (n, m)."""
    flat, start, steps = samples_around(voxel_ijk, trusted)
    return flat.take(start[:, None] + steps)


@pytest.mark.parametrize(("factor", "limit"), [(4, 100), (4, 1.7), (8, 3.0)])
def test_no_value_moves_away_from_the_truth_and_many_move_nearer(factor, limit):
    """Wherever others are cut off; those that are the truth stay."""
    cut = SdfGrid.trusted(np.clip(ball().values, -limit, limit), (1.0,) * 3)
    band, voxel_ijk, exact = decoded_blocks(cut, factor)
    samples = around(voxel_ijk, band.trusted)
    np.testing.assert_allclose(bounded_values(exact, factor, samples), exact, atol=2e-5)
    wrong = exact + np.random.default_rng(0).normal(0, 0.3, exact.shape).astype(np.float32)
    before, after = np.abs(wrong - exact), np.abs(bounded_values(wrong, factor, samples) - exact)
    assert (after <= before + 2e-5).all()
    if limit == 100:
        assert (after < before - 1e-3).mean() > 0.5
        assert after.mean() < 0.5 * before.mean()


def test_the_bound_of_one_sample_is_its_distance_less_that_to_the_node():
    """Two samples are trusted: that of the block, and one outside, three voxels away."""
    values = np.full((9, 9, 9), 50.0)
    values[4, 4, 5] = 0.05  # a sample from which the field rises to all others was filled in
    values[4, 4, 4], values[4, 4, 7] = 0.2, 3.1  # at most 0.2 + 3
    band = survey(SdfGrid.trusted(values, (1.0,) * 3))
    voxel = np.array([[4, 4, 4]], np.int32)
    rows = (band.voxel_ijk == voxel).all(1)
    trusted = replace(band.trusted, exact=rows)
    moved = bounded_values(np.full((1, 125), -1, np.float32), 4, around(voxel, trusted))
    node = 4 + block_ijk(4) / 4 - 0.5
    own = 0.2 - np.linalg.norm(node - 4, axis=1)
    far = 3.1 - np.linalg.norm(node - [4, 4, 7], axis=1)
    wanted = 2 * np.maximum(np.maximum(own, far), -0.5)
    wanted[62] = -1  # the sample itself
    np.testing.assert_allclose(moved[0], wanted, atol=1e-6)


def test_samples_that_contradict_others_set_no_bounds():
    """Values that grow faster than distances are none."""
    grid = ball()
    steep = np.where(np.abs(grid.values) < 1.5, grid.values, 1.2 * grid.values)
    band, voxel_ijk, exact = decoded_blocks(SdfGrid.trusted(steep, (1.0,) * 3))
    wrong = exact + 0.3
    own = np.abs(exact[:, exact.shape[1] // 2])
    moved = bounded_values(wrong, 4, around(voxel_ijk, band.trusted))
    np.testing.assert_array_equal(moved[own < 1.5], wrong[own < 1.5])


def test_copies_of_shared_nodes_stay_equal_and_samples_keep_their_values():
    band, voxel_ijk, exact = decoded_blocks(ball())
    table = neighbour_table(band.voxel_ijk, band.shape)
    voxels = np.flatnonzero(band.decoded)
    parts = share_parts(pipeline.nodes.rows_among(voxels, len(table))[table[voxels]])
    wrong = exact + np.random.default_rng(0).normal(0, 0.2, exact.shape).astype(np.float32)
    wrong[:, 62] = exact[:, 62]
    blocks = np.pad(wrong.T, ((0, 0), (0, 1)))
    average_shared(blocks, parts, 4)
    moved = blocks.copy()
    keep_within_bounds(moved, parts, 4, voxel_ijk, band.trusted)
    again = moved.copy()
    average_shared(again, parts, 4)
    np.testing.assert_array_equal(again, moved)
    np.testing.assert_array_equal(moved[62, :-1], exact[:, 62])
    error = [np.abs(values[:, :-1].T - exact).mean() for values in (blocks, moved)]
    assert error[1] < 0.6 * error[0]


@pytest.mark.parametrize("factor, limit", [(4, 0.0), (4, HALF_BAND), (2, 100.0)])
def test_where_no_sample_beyond_the_band_is_trusted_nothing_moves(factor, limit):
    """Of a resampled grid, of one that is cut off at 1.5 voxels, and with a factor of 2."""
    band, voxel_ijk, exact = decoded_blocks(ball(), factor)
    blocks = np.pad(exact.T + np.float32(0.3), ((0, 0), (0, 1)))
    kept = blocks.copy()
    trusted = replace(band.trusted, limits=(-limit, limit))
    keep_within_bounds(blocks, None, factor, voxel_ijk, trusted)
    np.testing.assert_array_equal(blocks, kept)
