"""Eqs. 2 and 4, patches and neighbours, against their definitions."""

import numpy as np
from conftest import ball

from super_sdf import SdfGrid
from super_sdf.neighbourhood import CENTRE, NEIGHBOURHOOD
from super_sdf.steps.band import (
    find_band,
    gather_patches,
    neighbour_table,
    rescale,
)


def test_rescale_is_equation_4_whatever_the_unit():
    values = np.linspace(-1, 1, 27).reshape(3, 3, 3)
    for unit in (1e-6, 1.0, 1e6):
        grid = SdfGrid(values * unit, (0.5 * unit,) * 3)
        np.testing.assert_allclose(rescale(grid), values * 4, rtol=1e-6)
        np.testing.assert_allclose(rescale(grid, 0.25 * unit), (values - 0.25) * 4, rtol=1e-6)


def test_the_band_is_equation_2_and_has_both_voxels_of_a_jump_over_it():
    grid = ball()
    want = np.argwhere(np.abs(grid.values) < 1.5)
    np.testing.assert_array_equal(find_band(rescale(grid)), want)
    values = np.full((6, 4, 4), 9.0, np.float32)
    values[3:] = -9.0
    assert set(find_band(values)[:, 0]) == {2, 3}


def test_patches_are_the_27_samples_in_order_and_go_on_linearly_past_the_border():
    field = np.random.default_rng(0).uniform(-2, 2, (5, 6, 7)).astype(np.float32)
    patches = gather_patches(field, np.array([[2, 3, 4]], np.int32))
    np.testing.assert_array_equal(patches[0], field[1:4, 2:5, 3:6].ravel())
    assert patches[0, CENTRE] == field[2, 3, 4]
    slope = np.array([0.5, -0.25, 0.125], np.float32)
    voxels = np.argwhere(np.ones((2, 3, 4))).astype(np.int32)
    found = gather_patches((voxels @ slope).reshape(2, 3, 4), voxels)
    np.testing.assert_allclose(found, (voxels[:, None] + NEIGHBOURHOOD) @ slope, atol=1e-6)


def test_neighbours_are_found_by_position():
    rng = np.random.default_rng(1)
    voxels = np.argwhere(rng.random((5, 6, 4)) < 0.5).astype(np.int32)
    table = neighbour_table(voxels, (5, 6, 4))
    where = {tuple(ijk): row for row, ijk in enumerate(voxels.tolist())}
    for row, ijk in enumerate(voxels):
        want = [where.get(tuple((ijk + step).tolist()), -1) for step in NEIGHBOURHOOD]
        assert table[row].tolist() == want
