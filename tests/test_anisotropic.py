"""Grids whose spacing differs between axes: the resampled values, and the meshes."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from super_sdf import SdfGrid, make_grid, reconstruct
from super_sdf.grid.sdf_grid import cubic_grid

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


@pytest.mark.parametrize("spacing", SPACINGS)
def test_the_mesh_lies_on_the_surface(spacing, fast):
    turned = trimesh.transformations.euler_matrix(0.3, -0.2, 0.5)[:3, :3] @ np.diag([1, -1, 1])
    origin = np.array([10.0, -20.0, 5.0])
    grid = make_grid(sampled(spacing), spacing=spacing, origin=origin, direction=turned)
    mesh = reconstruct(grid, fast)
    off = np.abs(pear((mesh.vertices - origin) @ turned))
    assert off.mean() < 0.01 * max(spacing) and off.max() < 0.35 * max(spacing)
    assert mesh.is_closed() and mesh.volume() == pytest.approx(VOLUME, rel=0.01)


VOLUME = float((sampled((0.05, 0.05, 0.05)) < 0).sum() * 0.05**3)  # by the share of samples


@pytest.mark.parametrize("offset", [0.5, -0.6])
def test_offsets_grow_the_solid(offset, fast):
    values, place = sampled((0.3, 0.3, 0.9)), {"spacing": (0.3, 0.3, 0.9)}
    mesh = reconstruct(make_grid(values, **place), fast, offset=offset)
    assert np.abs(pear(mesh.vertices.astype(float)) - offset).mean() < 0.02
    other = reconstruct(make_grid(-values, **place), fast, offset=offset)
    assert np.array_equal(mesh.vertices, other.vertices)


def test_the_note_names_what_is_resampled():
    assert cube_of((0.4, 0.4, 0.4)).notes == ()
    (note,) = cube_of((0.4, 0.6, 1.0)).notes
    assert note == (
        "the spacing differs between axes: the values are resampled along y from 0.6 and z from 1 "
        "to 0.4, the finest, to 25 x 19 x 26 samples"
    )


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
