"""Units, places and names of axes that files of other programs state; stores of Zarr."""

from __future__ import annotations

import json
import os
from pathlib import Path

import h5py
import nibabel
import nrrd
import numpy as np
import pytest
import pyvista
import SimpleITK as sitk  # noqa: N813
import tifffile
import zarr
from conftest import ball, refusal, said_of
from placed import FIRST, SIZES, STEPS, affine_of, array_of, check, part, sampled

from super_sdf import read_grid
from super_sdf.errors import FileError
from super_sdf.files.grids import describe_grid_file

pytestmark = [
    pytest.mark.usefixtures("folder"),
    pytest.mark.filterwarnings("ignore:Consolidated metadata"),
]
PLACE = {"spacing": STEPS, "origin": FIRST}


# TIFF


@pytest.mark.parametrize("with_origin", [False, True])
@pytest.mark.parametrize(
    "depth, written, unit", [(1, "um", "um"), (0.9, "\\u00B5m", "µm"), (0.9, "inch", "inch")]
)
def test_imagej_has_a_unit_and_origins_in_pixels(depth, written, unit, with_origin):
    """A depth of 1 is not written, and some write the escape of µ."""
    steps = np.array([0.5, 0.7, depth])
    affine = affine_of(steps=steps)
    starts = {f"{a}origin": -at / step for a, at, step in zip("xyz", affine[:3, 3], steps)}
    about = {"axes": "ZYX", "unit": written, **(starts if with_origin else {})}
    about |= {} if depth == 1 else {"spacing": depth}
    options = {"imagej": True, "resolution": 1 / steps[:2], "metadata": about}
    tifffile.imwrite("a.tif", sampled(affine).T, **options)
    assert ("spacing" in tifffile.TiffFile("a.tif").imagej_metadata) == (depth != 1)
    grid = read_grid("a.tif")
    check(grid, steps, shift=0 if with_origin else affine[:3, 3])
    assert grid.notes[0].endswith(f", {unit}")


def save_ome(**about: object) -> None:
    """Write an OME-TIFF whose pixels have these sizes and units."""
    about = {f"PhysicalSize{name}": value for name, value in about.items()}
    tifffile.imwrite("a.ome.tif", sampled().T, metadata={"axes": "ZYX", **about})


@pytest.mark.parametrize("unit", ["µm", "mm", "pixel"])
def test_ome_has_sizes_of_pixels_in_a_unit(unit):
    save_ome(**dict(zip("XYZ", STEPS)), **{f"{a}Unit": unit for a in "XYZ"})
    grid = read_grid("a.ome.tif")
    check(grid, shift=FIRST)
    assert grid.notes[0] == f"lengths are in the unit that it states, {unit}"


def test_different_units_are_told():
    save_ome(X=0.5, Y=0.5, Z=0.5, ZUnit="pixel")
    assert read_grid("a.ome.tif", spacing=STEPS).notes[0] == (
        "its axes have different units (µm, pixel): spacing and origin are not taken from it (give "
        "spacing=)"
    )


# Zarr by xarray, HDF5


@pytest.mark.parametrize(
    "version, order, down", [(2, "xyz", ""), (3, "zyx", "y"), (2, "yzx", "xz"), (3, "xyz", "xyz")]
)
def test_zarr_by_xarray_has_names_and_coordinates(order, down, version):
    array_of(order, down).to_dataset().to_zarr("a.zarr", zarr_format=version)
    check(read_grid("a.zarr"))
    check(read_grid("a.zarr:/distance"))
    bare = array_of(order).drop_vars(["x", "y", "z"]).to_dataset()
    bare.to_zarr("b.zarr", zarr_format=version)
    check(read_grid("b.zarr", **PLACE))


@pytest.mark.parametrize("order", ["xyz", "zyx", "yxz", "zxy"])
def test_hdf5_labels_and_scales(order):
    """Labels alone; coordinates with units on some axes; coordinates that fall."""
    with h5py.File("labels.h5", "w") as file:
        file["m"] = array_of(order).values
        for axis, name in enumerate(order):
            file["m"].dims[axis].label = name.upper()
    check(read_grid("labels.h5", **PLACE))
    for path, array in (("units.h5", array_of(order)), ("falling.h5", array_of(order, order[0]))):
        with h5py.File(path, "w") as file:
            file["m"] = array.values
            for axis, name in enumerate(order):
                scale = file.create_dataset(f"scales/{name}", data=array[name].values)
                if path == "units.h5" and name != "y":
                    scale.attrs["units"] = "cm"
                scale.make_scale(name)
                file["m"].dims[axis].attach_scale(scale)
        check(read_grid(path))
    check(read_grid("falling.h5:/m"))


