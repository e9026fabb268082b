"""The fit to the samples' spheres, and the bounds that they set: closed forms, properties."""

import numpy as np
import pytest
from conftest import ball, trilinear

from super_sdf import SdfGrid, load_network, pipeline, reconstruct
from super_sdf.refine.band import neighbour_table, survey
from super_sdf.refine.bounds import keep_within_bounds
from super_sdf.refine.nodes import VoxelIndex, average_shared, block_ijk, share_parts
from super_sdf.refine.spheres import fit_to_spheres, spheres_of_band

MIDDLE = 10 - 0.37  # of the ball


class Fields:
    """What the steps get of a grid of the ball, and the distances at the nodes, in half voxels."""

    def __init__(self, grid, factor=4):
        self.band, self.factor = survey(grid), factor
        self.ijk = self.band.voxel_ijk[self.band.decoded]
        self.parts = share_parts(neighbour_table(self.ijk, grid.shape))
        self.index = VoxelIndex(self.ijk, grid.shape)
        self.spheres = spheres_of_band(self.band)
        node = self.ijk + block_ijk(factor)[:, None] / factor - 0.5
        away = 2 * (np.linalg.norm(node - MIDDLE, axis=2) - 6)
        self.exact = np.pad(away.astype(np.float32), ((0, 0), (0, 1)))

    def wrong(self, by):
        """Return the distances with an error, the same at nodes that blocks share, none at samples.

        The last column is 0.
        """
        blocks = self.exact + np.float32(by)
        blocks[len(blocks) // 2], blocks[:, -1] = self.exact[len(blocks) // 2], 0
        average_shared(blocks, self.parts, self.factor)
        return blocks

    def bounded(self, blocks):
        moved = blocks.copy()
        keep_within_bounds(moved, self.parts, self.factor, self.ijk, self.band.trusted)
        return moved


@pytest.mark.parametrize("bias", [-0.2, 0.1])
def test_a_constant_error_is_corrected_and_exact_samples_are_kept(bias):
    fields = Fields(ball())
    moved = fields.exact + np.float32(bias)
    moved[:, -1] = 0
    fit_to_spheres(moved, fields.parts, 4, fields.spheres, fields.index)
    off = np.abs(moved - fields.exact)[np.abs(fields.exact) < 0.3]
    assert off.max() < 0.4 * abs(bias) and off.mean() < 0.2 * abs(bias)
    samples = 2 * ball().values[tuple(fields.ijk.T)]
    np.testing.assert_allclose(moved[62, :-1], samples, atol=1e-6)


def test_noisy_samples_move_nothing():
    grid = ball()
    noise = np.random.default_rng(0).uniform(-0.3, 0.3, grid.shape)
    fields = Fields(SdfGrid.trusted(grid.values + noise, grid.spacing))
    blocks = fields.exact.copy()
    fit_to_spheres(blocks, fields.parts, 4, fields.spheres, fields.index)
    np.testing.assert_array_equal(fields.bounded(blocks), fields.exact)


def test_samples_that_contradict_others_and_truncated_ones_are_not_exact():
    grid = ball()
    band = survey(SdfGrid.trusted(np.clip(grid.values, -0.25, 0.25), grid.spacing))
    np.testing.assert_array_equal(band.exact, np.abs(band.patches[:, 13]) < 0.5)
    grid.values[3, 9, 9] += 3  # near the surface
    band = survey(grid)
    assert 0 < (~band.lipschitz).sum() <= 27
    np.testing.assert_array_equal(band.exact, (np.abs(band.patches[:, 13]) < 2.8) & band.lipschitz)


@pytest.mark.parametrize(
    "step, other, least",
    [("fit_to_spheres", "", 0.35), ("keep_within_bounds", "fit_to_spheres", 0.7)],
)
def test_a_step_improves_an_interpolated_ball(monkeypatch, step, other, least):
    """The bounds without the fit, after which little is left."""

    def error():
        mesh = reconstruct(ball(), trilinear)
        return np.abs(np.linalg.norm(mesh.vertices - MIDDLE, axis=1) - 6).mean()

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
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx([9.2, 0.34, 9.2], abs=0.25)
    assert mesh.volume() == pytest.approx(9.2 * 9.2 * 0.34, rel=0.2)


@pytest.mark.parametrize(("factor", "limit"), [(4, 100), (4, 1.7), (8, 3.0)])
def test_bounds_move_no_value_away_from_the_truth_and_many_nearer(factor, limit):
    """Wherever others are cut off; those that are the truth stay, and copies of nodes agree."""
    fields = Fields(SdfGrid.trusted(np.clip(ball().values, -limit, limit), 1.0), factor)
    np.testing.assert_allclose(fields.bounded(fields.exact), fields.exact, atol=2e-5)
    blocks = fields.wrong(np.random.default_rng(0).normal(0, 0.2, fields.exact.shape))
    moved = fields.bounded(blocks)
    before, after = np.abs(blocks - fields.exact), np.abs(moved - fields.exact)
    assert (after <= before + 2e-5).mean() > 0.999  # but for means of shared nodes
    assert after.mean() < (0.7 if limit == 100 else 1) * before.mean()
    again = moved.copy()
    average_shared(again, fields.parts, factor)
    np.testing.assert_array_equal(again, moved)
    middle = len(moved) // 2
    np.testing.assert_array_equal(moved[middle], fields.exact[middle])
