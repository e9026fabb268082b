"""The library says what the command says: what it refuses, in one line, and what it takes."""

from importlib import import_module

import numpy as np
import pytest
import xarray
from conftest import ball, refusal, trilinear

from super_sdf import (
    SdfGrid,
    extract_mesh,
    load_network,
    make_grid,
    read_grid,
    reconstruct,
    upsample,
    write_mesh,
)
from super_sdf.errors import GridError, OptionError, OutOfMemoryError, SuperSdfWarning

VALUES = ball(20, 6.0).values


def test_the_constructor_infers_what_make_grid_does():
    made = make_grid(-VALUES, spacing=1, origin=(1, 2, 3))
    for grid in (SdfGrid(-VALUES, 1.0, (1, 2, 3)), SdfGrid(VALUES, 1.0, (1, 2, 3))):
        np.testing.assert_array_equal(grid.values, made.values)
        assert (grid.spacing, grid.origin, grid.low) == (made.spacing, made.origin, made.low)
    assert reconstruct(made, trilinear, 2).volume() > 0


@pytest.mark.parametrize("make", [make_grid, lambda values: SdfGrid(values, 1.0)])
@pytest.mark.parametrize(
    "values, message",
    [
        ([[1.0], [1.0, 2.0]], "are [[1.0], [1.0, 2.0]]: give an array of three axes"),
        ("part.npy", "have dtype <U8: give floating-point or integer numbers"),
    ],
)
def test_what_is_no_array_of_samples_is_refused(make, values, message):
    assert refusal(GridError, make, values).removeprefix("values").strip().startswith(message)


GRID = ball(12, 3.0)
EVEN = "give an even number from 2 to 16 (an odd one has no node on the samples)"
BYTES = "give a number of bytes greater than 0, such as 1500M or 4G"
BOOLEAN = "give True or False, in JSON true or false"
MAKE_ONE = "make one with make_grid(values, spacing=...) or read_grid(path)"
# of the wrong type, and of the right type with a wrong value
OF_OTHER_TYPES = {
    f"grid is 'part.npz': {MAKE_ONE}": {"grid": "part.npz"},
    "network is 3: give one from load_network()": {"network": 3},
    "offset is [1]: give a finite number, in world units": {"offset": [1]},
    f"cap is 'no': {BOOLEAN}": {"cap": "no"},
}
WRONG = {
    f"factor is 0: {EVEN}": {"factor": np.int64(0)},
    "offset is -inf: give a finite number, in world units": {"offset": -np.inf},
    "mesher is 'dual': give one of auto, marching, sharp": {"mesher": "dual"},
    f"max_memory is -5: {BYTES}": {"max_memory": -5},
}


@pytest.mark.parametrize("message", [*OF_OTHER_TYPES, *WRONG])
def test_wrong_arguments_are_named_with_the_value_seen(message):
    wrong = (OF_OTHER_TYPES | WRONG)[message]
    for work in (reconstruct, upsample):
        if work is reconstruct or not {"cap", "mesher", "max_memory"} & set(wrong):
            kind = TypeError if message in OF_OTHER_TYPES else OptionError
            assert refusal(kind, work, **({"grid": GRID, "network": trilinear} | wrong)) == message


def test_a_network_is_given_or_named():
    named = reconstruct(GRID, quality="fast", device="cpu", factor=2)
    loaded = reconstruct(GRID, load_network("fast", device="cpu"), 2)
    np.testing.assert_array_equal(named.vertices, loaded.vertices)
    said = refusal(OptionError, reconstruct, GRID, trilinear, quality="fast")
    assert said == "a network and quality are given: give only one of them"


OTHERS = {
    "threads is -1: give 1 or more, or 0 for one per core": lambda: load_network(threads=-1),
    "path is 3: give the path of a file": lambda: read_grid(3),
    "mesh is None: give one from reconstruct(grid)": lambda: write_mesh(None, "a.ply"),
    f"field is {GRID!r:.57}...: give one from upsample(grid, network)": lambda: extract_mesh(
        GRID, GRID
    ),
}


@pytest.mark.parametrize("message", OTHERS)
def test_so_are_those_of_the_other_functions(message):
    assert refusal(OptionError, OTHERS[message]) == message


def test_grid_field_mesh_and_network_say_what_they_are_in_a_line():
    field = upsample(GRID, trilinear, 2)
    for thing in (GRID, field, extract_mesh(field, GRID), load_network("fast", threads=1)):
        said = repr(thing)
        assert said.startswith(f"{type(thing).__name__}(") and "\n" not in said and len(said) < 160


def stored(kind):
    """Return the values as an array of some library."""
    library = import_module(kind)
    if kind == "h5py":
        return library.File("a.h5", "w").create_dataset("a", data=VALUES[None, None])
    if kind == "numpy":
        np.save("a.npy", VALUES)
        return np.load("a.npy", mmap_mode="r")
    make = {"torch": "tensor", "dask.array": "from_array", "zarr": "array", "xarray": "DataArray"}
    return getattr(library, make[kind])(
        VALUES if kind in ("zarr", "xarray") else VALUES[None, None]
    )


@pytest.mark.parametrize(
    "kind",
    [
        *("numpy", "h5py", "dask.array", "zarr", "xarray"),
        pytest.param("torch", marks=pytest.mark.programs),
    ],
)
def test_an_array_of_any_library_goes_in_with_its_place(folder, kind):
    place = {"spacing": 0.5, "origin": (1, 2, 3)}
    want = reconstruct(make_grid(VALUES / 2, **place), trilinear, 2)
    mesh = reconstruct(stored(kind), trilinear, 2, scale=0.5, **place)
    np.testing.assert_allclose(mesh.vertices, want.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, want.faces)


def test_notes_are_logged_and_warnings_issued_in_the_words_of_python(caplog, command, folder):
    caplog.set_level("INFO", "super_sdf")
    with pytest.warns(SuperSdfWarning) as caught:
        mesh = reconstruct(VALUES[:10], trilinear, cap=False)
    where = "the surface runs out of the grid and is open there (close it with cap=True)"
    assert mesh.warnings == (where,) == tuple(str(each.message) for each in caught)
    assert mesh.notes == tuple(caplog.messages) and mesh.notes[0].startswith("spacing not given: ")
    np.save("a.npy", VALUES[:10])
    err = command("upsample", "a.npy", "a.ply", "--open", "--quality", "fast")[2]
    note = mesh.notes[0].replace("spacing=", "--spacing")
    assert f"Warning: {where[:-9]}--cap)\n" in err and f"Note: {note}\n" in err


SAID = {
    "give a --level, such as --level -4 --inside negative": "give a level=, such as level=-4, "
    "inside='negative'",
    "--labels has 'lung': choose fewer (--labels 1,2)": "labels has 'lung': choose fewer "
    "(labels=(1,2))",
    "end it there (--open), or use --force": "end it there (cap=False), or use force=True",
    "leave it out, or --offset and --open": "leave it out, or offset= and cap=False",
    "pip install --force-reinstall onnxruntime": "pip install --force-reinstall onnxruntime",
}


@pytest.mark.parametrize("flagged", SAID)
def test_an_error_names_flags_on_the_command_line_and_keywords_in_python(flagged):
    assert str(OptionError(flagged)) == SAID[flagged]
    assert OptionError(flagged).flagged == flagged


# Arrays of xarray: axes by name, spacing and origin from coordinates

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