@pytest.mark.parametrize(
    "order, resolution", [("zyxc", 0.0), ("xyzc", 1.0), ("tzyxc", 1.0), ("cyzx", 0.0)]
)
def test_axistags_of_ilastik(order, resolution):
    """The program writes no element_size_um; where vigra knows a resolution, it is in the tags."""
    steps, flags = dict(zip("xyz", STEPS * resolution)), {"c": 1, "t": 8}
    tags = [
        {"key": key, "typeFlags": flags.get(key, 2), "resolution": steps.get(key, 0)}
        for key in order
    ]
    with h5py.File("a.h5", "w") as file:
        others = [axis for axis, name in enumerate(order) if name in "tc"]
        values = array_of([name for name in order if name in "xyz"]).values
        file["exported_data"] = np.expand_dims(values, others)
        file["exported_data"].attrs["axistags"] = json.dumps({"axes": tags})
    given = {} if resolution else {"spacing": STEPS}
    check(read_grid("a.h5", origin=FIRST, **given))


def test_a_size_of_elements_is_in_the_order_of_the_axes():
    with h5py.File("a.h5", "w") as file:
        file["m"] = sampled().T[None]
        file["m"].attrs["element_size_um"] = STEPS[::-1]
    check(read_grid("a.h5"), shift=FIRST)


def test_one_of_several_arrays_is_named():
    with h5py.File("a.h5", "w") as file:
        file["deep/field"], file["other"] = sampled().T, sampled()
        file["other"].attrs.update(PLACE)
        file["flat"] = np.zeros((3, 3))
    check(read_grid("a.h5:/deep/field", **PLACE))
    check(read_grid("a.h5:other", axes="xyz"))


# Axes of length 1


@pytest.mark.parametrize("where", [(3,), (1,), (0, 1, 5)])
def test_axes_of_length_1_are_dropped(where):
    shape, turned = (np.expand_dims(each, where).shape for each in (sampled(), sampled().T))
    np.save("c.npy", sampled().reshape(shape))
    np.save("f.npy", np.asfortranarray(sampled().reshape(shape)))
    np.savez("a.npz", values=sampled().reshape(shape))
    with h5py.File("a.h5", "w") as file:
        file.create_dataset("m", data=sampled().T.reshape(turned), chunks=(1,) * len(turned))
    zarr.create_array("a.zarr", shape=turned, dtype="f4")[...] = sampled().T.reshape(turned)
    for name in ("c.npy", "f.npy", "a.npz", "a.h5", "a.zarr"):
        check(read_grid(name, **PLACE))
        assert describe_grid_file(name)["shape"] == list(SIZES)


@pytest.mark.parametrize("axis, kind", [(0, "list"), (3, "time"), (1, "vector")])
def test_nrrd_axes_of_length_1_are_dropped(axis, kind):
    kinds = ["domain"] * 3
    kinds.insert(axis, kind)
    directions, spacings, least = (
        np.insert(each, axis, np.nan, axis=0) for each in (np.diag(STEPS), STEPS, FIRST)
    )
    by_directions = {"space": "left-posterior-superior", "space directions": directions}
    by_spacings = {"spacings": spacings, "axis mins": least, "centerings": ["node"] * 4}
    for header in ({**by_directions, "space origin": FIRST}, by_spacings):
        nrrd.write("a.nrrd", np.expand_dims(sampled(), axis), {**header, "kinds": kinds})
        check(read_grid("a.nrrd"))


# NRRD, NIfTI, MetaImage, VTK image data


def test_nrrd_places_without_directions():
    cells, nodes = ({"centerings": [each] * 3} for each in ("cell", "node"))
    high = FIRST + STEPS * (np.array(SIZES) - 1)
    cases = {
        "origin": {"spacings": STEPS, "space": "left-posterior-superior", "space origin": FIRST},
        "unnamed": {
            **{"space dimension": 3, "space directions": np.diag(STEPS), "space origin": FIRST}
        },
        "mins": {"spacings": STEPS, "axis mins": FIRST, **nodes},
        "unstated": {"spacings": STEPS, "axis mins": FIRST - STEPS / 2},
        "both": {"axis mins": FIRST, "axis maxs": high, **nodes},
        "cells": {"axis mins": FIRST - STEPS / 2, "axis maxs": high + STEPS / 2, **cells},
    }
    for name, header in cases.items():
        nrrd.write(f"{name}.nrrd", sampled(), header)
        check(read_grid(f"{name}.nrrd"))
    assert np.allclose(sitk.ReadImage("unstated.nrrd").GetOrigin(), FIRST)
    text = Path("cells.nrrd").read_bytes().replace(b"centerings:", b"centers:")
    Path("c.nrrd").write_bytes(text.replace(b"axis mins:", b"axismins:"))
    assert b"centers: cell" in text
    check(read_grid("c.nrrd"))
    falling = {"axis mins": [high[0], *FIRST[1:]], "axis maxs": [FIRST[0], *high[1:]], **nodes}
    nrrd.write("f.nrrd", sampled()[::-1], falling)
    check(read_grid("f.nrrd"))


