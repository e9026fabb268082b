"""The library says what the command says: what it refuses, in one line, and what it takes."""

from importlib import import_module

import numpy as np
import pytest
from conftest import ball, refusal, trilinear

from super_sdf import (
    SdfGrid,
    SuperSdfError,
    extract_mesh,
    load_network,
    make_grid,
    read_grid,
    reconstruct,
    upsample,
    write_mesh,
)
from super_sdf.errors import GridError, OptionError, SuperSdfWarning

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
    with pytest.raises(GridError) as caught:
        make(values)
    assert str(caught.value).removeprefix("values").strip().startswith(message)


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
            with pytest.raises(OptionError) as caught:
                work(**({"grid": GRID, "network": trilinear} | wrong))
            assert str(caught.value) == message and isinstance(caught.value, SuperSdfError)
            assert isinstance(caught.value, TypeError) == (message in OF_OTHER_TYPES)


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
    with pytest.raises(OptionError) as caught:
        OTHERS[message]()
    assert str(caught.value) == message


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


def test_a_grid_has_its_own_place():
    said = refusal(OptionError, reconstruct, GRID, trilinear, level=0.5)
    assert said == "level is given with a grid, which has its own: leave it out"


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
