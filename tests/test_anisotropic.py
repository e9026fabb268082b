"""Grids whose spacing differs between axes: the resampled values, and the meshes."""

import numpy as np
import pytest
import trimesh
from conftest import refusal, trilinear
from scipy import ndimage
from solids import box_distance

from super_sdf import SdfGrid, make_grid, reconstruct
from super_sdf.errors import GridError
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


# Masks, densities, truncated and scaled fields

SPACING = np.array([1.0, 1.0, 2.5])
SHAPE = (48, 44, 20)
ORIGIN = np.array([5.0, -7.0, 2.0])


def places() -> np.ndarray:
    """Return the places of samples less the origin, (3, nx, ny, nz)."""
    return np.indices(SHAPE) * SPACING[:, None, None, None]


def ball(middle: tuple[float, ...] = (20.0, 24.0, 22.0), radius: float = 14.0) -> np.ndarray:
    """Return distances to a ball off the middle of the grid."""
    return np.sqrt(((places() - np.array(middle)[:, None, None, None]) ** 2).sum(0)) - radius


def two_parts() -> np.ndarray:
    """Return distances to a solid without a symmetry: a large ball and a small one beside it."""
    return np.minimum(ball(), ball((35.0, 26.0, 30.0), 8.0))


def volume(big: float = 14.0, small: float = 8.0) -> float:
    """Return the volume of the solid of ``two_parts``: two balls less the lens in both."""
    apart = np.linalg.norm([15.0, 2.0, 8.0])
    lens = (big + small - apart) ** 2 * (
        apart**2 + 2 * apart * (big + small) - 3 * (big - small) ** 2
    )
    return np.pi * (4 / 3 * (big**3 + small**3) - lens / 12 / apart)


def off(mesh, direction: np.ndarray | None = None, origin: np.ndarray = ORIGIN) -> np.ndarray:
    """Return the distances of a mesh's vertices from the solid of ``two_parts``."""
    turned = (mesh.vertices - origin) @ (np.eye(3) if direction is None else direction)
    balls = ((20.0, 24.0, 22.0), 14.0), ((35.0, 26.0, 30.0), 8.0)
    return np.min([np.linalg.norm(turned - np.array(m), axis=1) - r for m, r in balls], axis=0)


SEEN = np.where(np.abs(two_parts()) < 2.5, two_parts(), np.nan)
KINDS = {
    "mask": (two_parts() < 0, {}, 0.6),
    "label": (np.where(two_parts() < 0, 3, 1), {"label": 3}, 0.6),
    "transform": (
        ndimage.distance_transform_edt(two_parts() < 0, sampling=SPACING)
        - ndimage.distance_transform_edt(two_parts() >= 0, sampling=SPACING),
        {},
        0.6,
    ),
    "steep densities": (np.where(two_parts() < 0, 900.0, 0) + np.indices(SHAPE).sum(0),
                        {"level": 450}, 0.6),
    "ramp": (100 / (1 + np.exp(two_parts() / 1.5)), {"level": 50}, 0.12),
    "shares of voxels": (np.clip(0.5 - two_parts() / 1.5, 0, 1), {"level": 0.5}, 0.3),
    "scaled": (two_parts() * (two_parts() + 60) * 7, {"field": "smooth"}, 0.12),
    "truncated at .5": (np.clip(two_parts(), -1.25, 1.25), {}, 0.3),
    "truncated at 1": (np.clip(two_parts(), -2.5, 2.5), {}, 0.2),
    "truncated at 1, unknown beyond": (SEEN, {}, 0.2),
    "truncated at 2": (np.clip(two_parts(), -5, 5), {}, 0.08),
}  # fmt: skip
TAKEN = {"label": "mask", "transform": "mask", "scaled": "smooth", "truncated": "distance"}
TAKEN |= dict.fromkeys(("steep densities", "ramp", "shares of voxels"), "density")
TURN = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # also mirrored


@pytest.mark.parametrize(
    "name, direction", [*((name, TURN) for name in KINDS), ("mask", None), ("ramp", None)]
)
def test_the_mesh_is_at_its_place_with_any_kind(name, direction):
    values, options, limit = KINDS[name]
    place = {"spacing": SPACING, "origin": ORIGIN, "direction": direction}
    grid = make_grid(values, **place, inside="auto", **options)
    assert grid.field.kind == TAKEN.get(name.split(" at")[0], name)
    mesh = reconstruct(grid, trilinear)
    found = np.abs(off(mesh, direction))
    assert mesh.is_closed() and found.mean() < limit and found.max() < 5 * limit
    assert mesh.volume() == pytest.approx(volume(), rel=0.03)


@pytest.mark.parametrize("mesher", ["marching", "sharp"])
def test_a_mask_with_unequal_spacings_is_the_stretched_mask(mesher):
    mask = two_parts()[::2, ::2] < 0
    cubes = reconstruct(make_grid(mask, spacing=1, origin=0), trilinear, 2, mesher=mesher)
    mesh = reconstruct(make_grid(mask, spacing=SPACING, origin=0), trilinear, 2, mesher=mesher)
    np.testing.assert_allclose(mesh.vertices, cubes.vertices * SPACING, rtol=1e-5)
    np.testing.assert_array_equal(mesh.faces, cubes.faces)


@pytest.mark.parametrize("name", ["mask", "scaled"])
def test_an_offset_needs_distances_in_the_world(name):
    values, options, _ = KINDS[name]
    grid = make_grid(values, spacing=SPACING, **options)
    assert refusal(GridError, reconstruct, grid, trilinear, offset=0.5) == (
        f"offset 0.5: the values are taken as {grid.field.kind}, and with the spacing 1, 1, 2.5 "
        "they are no distances by which an offset surface could be found; mesh the solid itself "
        "(offset=0), sample the mesh (super-sdf sample), and mesh that grid with the offset"
    )


@pytest.mark.parametrize("cut", [0.5, 1, 2])
def test_a_truncated_box_along_the_axes_keeps_its_unit(cut):
    """Along z its values change by less than the spacing, and along all axes at corners only."""
    at = np.moveaxis(np.indices((60, 60, 24)), 0, -1) * SPACING - 29.0
    values = box_distance(at, [15, 12, 11.3])
    grid = make_grid(np.clip(values, -cut * 2.5, cut * 2.5), spacing=SPACING, origin=0)
    assert grid.field.kind == "distance"
    mesh = reconstruct(grid, trilinear)
    assert mesh.is_closed() and mesh.volume() == pytest.approx(30 * 24 * 22.6, rel=0.03)