def test_nifti_without_a_place_is_not_mirrored():
    """Like ITK, whose direction is the identity, and method 1 of the standard."""
    image = nibabel.Nifti1Image(sampled(), None)
    image.header.set_zooms(STEPS)
    image.set_sform(None, 0)
    image.set_qform(None, 0)
    nibabel.save(image, "a.nii")
    assert sitk.ReadImage("a.nii").GetDirection() == (1, 0, 0, 0, 1, 0, 0, 0, 1)
    check(read_grid("a.nii"), shift=FIRST)
    check(read_grid("a.nii", origin=FIRST))


def test_arrays_of_cells_beside_those_of_points():
    place = {"spacing": STEPS, "origin": FIRST - STEPS / 2}
    image = pyvista.ImageData(dimensions=np.add(SIZES, 1), **place)
    image.cell_data["field"] = part(image.cell_centers().points).astype(np.float32)
    image.point_data["temperature"] = image.points[:, 0]
    image.save("a.vti")
    check(read_grid("a.vti:field"))
    said = "a.vti holds several arrays, temperature, field: give a.vti:temperature, say"
    assert refusal(FileError, read_grid, "a.vti") == said
    said = "a.vti has no array of points or cells 'no': it holds temperature, field"
    assert refusal(FileError, read_grid, "a.vti:no") == said
    image.point_data["field"] = part(image.points)
    del image.point_data["temperature"]
    image.save("b.vti")
    check(read_grid("b.vti:CellData/field"))
    assert "it holds field, CellData/field" in refusal(FileError, read_grid, "b.vti:no")
    assert read_grid("b.vti:field").shape == tuple(n + 1 for n in SIZES)


# Zarr stores of both formats, however they are chunked; OME-NGFF metadata; ``info`` of a file


SHAPE = (30, 26, 22)  # x, y, z: no chunk divides them
VALUES = ball(shape=SHAPE, radius=7.3).values


def store(path, array=VALUES.T, version=3, name=None, **layout):
    """Write an array as a Zarr array, or below a group."""
    about = {"shape": array.shape, "dtype": array.dtype, "chunks": (8,) * array.ndim, **layout}
    zarr.create_array(path, name=name, zarr_format=version, **about)[:] = array


def test_a_store_in_a_zip_file():
    with zarr.storage.ZipStore("a.zarr.zip", mode="w") as zipped:
        store(zipped, name="deep/field")
    for path in ("a.zarr.zip", "a.zarr.zip:/deep/field"):
        np.testing.assert_array_equal(read_grid(path, spacing=1).values, VALUES)
    Path("b.zarr.zip").write_bytes(Path("a.zarr.zip").read_bytes()[:-40])
    assert said_of("b.zarr.zip") == "b.zarr.zip cannot be read as Zarr: File is not a zip file"


# Images of OME-NGFF


def image(path, levels, axes="zyx", version="0.5", whole=()):
    """Write an OME-Zarr image; ``levels`` are (array, transformations)."""
    group = zarr.open_group(path, mode="a", zarr_format=2 if version == "0.4" else 3)
    datasets = []
    for number, (array, steps) in enumerate(levels):
        about = {"shape": array.shape, "dtype": array.dtype, "chunks": (8,) * array.ndim}
        group.create_array(str(number), **about)[:] = array
        datasets.append({"path": str(number), "coordinateTransformations": transformations(steps)})
    kinds, in_space = {"t": "time", "c": "channel"}, {"type": "space", "unit": "micrometer"}
    named = [{"name": a, **({"type": kinds[a]} if a in kinds else in_space)} for a in axes]
    about = {"axes": named, "datasets": datasets}
    scales = {"multiscales": [about | {"coordinateTransformations": transformations(whole)}]}
    group.attrs.update(scales if version == "0.4" else {"ome": {"version": version, **scales}})


def transformations(steps):
    """Return (scale, translation) as OME-NGFF has it."""
    return [{"type": name, name: each} for name, each in zip(("scale", "translation"), steps)]


