"""The bounds that samples set on the field: closed forms, properties, and where there are none."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import ball

from super_sdf import SdfGrid, pipeline
from super_sdf.steps.band import HALF_BAND, neighbour_table
from super_sdf.steps.bounds import (
    bounded_values,
    keep_within_bounds,
    samples_around,
)
from super_sdf.steps.nodes import average_shared, block_ijk, share_parts
from super_sdf.steps.survey import survey

CENTRE, RADIUS = 10 - 0.37, 6.0


def blocks_of(grid, factor=4):
    """Return the band, its decoded voxels, and their distances to the ball (n, Q), half voxels."""
    band = survey(grid)
    voxel_ijk = band.voxel_ijk[band.decoded]
    node = voxel_ijk[:, None] + block_ijk(factor) / factor - 0.5
    exact = 2 * (np.linalg.norm(node - CENTRE, axis=2) - RADIUS)
    return band, voxel_ijk, exact.astype(np.float32)


def around(voxel_ijk, trusted):
    """Return the samples round the blocks of voxels, (n, m)."""
    flat, start, steps = samples_around(voxel_ijk, trusted)
    return flat.take(start[:, None] + steps)


@pytest.mark.parametrize(("factor", "limit"), [(4, 100), (4, 1.7), (8, 3.0)])
def test_no_value_moves_away_from_the_truth_and_many_move_nearer(factor, limit):
    """Wherever others are cut off; those that are the truth stay."""
    cut = SdfGrid.trusted(np.clip(ball().values, -limit, limit), (1.0,) * 3)
    band, voxel_ijk, exact = blocks_of(cut, factor)
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
    band, voxel_ijk, exact = blocks_of(SdfGrid.trusted(steep, (1.0,) * 3))
    wrong = exact + 0.3
    own = np.abs(exact[:, exact.shape[1] // 2])
    moved = bounded_values(wrong, 4, around(voxel_ijk, band.trusted))
    np.testing.assert_array_equal(moved[own < 1.5], wrong[own < 1.5])


def test_copies_of_shared_nodes_stay_equal_and_samples_keep_their_values():
    band, voxel_ijk, exact = blocks_of(ball())
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
    band, voxel_ijk, exact = blocks_of(ball(), factor)
    blocks = np.pad(exact.T + np.float32(0.3), ((0, 0), (0, 1)))
    kept = blocks.copy()
    trusted = replace(band.trusted, limits=(-limit, limit))
    keep_within_bounds(blocks, None, factor, voxel_ijk, trusted)
    np.testing.assert_array_equal(blocks, kept)
