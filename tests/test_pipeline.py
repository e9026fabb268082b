"""The whole method: closed forms, and changes that must not affect the result."""

from itertools import permutations, product

import numpy as np
import pytest
from conftest import ball, cut_ball, trilinear
from scipy.spatial import cKDTree
from solids import box_distance

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


@pytest.mark.parametrize("factor", [2, 4])
@pytest.mark.parametrize("half", [(7.5, 5, 6.5), (4, 6.5, 5), (6, 6.5, 7)])
def test_a_box_with_faces_on_samples_is_one_piece(network, half, factor):
    """Samples of 0 on its edges, where the network errs outwards, are no pieces of their own."""
    middle = 10 + np.array(half) % 1
    values = box_distance(np.moveaxis(np.indices((20,) * 3), 0, -1) - middle, np.array(half))
    mesh = reconstruct(SdfGrid.trusted(values, 1.0), network, factor)
    assert mesh.is_closed() and mesh.components()[0] == 1


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


# The fit to the samples' spheres, and the bounds that they set

MIDDLE = 10 - 0.37  # of the ball


def away(points):
    """Return the distances of points (..., 3) from the ball."""
    return np.linalg.norm(points - MIDDLE, axis=-1) - 6


def network_for(grid, error):
    """Return a network that knows the ball, with an error: one number, or some by voxel."""
    places, error = band.survey(grid).voxel_ijk, np.atleast_2d(error)

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