@pytest.mark.parametrize("version", ["0.4", "0.5"])
def test_levels_of_an_image_and_their_transformations(version):
    """That of the whole image is applied last: 2 * (0.5 i + t) + 1."""
    half = VALUES[::2, ::2, ::2]
    levels = [(VALUES.T, ([0.5] * 3, [3, 2, 1])), (half.T, ([1, 1, 1], [3, 2, 1]))]
    image("i.zarr", levels, version=version, whole=([2, 2, 2], [1, 1, 1]))
    for path, step, values in (
        ("i.zarr", 1, VALUES),
        ("i.zarr:/0", 1, VALUES),
        ("i.zarr:/1", 2, half),
    ):
        grid = read_grid(path)
        assert grid.spacing == (step,) * 3 and grid.origin == (3, 5, 7)
        assert grid.notes[0] == "lengths are in the unit that it states, micrometer"
        np.testing.assert_array_equal(grid.values, values)


def test_axes_of_time_and_channel_have_length_one():
    steps = [9, 9, 1, 1, 1], [9, 9, 3, 2, 1]
    image("i.zarr", [(VALUES.T[None, None], steps)], axes="tczyx")
    grid = read_grid("i.zarr")
    assert grid.shape == SHAPE and grid.spacing == (1, 1, 1) and grid.origin == (1, 2, 3)
    np.testing.assert_array_equal(grid.values, VALUES)


def test_info_of_a_file(command):
    store("a.zarr", chunks=(4, 4, 4), shards=(16, 8, 8))
    assert command("info", "a.zarr")[1].splitlines() == [
        "file: a.zarr",
        "format: Zarr",
        "shape: 30, 26, 22",
        "dtype: float32",
        "bytes: 68,640",
        "axes in the file: zyx",
        "spacing: not stated",
        "origin: not stated",
    ]
    image("i.zarr", [(VALUES.T, ([1, 1, 1], [3, 2, 1]))], version="0.4")
    found = json.loads(command("info", "i.zarr", "--json")[1])
    assert found["spacing"] == [1, 1, 1] and found["origin"] == [1, 2, 3]
    assert found["notes"] == ["lengths are in the unit that it states, micrometer"]
    for name, shape in {"a/t": (3, *SHAPE), "a/v": SHAPE, "b": SHAPE}.items():
        store("g.zarr", np.zeros(shape), name=name)
    times, last = json.loads(command("info", "g.zarr:a", "--json")[1])["grids"]
    assert (last["file"], last["shape"]) == ("g.zarr:/a/v", [22, 26, 30])
    said = "g.zarr:/a/t: its axis 0 has 3 entries, from 0 on: choose one, g.zarr:/a/t[0], say"
    assert times == {"file": "g.zarr:/a/t", "format": "Zarr", "error": said}
    assert said in command("info", "g.zarr")[1].splitlines()


# Stores from elsewhere


def test_links_and_pipes_in_a_store():
    store("a.zarr")
    chunk = Path("a.zarr/c/0/0/0")
    chunk.rename("a.zarr/first")
    chunk.symlink_to(Path("a.zarr/first").resolve())
    assert np.array_equal(read_grid("a.zarr", spacing=1).values, VALUES)
    Path("a.zarr/first").rename("elsewhere")
    chunk.unlink()
    chunk.symlink_to(Path("elsewhere").resolve())
    assert said_of("a.zarr") == (
        "a.zarr names the file 'c/0/0/0', which is not in its folder: put both into one folder"
    )
    chunk.unlink()
    os.mkfifo(chunk)
    assert said_of("a.zarr") == "a.zarr/c/0/0/0 is no regular file: give a file"


PICKLE = {"name": "pickle"}
PICKLE_AT = {
    "filters": lambda about: about.update(filters=[{"id": "pickle"}]),
    "base64": lambda about: about.update(filters=[{"id": "base64"}]),
    "codecs": lambda about: about["codecs"].append(PICKLE),
    "within a shard": lambda about: about["codecs"][0]["configuration"]["codecs"].append(PICKLE),
}


@pytest.mark.parametrize("place", PICKLE_AT)
def test_a_codec_that_is_not_in_the_list_is_refused_by_its_name(place):
    version = 2 if place in ("filters", "base64") else 3
    store("a.zarr", version=version, **({"shards": (16, 16, 16)} if "shard" in place else {}))
    path = Path("a.zarr/.zarray" if version == 2 else "a.zarr/zarr.json")
    PICKLE_AT[place](document := json.loads(path.read_text()))
    path.write_text(json.dumps(document))
    own = "a.zarr names the codec 'base64', which is not among those that are read ("
    assert said_of("a.zarr").startswith(
        own if place == "base64" else "a.zarr cannot be read as Zarr: "
    )
