"""The whole method: closed forms, and changes that must not affect the result."""

from itertools import permutations, product

import numpy as np
import pytest
from conftest import ball, trilinear
from scipy.spatial import cKDTree

from super_sdf import SdfGrid, load_network, pipeline, reconstruct, upsample
from super_sdf.errors import GridError
from super_sdf.refine import band
from super_sdf.refine.nodes import block_ijk
from super_sdf.surface.mesh import CLEARANCE


@pytest.mark.parametrize("factor", [2, 8])
def test_a_plane_is_exact(factor):
    shape, normal = (9, 11, 10), np.array([0.48, -0.6, 0.64])
    middle = np.array(shape) / 2 - 0.3
    values = (np.indices(shape).reshape(3, -1).T - middle) @ normal
    mesh = reconstruct(
        SdfGrid.trusted(values.reshape(shape), (1.0,) * 3), trilinear, factor, cap=False
    )
    assert np.abs((mesh.vertices - middle) @ normal).max() < 1.01 * CLEARANCE / factor
    corners = mesh.vertices[mesh.faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ normal
    assert facing.min() > -1e-6  # outward: towards positive values


@pytest.mark.parametrize("factor, offset", [(2, 0), (4, 1.5), (8, 0)])
def test_a_sphere_is_within_a_twentieth_of_a_voxel(network, factor, offset):
    """An offset is a shift of the field."""
    mesh = reconstruct(ball(20, 6.0), network, factor, offset=offset)
    error = np.linalg.norm(mesh.vertices - (10 - 0.37), axis=1) - 6.0 - offset
    assert np.abs(error).max() < 0.05
    assert mesh.open_edges() == 0 and mesh.volume() > 0


@pytest.fixture(scope="module")
def network():
    return load_network()


def values_at_samples(field):
    middle = (block_ijk(4) == 2).all(1)
    return field.values[field.numbers[:, middle]].ravel() / 2


def test_coarse_samples_are_kept(network):
    grid = ball()
    field = upsample(grid, network)
    assert band.survey(grid).whole.noisy == 0
    samples = grid.values[tuple(field.voxel_ijk.T)]
    np.testing.assert_allclose(values_at_samples(field), samples, rtol=1e-6)
    grid.values[np.abs(grid.values) < 0.02] = 0
    field = upsample(grid, network)
    kept, samples = values_at_samples(field), grid.values[tuple(field.voxel_ijk.T)]
    assert (kept[samples == 0] == 0).all() and (samples == 0).any()


def test_noisy_samples_are_corrected(network):
    clean = ball(24, 8.0)
    noise = np.random.default_rng(0).uniform(-0.4, 0.4, clean.shape)
    grid = SdfGrid.trusted(clean.values + noise, clean.spacing)
    field, whole = upsample(grid, network), band.survey(grid).whole
    assert whole.noisy > 0.5 * whole.count
    before, after = noise[tuple(field.voxel_ijk.T)], values_at_samples(field)
    wanted = clean.values[tuple(field.voxel_ijk.T)]
    near = np.abs(wanted) < 0.5
    assert np.abs(after - wanted)[near].mean() < 0.5 * np.abs(before)[near].mean()


def test_unit_and_origin_only_scale_and_move_the_vertices(network):
    """Grids need not be cubes."""
    grid = ball(shape=(17, 20, 26))
    mesh = reconstruct(grid, network, 2)
    middle = np.array(grid.shape) / 2 - 0.37
    np.testing.assert_allclose((mesh.vertices.max(0) + mesh.vertices.min(0)) / 2, middle, atol=0.05)
    for unit, origin in ((2.0**-10, (0, 0, 0)), (1024.0, (0, 0, 0)), (1.0, (-3, 5, 7))):
        other = reconstruct(SdfGrid(grid.values * unit, (unit,) * 3, origin), network, 2)
        np.testing.assert_array_equal(mesh.faces, other.faces)
        np.testing.assert_allclose((other.vertices - origin) / unit, mesh.vertices, atol=2e-5)


SYMMETRIES = [
    np.eye(3, dtype=int)[list(axes)] * signs
    for axes in permutations(range(3))
    for signs in product((1, -1), repeat=3)
][::5]  # ten of 48, of all orders of axes


def test_symmetries_of_the_cube_map_the_vertices_along(monkeypatch):
    """But for the fit to the spheres, which on a face between cells takes one side's gradient."""
    monkeypatch.setattr(pipeline, "fit_to_spheres", lambda *_: None)
    ijk = np.indices((12, 12, 12)) - 5.5
    box = np.abs(ijk - np.array([0.3, -0.2, 0.1])[:, None, None, None])
    values = np.maximum(box[0] - 3.2, np.maximum(box[1] - 2.3, box[2] - 3.6))
    values = np.minimum(values, np.linalg.norm(ijk - 1.4, axis=0) - 2.6)

    def vertices_of(values):
        grid = SdfGrid.trusted(values, (1.0,) * 3, (-5.5,) * 3)
        return reconstruct(grid, trilinear, mesher="marching").vertices

    base = vertices_of(values)
    for turn in SYMMETRIES:
        source = np.moveaxis(ijk, 0, -1) @ turn + 5.5  # where each sample of the turned grid was
        turned = values[tuple(np.moveaxis(source.astype(int), -1, 0))]
        distance = cKDTree(vertices_of(turned)).query(base @ turn.T)[0]
        assert distance.max() < 1e-5 + 2 * CLEARANCE


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_decoding_only_what_can_hold_the_surface_loses_nothing(noise, monkeypatch):
    """Not even if the values are no distances: with uniform noise of up to half a voxel."""
    grid = ball()
    values = grid.values + np.random.default_rng(0).uniform(-noise, noise, grid.shape)
    noisy = SdfGrid.trusted(values, grid.spacing)
    part = reconstruct(noisy, trilinear)
    monkeypatch.setattr(band, "DECODE_LIMIT", np.inf)
    whole = reconstruct(noisy, trilinear)
    assert len(part.faces) == len(whole.faces)
    assert cKDTree(part.vertices).query(whole.vertices)[0].max() < 1e-5  # sums in another order


def test_threads_give_the_same_mesh(network):
    from concurrent.futures import ThreadPoolExecutor

    grids = [ball(14, 4.0 + 0.1 * n) for n in range(3)]
    alone = [reconstruct(grid, network).vertices for grid in grids]
    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(lambda grid: reconstruct(grid, network).vertices, grids))
    for one, other in zip(alone, together):
        np.testing.assert_array_equal(one, other)


def test_two_samples_an_axis_are_enough(network):
    values = np.array([-0.5, 0.5])[:, None, None] + np.zeros((2, 2, 2))
    mesh = reconstruct(SdfGrid.trusted(values, (1.0,) * 3), network, cap=False)
    np.testing.assert_allclose(mesh.vertices[:, 0], 0.5, atol=0.05)


@pytest.mark.parametrize("low, high", [(0.5, 9), (5, 9), (1.3, 1.37)])
def test_a_field_without_a_surface_is_refused(low, high):
    """Also where it is in the band, but too far to hold a surface."""
    values = np.repeat(np.linspace(low, high, 8), 64).reshape(8, 8, 8)
    with pytest.raises(GridError, match=f"no surface at 0: the values go from {low:g} to {high:g}"):
        reconstruct(
            SdfGrid.trusted(values, (1.0,) * 3),
            lambda patches, table, voxels, offsets: np.ones((len(voxels), 125), np.float32),
        )
