"""Arrays of xarray: axes by name, spacing and origin from coordinates."""

import numpy as np
import pytest
import xarray
from conftest import refusal, trilinear

from super_sdf import SdfGrid, make_grid, reconstruct
from super_sdf.errors import GridError, OutOfMemoryError

SHAPE = 18, 20, 22  # along x, y, z
STEP = 0.5, 0.5, 0.5
FIRST = -3.0, 10.0, 100.0
CENTRE, RADIUS = np.array([1.3, 14.9, 105.2]), 3.1


def sphere(order: str = "xyz", down: str = "") -> xarray.DataArray:
    """Return the distances to a sphere, axes in an order, along falling coordinates in ``down``."""
    places = np.moveaxis(np.indices(SHAPE), 0, -1) * STEP + FIRST
    coordinates = {"x": places[:, 0, 0, 0], "y": places[0, :, 0, 1], "z": places[0, 0, :, 2]}
    values = np.linalg.norm(places - CENTRE, axis=-1) - RADIUS
    array = xarray.DataArray(values, coordinates, name="sdf")
    return array.isel(dict.fromkeys(down, slice(None, None, -1))).transpose(*order)


@pytest.mark.parametrize("order, down", [("xyz", "xy"), ("zyx", "z"), ("yzx", "")])
def test_a_sphere_lies_where_its_coordinates_say(order, down):
    grid = make_grid(sphere(order, down).expand_dims(time=[3]))
    assert np.array_equal(grid.values, sphere().values)
    assert (grid.shape, grid.spacing, grid.origin) == (SHAPE, STEP, FIRST)
    assert grid.notes == ()
    mesh = reconstruct(grid, trilinear, 2)
    assert mesh.open_edges() == 0 and mesh.volume() > 0
    assert np.abs(np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS).max() < 0.06


def test_what_is_given_replaces_the_coordinates():
    array = sphere("zyx", "z")
    for grid in (SdfGrid(array, 0.5), make_grid(array)):
        assert (grid.shape, grid.spacing, grid.origin) == (SHAPE, STEP, FIRST)
        assert np.array_equal(grid.values, sphere().values)
    assert make_grid(array, spacing=STEP, origin=(7, 8, 9)).origin == (7.0, 8.0, 9.0)
    scaled = make_grid(sphere() * 2, spacing=1.0)
    assert scaled.spacing == (1.0, 1.0, 1.0) and scaled.origin == FIRST


def test_without_coordinates_it_is_an_array_with_named_axes():
    grid = make_grid(sphere("zyx").drop_vars(["x", "y", "z"]), spacing=0.5)
    assert grid.shape == SHAPE and grid.origin == (0.0, 0.0, 0.0)
    assert grid.notes == ("origin not given: sample (0, 0, 0) is at 0, 0, 0",)
    unnamed = make_grid(xarray.DataArray(sphere().values), spacing=0.5)
    assert np.array_equal(grid.values, unnamed.values)


def test_arrays_of_dask_are_computed_if_they_fit(monkeypatch):
    array = sphere("zyx").chunk({"z": 5})
    assert np.array_equal(make_grid(array).values, sphere().values)
    monkeypatch.setattr("super_sdf.threads.free_memory", lambda: 1000)
    assert refusal(OutOfMemoryError, make_grid, array) == (
        "the array of Dask, whole, needs 0 MB of memory, 0 MB are free; "
        "save it as .npy and give its path"
    )
    assert make_grid(sphere("zyx")).shape == SHAPE  # what is in memory already fits


NAMES = "name them 'x', 'y' and 'z' (array.rename), with coordinates of all or none"
REFUSED = {
    "coordinates of 'y' are not evenly spaced, but in steps of 0.4 to 0.6: resample the array "
    "(array.interp(y=...))": (
        sphere().assign_coords(y=np.where(np.arange(20) == 7, 13.6, sphere().y))
    ),
    "coordinates of 'z' is array([False, False, False, False, False, False, False, F...: give n"
    "umbers, in the unit of the distances": sphere().assign_coords(z=np.arange(22) == 0),
    f"dimensions are 'lon', 'lat', 'z', with coordinates of 'lon', 'lat', 'z': {NAMES}": (
        sphere().rename(x="lon", y="lat")
    ),
    f"dimensions are 'x', 'y', 'z', with coordinates of 'x', 'z': {NAMES}": sphere().drop_vars("y"),
    "values have shape (2, 18, 20, 22): give three axes (x, y, z), with at least 2 samples on "
    "each": sphere().expand_dims(time=[1.0, 2.0]),
}


@pytest.mark.parametrize("said", REFUSED)
def test_what_has_no_place_is_refused(said):
    assert refusal(GridError, make_grid, REFUSED[said]) == said
