"""Surfaces that leave the grid: reported, left open, or closed along the border."""

import numpy as np
import pytest
from conftest import ball, trilinear

from super_sdf import SdfGrid, reconstruct, upsample
from super_sdf.refine.field import border_is_crossed


def cut_ball() -> SdfGrid:
    """Return a ball of radius 6 samples whose centre is 2.3 samples from a corner of the grid."""
    ijk = np.indices((14, 15, 16)).astype(np.float64)
    return SdfGrid.trusted(np.linalg.norm(ijk - 2.3, axis=0) - 6, (0.5,) * 3, (1.0, 2.0, 3.0))


def test_a_surface_inside_the_grid_does_not_cross_the_border():
    assert not border_is_crossed(upsample(ball(), trilinear))


def test_a_surface_that_leaves_is_found_and_left_open():
    grid = cut_ball()
    assert border_is_crossed(upsample(grid, trilinear))
    assert reconstruct(grid, trilinear, cap=False).open_edges() > 0


@pytest.mark.parametrize("factor", [2, 4])
def test_the_cap_closes_it_along_the_border(factor):
    grid = cut_ball()
    mesh = reconstruct(grid, trilinear, factor)
    assert mesh.open_edges() == 0
    low = np.array(grid.origin) - 0.25  # the fine lattice starts half a voxel before the samples
    assert np.abs(mesh.vertices.min(0) - low).max() < 0.02 * 0.5 / factor
    points = low + (np.indices((100,) * 3).reshape(3, -1).T + 0.5) * 4.5 / 100
    inside = np.linalg.norm(points - np.array(grid.origin) - 2.3 * 0.5, axis=1) < 3
    assert mesh.volume() == pytest.approx(inside.mean() * 4.5**3, rel=0.01)


def tip(beyond: float = -0.004) -> SdfGrid:
    """Return a bar whose end lies a little before the outermost samples, in spacings."""
    x, y, z = np.indices((17, 14, 15)) - np.array([0, 6.4, 7.3])[:, None, None, None]
    away = np.stack([x - 16 - beyond, np.abs(y) - 3.2, np.abs(z) - 2.7, 4 - x])
    outside = np.linalg.norm(np.maximum(away, 0), axis=0)
    return SdfGrid.trusted(outside + np.minimum(away.max(0), 0), 1.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("end", [False, True])
def test_a_tip_just_before_the_border_is_closed(axis, end):
    values = np.moveaxis(tip().values, 0, axis)
    grid = SdfGrid.trusted(values if end else values[::-1, ::-1, ::-1], 1.0)
    assert border_is_crossed(upsample(grid, trilinear))
    mesh = reconstruct(grid, trilinear)
    assert mesh.open_edges() == 0
    assert mesh.volume() == pytest.approx(12 * 6.4 * 5.4, rel=0.1)


def test_a_tip_just_beyond_the_border_leaves_the_grid():
    grid = tip(beyond=0.01)
    assert reconstruct(grid, trilinear, cap=False).open_edges() > 0
    assert reconstruct(grid, trilinear).open_edges() == 0
