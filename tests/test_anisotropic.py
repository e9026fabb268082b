"""Grids whose spacing differs between axes: the resampled values, and the meshes."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import trilinear
from hypothesis import given, settings
from hypothesis import strategies as st

from super_sdf import SdfGrid, extract_mesh, load_network, make_grid, reconstruct, upsample
from super_sdf.check.check import check_mesh
from super_sdf.grid.cubic import Resampled, cubic_grid, new_places, on_samples
from super_sdf.refine.survey import survey

BALLS = np.array([(4.1, 3.6, 4.9, 2.3), (5.3, 4.1, 7.0, 1.4), (5.9, 3.0, 4.2, 1.2)])
BOX = np.array([9.5, 7.5, 10.5])  # the extent of the grid
SPACINGS = [(0.6, 0.4, 0.4), (0.4, 0.6, 0.4), (0.4, 0.4, 0.6), (1.0, 0.3, 0.3), (0.3, 0.3, 1.0)]


def pear(points: np.ndarray) -> np.ndarray:
    """Distances to balls of different sizes: a part without any symmetry."""
    return np.min([np.linalg.norm(points - at[:3], axis=-1) - at[3] for at in BALLS], axis=0)


def sampled(spacing, field=pear) -> np.ndarray:
    """A field in the box, with a spacing per axis."""
    shape = np.rint(BOX / spacing).astype(int) + 1
    return field(np.moveaxis(np.indices(shape), 0, -1) * np.array(spacing))


def cube_of(spacing) -> SdfGrid:
    return cubic_grid(make_grid(sampled(spacing), spacing=spacing, origin=0))


@pytest.fixture(scope="module")
def network():
    return load_network("fast")


@pytest.mark.parametrize("tilt", [0.0, 0.2])
@pytest.mark.parametrize("solid", [1, -1], ids=["wall", "slit"])
def test_walls_between_the_planes_of_samples_are_kept(solid, tilt):
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    half, spacing = 0.15, (0.2, 0.2, 1.0)

    def sheet(points):
        return solid * (np.abs((points - (4.6, 3.6, 5.5)) @ normal) - half)

    inside = "auto" if solid == 1 else "negative"
    grid = make_grid(sampled(spacing, sheet), spacing=spacing, origin=0, inside=inside)
    cube = cubic_grid(grid)
    places = cube.to_world(np.moveaxis(np.indices(cube.shape), 0, -1))
    between = np.abs(places[..., 0] - 4.6) < 1.2  # no sample of these columns is in the sheet
    between &= (places[..., 2] > 5) & (places[..., 2] < 6)
    assert np.allclose(cube.values[between], sheet(places)[between], atol=1e-6)
    assert (cube.values[between] * solid < 0).any()


def test_a_field_that_dips_towards_the_surface_has_no_wall():
    values = np.abs(np.arange(8.0) - 3.5) + 0.2
    lines = np.broadcast_to(values[:, None, None], (8, 9, 9))
    cube = Resampled(lines, (1.0, 1.0, 1.0), 0, 0.2)
    assert cube.read(0, len(cube.places)).min() > 0


@pytest.mark.parametrize("spacing", SPACINGS)
def test_samples_keep_their_values(spacing):
    cube, values = cube_of(spacing), sampled(spacing)
    axis = int(np.argmax(spacing))
    known = on_samples(cube, np.indices(cube.shape).reshape(3, -1).T).reshape(cube.shape)
    planes = np.flatnonzero(known.all(tuple(a for a in range(3) if a != axis)))
    assert known.sum() == len(planes) * known[0].size * cube.shape[0] / cube.shape[axis]
    old = np.rint(planes * min(spacing) / max(spacing)).astype(int)
    assert np.array_equal(cube.values.take(planes, axis), values.take(old, axis))
    assert len(planes) >= len(values.take(0, axis)[:1]) and planes[0] == 0


@given(st.tuples(*[st.floats(-1, 1)] * 3), st.sampled_from([0.3, 1.0, 4.0]), st.integers(0, 2))
@settings(max_examples=15)
def test_linear_fields_of_any_slope_are_reproduced(normal, slope, axis):
    """Those steeper than distances, too, but for the border, where samples bound from one side."""
    normal = slope * np.array(normal) / max(np.linalg.norm(normal), 1)
    spacing = np.where(np.arange(3) == axis, 1.7, 0.5)
    shape = np.where(np.arange(3) == axis, 7, 12)
    field = np.moveaxis(np.indices(shape), 0, -1) * spacing @ normal - 1.3 * slope
    found = Resampled(field, tuple(spacing), axis, 0.5)
    places = np.moveaxis(np.indices(found.shape).astype(float), 0, -1) * 0.5
    places[..., axis] = np.minimum(places[..., axis], 6 * 1.7)
    off = np.abs(found.loaded - (places @ normal - 1.3 * slope))
    border = 5 if slope > 1 else 0
    inner = [slice(border, n - border) for n in shape]
    inner[axis] = slice(None)
    assert off[tuple(inner)].max() < 1e-9 * max(slope, 1)


@given(st.integers(0, 2), st.integers(1, 9), st.integers(0, 2**32 - 1))
@settings(max_examples=12)
def test_planes_are_the_same_however_they_are_read(axis, step, seed):
    """Of noise, too: every value depends on the samples round it alone."""
    values = np.random.default_rng(seed).uniform(-2, 2, (11, 12, 13))
    spacing = tuple(np.where(np.arange(3) == axis, 2.3, 1.0))
    found = Resampled(values, spacing, axis, 1.0)
    whole = found.read(0, len(found))
    parts = [found[i : i + step] for i in range(0, len(found), step)]
    assert np.array_equal(np.concatenate(parts), whole)
    assert np.array_equal(np.stack(list(found)), whole) and np.array_equal(found[-1], whole[-1])
    assert np.array_equal(Resampled(-values, spacing, axis, 1.0).loaded, -whole)


def test_chunks_change_nothing(monkeypatch):
    before = [cube_of(spacing).values for spacing in SPACINGS[:3]]
    monkeypatch.setattr("super_sdf.grid.cubic.CHUNK", 1)
    for spacing, values in zip(SPACINGS, before):
        assert np.array_equal(cube_of(spacing).values, values)


def test_places_start_on_the_first_sample_and_end_on_the_last():
    assert np.array_equal(new_places(3, 1.0, 0.5), [0, 0.5, 1, 1.5, 2])
    assert np.allclose(new_places(3, 1.5, 1.0), [0, 2 / 3, 4 / 3, 2])
    assert np.array_equal(new_places(2, 1.6, 1.0), [0, 0.625, 1])
    assert new_places(4, 1.0001, 0.5)[2] == 1  # as near as that, a sample is taken as it is


@pytest.mark.parametrize("spacing", SPACINGS)
def test_the_mesh_lies_on_the_surface(spacing, network):
    turned = trimesh.transformations.euler_matrix(0.3, -0.2, 0.5)[:3, :3] @ np.diag([1, -1, 1])
    origin = np.array([10.0, -20.0, 5.0])
    grid = make_grid(sampled(spacing), spacing=spacing, origin=origin, direction=turned)
    mesh = reconstruct(grid, network)
    off = np.abs(pear((mesh.vertices - origin) @ turned))
    assert off.mean() < 0.01 * max(spacing) and off.max() < 0.35 * max(spacing)
    assert mesh.is_closed() and mesh.volume() == pytest.approx(VOLUME, rel=0.01)


VOLUME = float((sampled((0.05, 0.05, 0.05)) < 0).sum() * 0.05**3)  # by the share of samples


@pytest.mark.parametrize("offset", [0.5, -0.6])
def test_offsets_grow_the_solid(offset, network):
    values, place = sampled((0.3, 0.3, 0.9)), {"spacing": (0.3, 0.3, 0.9)}
    mesh = reconstruct(make_grid(values, **place), network, offset=offset)
    assert np.abs(pear(mesh.vertices.astype(float)) - offset).mean() < 0.02
    other = reconstruct(make_grid(-values, **place), network, offset=offset)
    assert np.array_equal(mesh.vertices, other.vertices)


def test_a_field_is_meshed_with_the_grid_that_it_was_made_from():
    grid = make_grid(sampled((0.4, 0.6, 0.4)), spacing=(0.4, 0.6, 0.4))
    field = upsample(grid, trilinear)
    assert field.shape == cubic_grid(grid).shape
    mesh, other = extract_mesh(field, grid), reconstruct(grid, trilinear)
    assert np.array_equal(mesh.vertices, other.vertices)


def test_the_note_names_what_is_resampled():
    assert cube_of((0.4, 0.4, 0.4)).notes == ()
    (note,) = cube_of((0.4, 0.6, 1.0)).notes
    assert note == (
        "the spacing differs between axes: the values are resampled along y from 0.6 and z from 1 "
        "to 0.4, the finest, to 25 x 19 x 26 samples"
    )


def test_equal_spacings_are_not_resampled():
    grid = make_grid(sampled((0.4, 0.4, 0.4)), spacing=(0.4, 0.4, 0.4003))
    assert cubic_grid(grid) is grid


def test_interpolated_values_do_not_make_a_noisy_field():
    """A thin plate across the coarse axis: what lies between its samples is a guess."""

    def plate(points):
        return (np.abs(points - BOX / 2 - 0.03) - (3.3, 2.5, 0.45)).max(-1)

    spacing = (0.25, 0.25, 0.75)
    grid = make_grid(sampled(spacing, plate), spacing=spacing)
    band = survey(cubic_grid(grid))
    assert band.count_noisy() == 0 and band.exact.sum() > 0.5 * len(band.exact)
    assert band.exact[band.sampled & (np.abs(band.patches[:, 13]) < 2.5)].all()
    noise = np.random.default_rng(0).uniform(-0.3, 0.3, grid.shape)
    found = survey(cubic_grid(SdfGrid.trusted(grid.values + noise, spacing)))
    assert found.count_noisy() > 0 and not found.exact.any()


def test_the_certificate_counts_samples_only(network):
    grid = make_grid(sampled((0.3, 0.3, 0.6)), spacing=(0.3, 0.3, 0.6))
    found = check_mesh(reconstruct(grid, network), grid)
    index = found.touching.points / grid.spacing
    assert np.abs(index - np.rint(index)).max() < 1e-6
    assert found.voxel_size == 0.3 and not found.faults()
    assert np.abs(found.touching.residuals).mean() < 0.02
    assert np.allclose(pear(found.touching.points), found.touching.values * 0.3, atol=1e-6)


def test_the_command_says_what_it_resamples(folder, command):
    values, spacing = sampled((0.4, 0.4, 0.6)), (0.4, 0.4, 0.6)
    np.savez("a.npz", values=values, spacing=spacing, origin=(1, 2, 3))
    np.save("b.npy", values)
    code, out, err = command("upsample", "a.npz", "a.ply", "--quality", "fast", "--json")
    report = json.loads(out)
    assert "Note: the spacing differs between axes: the values are resampled along z" in err
    assert code == 0 and report["spacing"] == list(spacing) and report["shape"] == [25, 20, 19]
    mesh = trimesh.load("a.ply")
    assert np.abs(pear(mesh.vertices - [1, 2, 3])).max() < 0.15 and mesh.is_watertight
    options = ("--quality", "fast", "--spacing", "0.4,0.4,0.6", "--origin", "1,2,3")
    assert command("upsample", "b.npy", "b.ply", "-q", *options) == (0, "", "")
    assert Path("a.ply").read_bytes() == Path("b.ply").read_bytes()
