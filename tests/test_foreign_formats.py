"""What is particular in files of medicine, microscopy, simulation and scanning."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import mrcfile
import nibabel
import numpy as np
import pydicom
import pytest
import pyvista
from conftest import said_of
from placed import (
    AFFINE,
    CUBES,
    DATA,
    FIRST,
    OBLIQUE,
    SIZES,
    STEPS,
    affine_of,
    array_of,
    check,
    holding,
    image_of,
    part,
    sampled,
    save,
    save_itk,
    save_mat,
    save_mrc,
    save_slices,
    slices_of,
)

from super_sdf import read_grid
from super_sdf.files.formats import DICOM, find_format, is_grid
from super_sdf.files.grids import open_volume

pytestmark = pytest.mark.usefixtures("folder")


def test_analyze_states_its_spacing_and_no_place():
    nibabel.save(nibabel.AnalyzeImage(sampled(), np.diag([*STEPS, 1])), "a.hdr")
    check(read_grid("a.hdr", origin=FIRST))
    assert read_grid("a.hdr").origin == (0, 0, 0)
    os.rename("a.img", "b.img")
    assert said_of("a.hdr").endswith("as Analyze: [Errno 2] No such file or directory: 'a.img'")


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_sections_rows_and_columns_of_mrc_along_any_axes(order):
    """The place is the origin in angstrom, else that of the first sample in the unit cell."""
    first = np.array([194, -84, 10])
    for by_origin in (True, False):
        affine = AFFINE.copy()
        affine[:3, 3] = FIRST if by_origin else first * STEPS
        for name in ("a.mrc", "a.map.gz"):
            save_mrc(name, affine, order, by_origin, first)
            grid = read_grid(name)
            check(grid)
            assert grid.notes == ()


def test_what_mrc_files_say_that_no_grid_has():
    save("a.mrc")
    with mrcfile.open("a.mrc", "r+") as file:
        file.header.cellb = (90, 101.5, 90)
    angle = np.radians(101.5)
    direction = read_grid("a.mrc", field="smooth").direction
    np.testing.assert_allclose(np.array(direction)[:, 2], (np.cos(angle), 0, np.sin(angle)))
    with mrcfile.open("a.mrc", "r+") as file:
        file.header.cellb, file.header.cella = (0, 0, 0), (0, 0, 0)
    check(read_grid("a.mrc", spacing=STEPS))
    mrcfile.write("stack.mrc", np.zeros((2, 5, 6, 7), np.float32))
    assert "it is a stack of volumes of 5 sections: save one of them" in said_of("stack.mrc")


@pytest.mark.parametrize("name", ["binary", "text", "rectilinear", "cells", "itk"])
def test_legacy_vtk(name):
    path, image = f"{name}.vtk", image_of(AFFINE)
    if name == "itk":
        save_itk(path, AFFINE)
    elif name == "rectilinear":
        image.cast_to_rectilinear_grid().save(path)
    elif name == "cells":
        place = {"dimensions": np.add(SIZES, 1), "origin": FIRST - STEPS / 2}
        cells = pyvista.ImageData(spacing=STEPS, **place)
        cells.cell_data["distance"] = image["distance"]
        cells.save(path)
    else:
        save(path)
    check(read_grid(path))


@pytest.mark.parametrize(
    "version, order",
    [("NETCDF4", "zyx"), ("NETCDF4", "yxz"), ("NETCDF3_CLASSIC", "xyz"), ("NETCDF3_64BIT", "zxy")],
)
def test_netcdf_at_its_coordinates(version, order):
    for falling in ("", "xz"):
        array_of(order, falling).to_netcdf("a.nc", format=version, engine="netcdf4")
        check(read_grid("a.nc"))


def test_netcdf_packed_with_units_a_time_and_named_axes():
    array = array_of()
    packing = {"dtype": "i2", "scale_factor": 0.001, "_FillValue": -32768, "zlib": True}
    array.where(array < 7).expand_dims("time").to_netcdf("a.nc", encoding={"distance": packing})
    grid = read_grid("a.nc")
    assert "without a number" in grid.notes[0]
    known = grid.values < 6.9
    places = grid.to_world(np.moveaxis(np.indices(grid.shape), 0, -1))
    assert np.abs(grid.values - part(places))[known].max() < 6e-4
    for name in "xyz":
        array[name].attrs["units"] = "cm"
    array.to_netcdf("b.nc")
    check(read_grid("b.nc"))
    assert read_grid("b.nc").notes[0] == "lengths are in the unit that it states, cm"
    names = {"x": "east", "y": "north", "z": "height"}
    array = array_of("yxz").rename(names)
    for axis, name in names.items():
        array[name].attrs["axis"] = axis.upper()
    array.to_netcdf("c.nc")
    check(read_grid("c.nc"))


@pytest.mark.parametrize("name", ["packed.mat", "v73.mat"])
def test_arrays_of_matlab(name):
    affine = affine_of(OBLIQUE)
    save_mat(name, d=sampled(affine), spacing=STEPS, origin=affine[:3, 3], direction=OBLIQUE)
    grid = read_grid(name)
    check(grid)
    assert np.allclose(grid.direction, OBLIQUE)
    assert grid.notes[0].startswith("its axes are taken as x, y, z, the order of ndgrid; ")
    arrays = {"d": np.ascontiguousarray(sampled().T), "e": sampled()}
    save_mat(name, **arrays, text="hello", flat=np.zeros((3, 4)))
    check(read_grid(f"{name}:d", axes="zyx", spacing=STEPS, origin=FIRST))
    check(read_grid(f"{name}:e", spacing=STEPS, origin=FIRST, direction=np.eye(3)))
    assert said_of(name) == f"{name} holds several arrays, d, e: give {name}:d, say"
    assert f"{name} has no array of three axes 'flat'" in said_of(f"{name}:flat")


# DICOM


def test_one_of_several_series_in_a_folder():
    save_slices("in", slices_of(AFFINE))
    save_slices("in", slices_of(CUBES, SeriesInstanceUID="1.2.4"), "b")
    Path("in/notes.txt").write_text("no image")
    os.makedirs("in/deeper")
    check(read_grid("in:1.2.3"), tolerance=6e-4)
    check(read_grid("in:1.2.4"), 0.5, 6e-4)
    assert said_of("in") == "in holds several arrays, 1.2.3, 1.2.4: give in:1.2.3, say"
    assert "in has no series of DICOM images '9'" in said_of("in:9")
    assert said_of("in/deeper") == "in/deeper holds no series of DICOM images"


def test_missing_doubled_tilted_and_unplaced_slices_are_refused():
    images = slices_of(AFFINE)

    def said(name, of=images):
        save_slices(name, of)
        return said_of(name)

    gap = said("gap", of=[image for k, image in enumerate(images) if k != 6])
    assert "gap: IM011 is 0.54 mm off from even steps of 0.96: put all slices of one" in gap
    Path("gap/IM000").write_bytes(Path("gap/IM000").read_bytes()[:300])
    assert "gap/IM000 is damaged, or no DICOM file: replace it" in said_of("gap")
    save_slices("twice", images[3:5], "b")
    assert "off from even steps" in said("twice")
    one = said("one", of=images[:1])
    assert "one: IM000 is its only slice: give the folder of a series" in one
    assert find_format("one") is DICOM and is_grid("one")
    os.rename("one/IM000", "one/a.dcm")
    assert "one/a.dcm: a.dcm is its only slice: give the folder of" in said_of("one/a.dcm")
    for k, image in enumerate(images):
        image.ImagePositionPatient[1] += 0.2 * k
    assert "its axes are not at right angles" in said("leaning")
    images[4].PixelSpacing = [1, 1]
    assert "has another size, spacing or direction than" in said("mixed")
    del images[4].PixelSpacing
    assert "unplaced: IM028 states no place: it is no slice of a volume" in said("unplaced")
    images[4].SamplesPerPixel = 3
    assert "rgb: IM028 has colours or a table of values: give grey images" in said("rgb")


def test_slope_and_intercept_of_each_slice():
    """Whole numbers stay whole; each slice has its own scale, as of PET."""
    save_slices("hounsfield", slices_of(AFFINE, RescaleSlope=1, RescaleIntercept=-1024))
    grid = read_grid("hounsfield", level=-1024, inside="negative")
    assert np.array_equal(grid.values < 0, sampled() < 0)
    images = slices_of(AFFINE)
    for k, image in enumerate(images):
        image.RescaleSlope = 0.001 * (1 + k % 3)
        stored = np.frombuffer(image.PixelData, np.int16) / (1 + k % 3)
        image.PixelData = np.rint(stored).astype(np.int16).tobytes()
    save_slices("pet", images)
    check(read_grid("pet"), tolerance=2e-3)


def test_an_image_of_several_frames():
    """An enhanced image: the place of each frame in a sequence, the rest shared."""
    slices = slices_of(AFFINE)
    image, frames, shared = slices[0], [], pydicom.Dataset()
    for each in slices[::-1]:
        place = holding(ImagePositionPatient=each.ImagePositionPatient)
        frames.append(holding(PlanePositionSequence=place))
    for group, names in (
        ("PlaneOrientationSequence", ["ImageOrientationPatient"]),
        ("PixelMeasuresSequence", ["PixelSpacing"]),
        ("PixelValueTransformationSequence", ["RescaleSlope", "RescaleIntercept"]),
    ):
        holding(shared, **{group: holding(**{n: image[n].value for n in names})})
        for name in names:
            delattr(image, name)
    pixels = b"".join(each.PixelData for each in slices[::-1])
    holding(image, PixelData=pixels, NumberOfFrames=len(slices))
    del image.ImagePositionPatient
    save_slices("plain", [image])
    assert "IM000 has frames without a place each" in said_of("plain")
    holding(image, SharedFunctionalGroupsSequence=shared, PerFrameFunctionalGroupsSequence=frames)
    save_slices("frames", [image])
    check(read_grid("frames"), tolerance=6e-4)


def test_blocks_that_open3d_saved():
    """By Open3D 0.19: 300 of its voxels, their places, values and weights, as it says them."""
    said, path = np.load(DATA / "open3d-voxels.npz"), DATA / "open3d-blocks.npz"
    grid = read_grid(path)
    assert grid.spacing == pytest.approx((0.06,) * 3)
    index = grid.to_index(said["places"].astype(float))
    assert np.abs(index - np.rint(index)).max() < 1e-4
    with open_volume(path) as (volume, _):
        stored = volume.read()
    found = stored[tuple(np.rint(index).astype(int).T)]
    assert np.array_equal(found, np.where(said["weight"] > 0, said["tsdf"], np.nan), equal_nan=True)
    assert stored.shape == grid.shape and "samples are unknown" in grid.notes[0]


@pytest.mark.parametrize("entry", ["LIST\n{}", "p%02d.raw 0 16 1\n"])
def test_headers_name_a_data_file_for_each_plane(entry):
    planes = [f"p{k:02d}.raw" for k in range(17)]
    values = np.arange(24 * 20 * 17, dtype=np.float32).reshape(17, 20, 24)
    for name, plane in zip(planes, values):
        plane.tofile(name)
    entry = entry.format("\n".join(planes))
    Path("a.nhdr").write_text(
        "NRRD0004\ntype: float\ndimension: 3\nsizes: 24 20 17\nencoding: raw\nendian: little\n"
        f"data file: {entry}\n"
    )
    Path("a.mhd").write_text(
        f"NDims = 3\nDimSize = 24 20 17\nElementType = MET_FLOAT\nElementDataFile = {entry}\n"
    )
    for name in ("a.nhdr", "a.mhd"):
        found = read_grid(name, level=4000.5, spacing=1).values + 0.0
        assert found.shape == (24, 20, 17)
        np.testing.assert_array_equal(np.sign(found), np.sign(4000.5 - values.T))
