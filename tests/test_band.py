"""Eqs. 2 and 4, patches and neighbours, against their definitions."""

import numpy as np
import pytest
from conftest import ball

from super_sdf import SdfGrid
from super_sdf.neighbourhood import CENTRE, NEIGHBOURHOOD
from super_sdf.steps.band import (
    can_hold_surface,
    find_band,
    gather_patches,
    is_lipschitz,
    neighbour_table,
    rescale,
)


def test_rescale_is_equation_4_whatever_the_unit():
    values = np.linspace(-1, 1, 27).reshape(3, 3, 3)
    for unit in (1e-6, 1.0, 1e6):
        grid = SdfGrid(values * unit, (0.5 * unit,) * 3)
        np.testing.assert_allclose(rescale(grid), values * 4, rtol=1e-6)
        np.testing.assert_allclose(rescale(grid, 0.25 * unit), (values - 0.25) * 4, rtol=1e-6)


def test_the_band_of_a_distance_is_equation_2():
    grid = ball()
    want = np.argwhere(np.abs(grid.values) < 1.5)
    np.testing.assert_array_equal(find_band(rescale(grid)), want)


def test_both_voxels_of_a_jump_over_the_band_are_active():
    values = np.full((6, 4, 4), 9.0, np.float32)
    values[3:] = -9.0
    assert set(find_band(values)[:, 0]) == {2, 3}


def test_patches_are_the_27_samples_in_order():
    field = np.random.default_rng(0).uniform(-2, 2, (5, 6, 7)).astype(np.float32)
    patches = gather_patches(field, np.array([[2, 3, 4]], np.int32))
    np.testing.assert_array_equal(patches[0], field[1:4, 2:5, 3:6].ravel())
    assert patches[0, CENTRE] == field[2, 3, 4]


def test_patches_continue_a_linear_field_past_the_border():
    ijk = np.indices((2, 3, 4)).astype(np.float32)
    field = 0.5 * ijk[0] - 0.25 * ijk[1] + 0.125 * ijk[2]
    voxels = np.argwhere(np.ones(field.shape)).astype(np.int32)
    want = (voxels[:, None] + NEIGHBOURHOOD) @ np.array([0.5, -0.25, 0.125])
    np.testing.assert_allclose(gather_patches(field, voxels), want, atol=1e-6)


def test_truncation_at_3_voxels_changes_nothing():
    field = rescale(ball())
    voxels = find_band(field)
    cut = np.clip(field, -6, 6)
    np.testing.assert_array_equal(gather_patches(field, voxels), gather_patches(cut, voxels))


def test_neighbours_are_found_by_position():
    rng = np.random.default_rng(1)
    voxels = np.argwhere(rng.random((5, 6, 4)) < 0.5).astype(np.int32)
    table = neighbour_table(voxels, (5, 6, 4))
    where = {tuple(ijk): row for row, ijk in enumerate(voxels.tolist())}
    for row, ijk in enumerate(voxels):
        want = [where.get(tuple((ijk + step).tolist()), -1) for step in NEIGHBOURHOOD]
        assert table[row].tolist() == want


@pytest.mark.parametrize("seed", range(2))
def test_voxels_with_a_surface_of_an_exact_distance_are_kept(seed):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    ijk = np.argwhere(np.ones((9, 9, 9)))
    field = (2 * (ijk - 4) @ normal + rng.uniform(-1, 1)).reshape(9, 9, 9).astype(np.float32)
    voxels = find_band(field)
    reach = np.abs(normal).sum()  # half voxels from the sample to the farthest corner
    holds = np.abs(field[tuple(voxels.T)]) < reach
    patches = gather_patches(field, voxels)
    assert is_lipschitz(patches).all()
    keep = can_hold_surface(patches, is_lipschitz(patches))
    assert keep[holds].all()
    assert not keep.all()
