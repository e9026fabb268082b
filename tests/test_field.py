"""Surfaces that leave the grid: reported, left open, or closed along the border."""

import numpy as np
import pytest
from conftest import ball, cut_ball, trilinear
from solids import box_distance

from super_sdf import SdfGrid, reconstruct


def test_a_surface_that_leaves_is_left_open():
    assert reconstruct(ball(), trilinear, cap=False).open_edges() == 0
    assert reconstruct(cut_ball(), trilinear, cap=False).open_edges() > 0


@pytest.mark.parametrize("factor", [2, 4])
def test_the_cap_closes_it_along_the_border(factor):
    grid = cut_ball()
    mesh = reconstruct(grid, trilinear, factor)
    assert mesh.open_edges() == 0
    low = np.array(grid.origin) - 0.15  # the fine lattice starts half a voxel before the samples
    assert np.abs(mesh.vertices.min(0) - low).max() < 0.02 * 0.3 / factor
    points = low + (np.indices((100,) * 3).reshape(3, -1).T + 0.5) * 2.7 / 100
    inside = np.linalg.norm(points - np.array(grid.origin) - 2.3 * 0.3, axis=1) < 1.8
    assert mesh.volume() == pytest.approx(inside.mean() * 2.7**3, rel=0.01)


def tip(beyond: float = -0.004) -> SdfGrid:
    """Return a bar whose end lies a little before the outermost samples, in spacings."""
    length = 12 + beyond
    ijk = np.moveaxis(np.indices((17, 14, 15)), 0, -1)
    away = box_distance(ijk - [4 + length / 2, 6.4, 7.3], [length / 2, 3.2, 2.7])
    return SdfGrid.trusted(away, 1.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("end", [False, True])
def test_a_tip_just_before_the_border_is_closed(axis, end):
    values = np.moveaxis(tip().values, 0, axis)
    grid = SdfGrid.trusted(values if end else values[::-1, ::-1, ::-1], 1.0)
    mesh = reconstruct(grid, trilinear, cap=False)
    assert mesh.open_edges() == 0
    assert mesh.volume() == pytest.approx(12 * 6.4 * 5.4, rel=0.1)


def test_a_tip_just_beyond_the_border_leaves_the_grid():
    grid = tip(beyond=0.01)
    assert reconstruct(grid, trilinear, cap=False).open_edges() > 0
    assert reconstruct(grid, trilinear).open_edges() == 0
