"""Units, places and names of axes that files of other programs state, and axes of length 1.

A part without any symmetry is sampled at the positions that the file states; each sample of the
grid that is read is then its distance there. Files are written by the format's own library.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import h5py
import nibabel
import nrrd
import numpy as np
import pytest
import pyvista
import SimpleITK as sitk  # noqa: N813
import tifffile
import xarray
import zarr
from conftest import refusal
from numpy.typing import ArrayLike

from super_sdf import SdfGrid, read_grid
from super_sdf.errors import FileError
from super_sdf.files.grids import describe_grid_file

SIZES = 24, 20, 17  # along x, y, z
FIRST = np.array([10.0, -4.0, 30.0])
STEPS = np.array([0.3, 0.4, 0.6])
CENTRE = FIRST + np.array([3.2, 3.9, 4.4])


pytestmark = [
    pytest.mark.usefixtures("folder"),
    pytest.mark.filterwarnings("ignore:Consolidated metadata"),
]


def part(points: np.ndarray) -> np.ndarray:
    """Return the distances of points (..., 3) from a large ball and a small one beside it."""
    large = np.linalg.norm(points - CENTRE, axis=-1) - 2.4
    small = np.linalg.norm(points - CENTRE - [1.6, 0.7, 1.2], axis=-1) - 1.2
    return np.minimum(large, small)


def coordinates(steps: ArrayLike = STEPS, first: ArrayLike = FIRST) -> dict[str, np.ndarray]:
    """Return the positions of the samples along x, y and z."""
    numbers = zip("xyz", SIZES, np.broadcast_to(first, 3), np.broadcast_to(steps, 3))
    return {name: start + step * np.arange(count) for name, count, start, step in numbers}


def sampled(steps: ArrayLike = STEPS, first: ArrayLike = FIRST) -> np.ndarray:
    """Return the samples (nx, ny, nz) of the part."""
    places = np.meshgrid(*coordinates(steps, first).values(), indexing="ij")
    return part(np.stack(places, axis=-1)).astype(np.float32)


def check(grid: SdfGrid, steps: ArrayLike = STEPS, first: ArrayLike | None = FIRST) -> None:
    """Check that each sample is at its place; ``first`` None is for a file that states none."""
    assert np.allclose(grid.spacing, steps, rtol=1e-5)
    shift = np.zeros(3) if first is not None else FIRST
    places = grid.to_world(np.moveaxis(np.indices(grid.shape), 0, -1)) + shift
    assert np.abs(grid.values - part(places)).max() < 2e-5
    assert grid.origin == ((0, 0, 0) if first is None else tuple(np.float64(grid.origin)))


# TIFF


IMAGEJ = {
    "a depth of 1": ((0.3, 0.4, 1), (1, 1, 1), {"unit": "um"}, "um"),
    "an escape": (STEPS, (1, 1, 1), {"unit": "\\u00B5m"}, "µm"),
    "inches": (STEPS, (1, 1, 1), {"unit": "inch"}, "inch"),
}


@pytest.mark.parametrize("with_origin", [False, True])
@pytest.mark.parametrize("name", IMAGEJ)
def test_imagej_has_a_unit_and_origins_in_pixels(name, with_origin):
    """A depth of 1 is not written."""
    steps, factors, about, unit = IMAGEJ[name]
    x, y, z = np.array(steps) * factors
    starts = {f"{axis}origin": -at / step for axis, at, step in zip("xyz", FIRST, steps)}
    about = {"axes": "ZYX", **about, **(starts if with_origin else {})}
    about |= {} if z == 1 else {"spacing": z}
    options = {"imagej": True, "resolution": (1 / x, 1 / y), "metadata": about}
    tifffile.imwrite("a.tif", sampled(steps).T, **options)
    assert ("spacing" in tifffile.TiffFile("a.tif").imagej_metadata) == (z != 1)
    grid = read_grid("a.tif")
    check(grid, steps, FIRST if with_origin else None)
    assert grid.notes[0].endswith(f", {unit}") or grid.notes[0].endswith(f"are in {unit}")


@pytest.mark.parametrize("options", [{}, {"imagej": True, "metadata": {"axes": "ZYX"}}])
def test_a_resolution_of_x_and_y_alone_is_told(options):
    options = {"resolution": (100, 50), "resolutionunit": "CENTIMETER", **options}
    tifffile.imwrite("a.tif", sampled(0.5).T, **{"photometric": "minisblack", **options})
    found = describe_grid_file("a.tif")
    assert found["spacing"] is None
    assert found["notes"] == [
        "its pixels are 0.01 x 0.02 cm, but it does not state how far its pages are apart: no "
        "spacing is taken from it (give --spacing X,Y,Z)"
    ]


@pytest.mark.parametrize("unit", ["µm", "mm", "pixel"])
def test_ome_has_sizes_of_pixels_in_a_unit(unit):
    sizes = {f"PhysicalSize{a}": step for a, step in zip("XYZ", STEPS)}
    named = {f"PhysicalSize{a}Unit": unit for a in "XYZ"}
    tifffile.imwrite("a.ome.tif", sampled().T, metadata={"axes": "ZYX", **sizes, **named})
    grid = read_grid("a.ome.tif")
    check(grid, first=None)
    assert grid.notes[0] == f"lengths are in the unit of its axes, {unit}"


def test_different_units_are_told():
    sizes = {f"PhysicalSize{a}": 0.5 for a in "XYZ"} | {"PhysicalSizeZUnit": "pixel"}
    tifffile.imwrite("a.ome.tif", sampled(0.5).T, metadata={"axes": "ZYX", **sizes})
    grid = read_grid("a.ome.tif", spacing=0.5)
    assert grid.notes[0] == (
        "its axes have different units (x µm, y µm, z pixel): spacing and origin are not taken "
        "from it (give --spacing)"
    )
    del sizes["PhysicalSizeZ"], sizes["PhysicalSizeZUnit"]
    tifffile.imwrite("b.ome.tif", sampled(0.5).T, metadata={"axes": "ZYX", **sizes})
    assert read_grid("b.ome.tif", spacing=0.5).notes[:2] == (
        "lengths are in the unit of its axes, µm",
        "it states no spacing along z: none is taken from it (give --spacing)",
    )


# xarray, in Zarr


def placed(order: str = "xyz", down: str = "", **more: ArrayLike) -> xarray.DataArray:
    """Return the part with named axes in an order, along falling coordinates in ``down``."""
    found = {**coordinates(), **more}
    array = xarray.DataArray(sampled(), coordinates(), ["x", "y", "z"], name="sdf")
    array = array.assign_coords(found)
    return array.isel(dict.fromkeys(down, slice(None, None, -1))).transpose(*order)


@pytest.mark.parametrize(
    "version, order, down", [(2, "xyz", ""), (3, "zyx", "y"), (2, "yzx", "xz"), (3, "xyz", "xyz")]
)
def test_zarr_by_xarray_has_names_and_coordinates(order, down, version):
    placed(order, down).to_dataset().to_zarr("a.zarr", zarr_format=version)
    check(read_grid("a.zarr"))
    check(read_grid("a.zarr:/sdf"))
    bare = placed(order).drop_vars(["x", "y", "z"]).to_dataset()
    bare.to_zarr("b.zarr", zarr_format=version)
    check(read_grid("b.zarr", spacing=STEPS, origin=FIRST))


# HDF5


def attach(
    file: h5py.File, order: str, steps: dict[str, np.ndarray], units: dict[str, str]
) -> None:
    """Attach scales with coordinates to the axes of the dataset ``m``."""
    for axis, name in enumerate(order):
        scale = file.create_dataset(f"scales/{name}", data=steps[name])
        if name in units:
            scale.attrs["units"] = units[name]
        scale.make_scale(name)
        file["m"].dims[axis].attach_scale(scale)


@pytest.mark.parametrize("order", ["xyz", "zyx", "yxz", "zxy"])
def test_hdf5_labels_and_scales(order):
    values = sampled().transpose(["xyz".index(name) for name in order])
    falling = {**coordinates(), order[0]: coordinates()[order[0]][::-1]}
    with h5py.File("a.h5", "w") as file:
        file["m"] = values
        for axis, name in enumerate(order):
            file["m"].dims[axis].label = name.upper()
    with h5py.File("b.h5", "w") as file:
        file["m"] = values
        attach(file, order, coordinates(), {"x": "cm", "z": "cm"})
    with h5py.File("c.h5", "w") as file:
        file["m"] = values[::-1]
        attach(file, order, falling, {})
    check(read_grid("a.h5", spacing=STEPS, origin=FIRST))
    check(read_grid("b.h5"))
    check(read_grid("c.h5:/m"))


@pytest.mark.parametrize(
    "order, resolution", [("zyxc", 0.0), ("xyzc", 1.0), ("tzyxc", 1.0), ("cyzx", 0.0)]
)
def test_axistags_of_ilastik(order, resolution):
    """The program writes no element_size_um; where vigra knows a resolution, it is in the tags."""
    values = sampled().transpose(["xyz".index(name) for name in order if name in "xyz"])
    steps, flags = dict(zip("xyz", STEPS * resolution)), {"c": 1, "t": 8}
    tags = [
        {"key": key, "typeFlags": flags.get(key, 2), "resolution": steps.get(key, 0)}
        for key in order
    ]
    with h5py.File("a.h5", "w") as file:
        others = [axis for axis, name in enumerate(order) if name in "tc"]
        file["exported_data"] = np.expand_dims(values, others)
        file["exported_data"].attrs["axistags"] = json.dumps({"axes": tags})
    given = {} if resolution else {"spacing": STEPS}
    check(read_grid("a.h5", origin=FIRST, **given))


def test_a_size_of_elements_is_in_the_order_of_the_axes():
    with h5py.File("a.h5", "w") as file:
        file["m"] = sampled().T[None]
        file["m"].attrs["element_size_um"] = STEPS[::-1]
    check(read_grid("a.h5"), first=None)


# Axes of length 1


def header_of(**fields: object) -> dict[str, object]:
    """Return an NRRD header with the place of the part, and further fields."""
    place = {"space directions": np.diag(STEPS), "space origin": FIRST}
    return {"space": "left-posterior-superior", **place, **fields}


def beside(directions: np.ndarray, axis: int) -> np.ndarray:
    """Return space directions with none for another axis."""
    return np.insert(directions, axis, np.nan, axis=0)


@pytest.mark.parametrize("axis, kind", [(0, "list"), (3, "time"), (1, "vector")])
def test_nrrd_axes_of_length_1_are_dropped(axis, kind):
    kinds = ["domain"] * 3
    kinds.insert(axis, kind)
    directions = beside(np.diag(STEPS), axis)
    header = header_of(kinds=kinds) | {"space directions": directions}
    nrrd.write("a.nrrd", np.expand_dims(sampled(), axis), header)
    check(read_grid("a.nrrd"))
    spacings = np.insert(STEPS, axis, np.nan)
    least = np.insert(FIRST, axis, np.nan)
    centres = ["node"] * 4
    about = {"spacings": spacings, "axis mins": least, "kinds": kinds, "centerings": centres}
    nrrd.write("b.nrrd", np.expand_dims(sampled(), axis), about)
    check(read_grid("b.nrrd"))


# NRRD


def test_nrrd_places_without_directions():
    cells, nodes = ({"centerings": [each] * 3} for each in ("cell", "node"))
    high = FIRST + STEPS * (np.array(SIZES) - 1)
    unnamed = {"space dimension": 3, "space directions": np.diag(STEPS), "space origin": FIRST}
    cases = {
        "origin": {"spacings": STEPS, "space": "left-posterior-superior", "space origin": FIRST},
        "unnamed": unnamed,
        "mins": {"spacings": STEPS, "axis mins": FIRST, **nodes},
        "unstated": {"spacings": STEPS, "axis mins": FIRST - STEPS / 2},
        "both": {"axis mins": FIRST, "axis maxs": high, **nodes},
        "cells": {"axis mins": FIRST - STEPS / 2, "axis maxs": high + STEPS / 2, **cells},
    }
    for name, header in cases.items():
        nrrd.write(f"{name}.nrrd", sampled(), header)
        check(read_grid(f"{name}.nrrd"))
    assert read_grid("unstated.nrrd").notes[0] == (
        "it states axis mins, but no centerings: its samples are taken as cells, half a spacing "
        "from them, as ITK does"
    )
    assert np.allclose(sitk.ReadImage("unstated.nrrd").GetOrigin(), FIRST)
    text = Path("cells.nrrd").read_bytes().replace(b"centerings:", b"centers:")
    Path("c.nrrd").write_bytes(text.replace(b"axis mins:", b"axismins:"))
    assert b"centers: cell" in text
    check(read_grid("c.nrrd"))
    falling = {"axis mins": [high[0], *FIRST[1:]], "axis maxs": [FIRST[0], *high[1:]], **nodes}
    nrrd.write("f.nrrd", sampled()[::-1], falling)
    check(read_grid("f.nrrd"))


# NIfTI


def affine() -> np.ndarray:
    """Return the affine of the part."""
    found = np.diag([*STEPS, 1.0])
    found[:3, 3] = FIRST
    return found


def test_nifti_without_a_place_is_not_mirrored():
    """Like ITK, whose direction is the identity, and method 1 of the standard."""
    image = nibabel.Nifti1Image(sampled(), None)
    image.header.set_zooms(STEPS)
    image.set_sform(None, 0)
    image.set_qform(None, 0)
    nibabel.save(image, "a.nii")
    assert sitk.ReadImage("a.nii").GetDirection() == (1, 0, 0, 0, 1, 0, 0, 0, 1)
    grid = read_grid("a.nii")
    check(grid, first=None)
    assert grid.notes[0] == (
        "it states no place (sform_code and qform_code are 0): its axes are taken as x, y and z, "
        "as ITK does; nibabel would mirror x"
    )
    check(read_grid("a.nii", origin=FIRST))


@pytest.mark.parametrize("codes", [(1, 1), (4, 1), (1, 2)])
def test_sform_and_qform_that_disagree_are_told(codes):
    image = nibabel.Nifti1Image(sampled(), affine())
    image.set_sform(affine(), codes[0])
    moved = affine()
    moved[:3, 3] += [0, 5, 0]
    image.set_qform(moved, codes[1])
    nibabel.save(image, "a.nii")
    grid = read_grid("a.nii")
    check(grid)
    assert grid.notes[0] == (
        f"its sform (code {codes[0]}) and qform (code {codes[1]}) place a corner 5 apart: the "
        "sform is taken, as nibabel does; ITK may take the qform"
    )
    image.set_qform(affine(), codes[1])
    nibabel.save(image, "a.nii")
    assert not [note for note in read_grid("a.nii").notes if "form" in note]


# MetaImage


def test_what_a_metaimage_may_leave_out_or_call_otherwise():
    itk = sitk.GetImageFromArray(sampled().T)
    itk.SetSpacing(STEPS.tolist())
    itk.SetOrigin(FIRST.tolist())
    sitk.WriteImage(itk, "itk.mha")
    whole = Path("itk.mha").read_bytes()
    for name in (b"Offset", b"Origin", b"Position"):
        Path("a.mha").write_bytes(whole.replace(b"Offset", name))
        check(read_grid("a.mha"))
        assert np.allclose(sitk.ReadImage("a.mha").GetOrigin(), FIRST)
    Path("b.mha").write_bytes(whole.replace(b"ElementSpacing", b"ElementSize"))
    check(read_grid("b.mha"))
    Path("c.mha").write_bytes(re.sub(rb"ElementSpacing.*\n", b"", whole))
    assert sitk.ReadImage("c.mha").GetSpacing() == (1, 1, 1)
    grid = read_grid("c.mha", spacing=STEPS)
    check(grid)
    assert grid.notes[0] == "it states no ElementSpacing: taken as 1, as ITK does"
    Path("d.mha").write_bytes(whole.replace(b"DimSize", b"DistanceUnits = um\nDimSize"))
    assert read_grid("d.mha").notes[0] == "lengths are in the unit that it states, um"


# VTK image data


def image_of_both(**arrays: Callable[[np.ndarray], np.ndarray]) -> pyvista.ImageData:
    """Return image data whose cells have the part at their centres, and points with arrays."""
    cells = np.add(SIZES, 1)
    image = pyvista.ImageData(dimensions=cells, spacing=STEPS, origin=FIRST - STEPS / 2)
    image.cell_data["field"] = part(image.cell_centers().points).astype(np.float32)
    for name, values in arrays.items():
        image.point_data[name] = values(image.points)
    return image


def test_arrays_of_cells_beside_those_of_points():
    image = image_of_both(temperature=lambda points: points[:, 0])
    image.save("a.vti")
    check(read_grid("a.vti:field"))
    said = "a.vti holds several arrays, temperature, field: give a.vti:temperature, say"
    assert refusal(FileError, read_grid, "a.vti") == said
    said = "a.vti has no array of points or cells 'no': it holds temperature, field"
    assert refusal(FileError, read_grid, "a.vti:no") == said
    image_of_both(field=part).save("b.vti")
    check(read_grid("b.vti:CellData/field"))
    assert "it holds field, CellData/field" in refusal(FileError, read_grid, "b.vti:no")
    assert read_grid("b.vti:field").shape == tuple(n + 1 for n in SIZES)


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
        check(read_grid(name, spacing=STEPS, origin=FIRST))
        assert describe_grid_file(name)["shape"] == list(SIZES)


def test_one_of_several_arrays_is_named():
    with h5py.File("a.h5", "w") as file:
        file["deep/field"], file["other"] = sampled().T, sampled()
        file["other"].attrs.update(spacing=STEPS, origin=FIRST)
        file["flat"] = np.zeros((3, 3))
    check(read_grid("a.h5:/deep/field", spacing=STEPS, origin=FIRST))
    check(read_grid("a.h5:other", axes="xyz"))
    said = "a.h5 holds several arrays, /deep/field, /other: give a.h5:/deep/field, say"
    assert refusal(FileError, read_grid, "a.h5") == said
    said = "a.h5 has no 3D dataset 'no': it holds /deep/field, /other"
    assert refusal(FileError, read_grid, "a.h5:no") == said
