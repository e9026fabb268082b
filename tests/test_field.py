"""Surfaces that leave the grid: reported, left open, or closed along the border."""

import numpy as np
import pytest
from conftest import ball, cut_ball, trilinear
from solids import box_distance

from super_sdf import SdfGrid, reconstruct


@pytest.mark.parametrize("factor", [2, 4])
def test_a_surface_that_leaves_is_left_open_or_closed_along_the_border(factor):
    grid = cut_ball()
    assert reconstruct(ball(), trilinear, factor, cap=False).open_edges() == 0
    assert reconstruct(grid, trilinear, factor, cap=False).open_edges() > 0
    mesh = reconstruct(grid, trilinear, factor)
    assert mesh.open_edges() == 0
    low = np.array(grid.origin) - 0.15  # the fine lattice starts half a voxel before the samples
    assert np.abs(mesh.vertices.min(0) - low).max() < 0.02 * 0.3 / factor
    points = low + (np.indices((100,) * 3).reshape(3, -1).T + 0.5) * 2.7 / 100
    inside = np.linalg.norm(points - np.array(grid.origin) - 2.3 * 0.3, axis=1) < 1.8
    assert mesh.volume() == pytest.approx(inside.mean() * 2.7**3, rel=0.01)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("end", [False, True])
@pytest.mark.parametrize("beyond", [-0.004, 0.01])
def test_a_bar_that_ends_beside_the_outermost_samples_is_closed(beyond, axis, end):
    """Half a voxel beyond them is the border: both leave the lattice, one leaves the samples."""
    length, ijk = 12 + beyond, np.moveaxis(np.indices((17, 14, 15)), 0, -1)
    away = box_distance(ijk - [4 + length / 2, 6.4, 7.3], [length / 2, 3.2, 2.7])
    values = np.moveaxis(away, 0, axis)
    grid = SdfGrid.trusted(values if end else values[::-1, ::-1, ::-1], 1.0)
    assert (reconstruct(grid, trilinear, cap=False).open_edges() > 0) == (beyond > 0)
    mesh = reconstruct(grid, trilinear)
    assert mesh.open_edges() == 0
    assert mesh.volume() == pytest.approx(12 * 6.4 * 5.4, rel=0.1)
