"""Files of medicine, microscopy, simulation and scanning: place, size, side, values, refusals.

Each is written by the library that is common for it.
"""

from __future__ import annotations

import gzip
import itertools
import os
from pathlib import Path
from typing import Any

import h5py
import hdf5storage
import mrcfile
import nibabel
import numpy as np
import pydicom
import pytest
import pyvista
import scipy.io
import tifffile
import xarray as xr
from conftest import refusal
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid
from test_formats import (
    DATA,
    OBLIQUE,
    ORIENTED,
    SIZES,
    TURNS,
    affine_of,
    check,
    part,
    sampled,
    save_itk,
    text_sdf,
)
from vtkmodules.vtkIOHDF import vtkHDFWriter

from super_sdf import read_grid
from super_sdf.errors import SuperSdfError
from super_sdf.files.formats import DICOM, find_format, is_grid
from super_sdf.files.grids import open_volume

STEPS = np.array([0.5, 0.7, 0.9])
AFFINE = affine_of(np.diag([1, 1.4, 1.8]))
CORNER = AFFINE[:3, 3]


pytestmark = pytest.mark.usefixtures("folder")


def said_of(path: str, **options: Any) -> str:
    """Return the one line with which a file is refused."""
    return refusal(SuperSdfError, read_grid, path, **options)


# Places


def save_mgh(path: str, affine: np.ndarray) -> None:
    nibabel.save(nibabel.MGHImage(sampled(affine), affine), path)


def save_pair(path: str, affine: np.ndarray) -> None:
    nibabel.save(nibabel.Nifti1Pair(sampled(affine), affine), path)


def image_of(affine: np.ndarray) -> pyvista.ImageData:
    steps = np.linalg.norm(affine[:3, :3], axis=0)
    place = {"origin": affine[:3, 3], "direction_matrix": affine[:3, :3] / steps}
    image = pyvista.ImageData(dimensions=SIZES, spacing=steps, **place)
    image["distance"] = part(image.points).astype(np.float32)
    return image


def save_vtkhdf(path: str, affine: np.ndarray) -> None:
    writer = vtkHDFWriter()
    writer.SetFileName(path)
    writer.SetInputData(image_of(affine))
    assert writer.Write()


def slices_of(affine: np.ndarray, **about: Any) -> list[pydicom.Dataset]:
    """Return the images of a series, in the order of their places."""
    steps = np.linalg.norm(affine[:3, :3], axis=0)
    stored = np.rint(sampled(affine) / 0.001).astype(np.int16)
    common = {
        "SeriesInstanceUID": "1.2.3",
        "Rows": SIZES[1],
        "Columns": SIZES[0],
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": "MONOCHROME2",
        **{"BitsAllocated": 16, "BitsStored": 16, "HighBit": 15, "PixelRepresentation": 1},
        "PixelSpacing": [steps[1], steps[0]],
        "ImageOrientationPatient": np.round(affine[:3, :2] / steps[:2], 10).T.ravel().tolist(),
        "RescaleSlope": 0.001,
        "RescaleIntercept": 0,
        **about,
    }
    images = []
    for k in range(SIZES[2]):
        image = pydicom.Dataset()
        for name, value in common.items():
            setattr(image, name, value)
        place = affine[:3, 3] + affine[:3, 2] * k
        image.ImagePositionPatient = np.round(place, 8).tolist()
        image.PixelData = stored[:, :, k].T.tobytes()
        images.append(image)
    return images


def save_slices(path: str, images: list[pydicom.Dataset], start: str = "IM") -> None:
    """Write images to a folder, in names that are not in their order."""
    os.makedirs(path, exist_ok=True)
    for number, image in enumerate(images):
        image.file_meta = pydicom.dataset.FileMetaDataset()
        image.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        image.SOPClassUID = image.file_meta.MediaStorageSOPClassUID = CTImageStorage
        uid = generate_uid(entropy_srcs=[start, str(number)])
        image.SOPInstanceUID = image.file_meta.MediaStorageSOPInstanceUID = uid
        name = f"{path}/{start}{number * 7 % 31:03d}"
        pydicom.dcmwrite(name, image, enforce_file_format=True)


def save_dicom(path: str, affine: np.ndarray) -> None:
    save_slices(path, slices_of(affine))


PLACED = {
    "a.mgz": save_mgh,
    "a.hdr": save_pair,
    "a.vtkhdf": save_vtkhdf,
    "itk.h5": save_itk,
    "series": save_dicom,
}


@pytest.mark.parametrize("direction", [TURNS[14], OBLIQUE])
@pytest.mark.parametrize("name", PLACED)
def test_turned_and_mirrored_axes_with_three_spacings(name, direction):
    PLACED[name](name, affine_of(direction @ np.diag([1, 1.4, 1.8])))
    grid, order = read_grid(name), np.abs(direction).argmax(1)
    check(grid, STEPS[order], 6e-4 if name == "series" else 2e-5)
    straight = np.eye(3) if direction is not OBLIQUE else OBLIQUE
    assert np.allclose(grid.direction, straight, atol=1e-5)


def test_analyze_states_its_spacing_and_no_place():
    nibabel.save(nibabel.AnalyzeImage(sampled(AFFINE), np.diag([*STEPS, 1])), "a.hdr")
    grid = read_grid("a.hdr", origin=CORNER)
    check(grid, STEPS)
    assert grid.notes[0].startswith("Analyze files state no place and not which side is left: x")
    assert read_grid("a.hdr").origin == (0, 0, 0)
    os.rename("a.img", "b.img")
    assert said_of("a.hdr") == "a.hdr: a.img does not exist"
    assert said_of("b.img") == "b.img holds the samples of an Analyze file: give its header b.hdr"


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_sections_rows_and_columns_of_mrc_along_any_axes(order):
    """The place is the origin in angstrom, else that of the first sample in the unit cell."""
    first = np.array([194, -84, 10])
    for by_origin in (True, False):
        affine = AFFINE.copy()
        affine[:3, 3] = CORNER if by_origin else first * STEPS
        save_mrc("a.mrc", affine, order, by_origin, first)
        grid = read_grid("a.mrc")
        places = grid.to_world(np.moveaxis(np.indices(grid.shape), 0, -1))
        assert np.allclose(grid.spacing, STEPS) and grid.notes == ()
        assert np.abs(grid.values - part(places)).max() < 2e-5
    Path("a.map.gz").write_bytes(gzip.compress(Path("a.mrc").read_bytes()))
    packed = read_grid("a.map.gz")
    assert np.array_equal(packed.values, grid.values) and packed.origin == grid.origin


def save_mrc(
    path: str, affine: np.ndarray, order: Any = (2, 1, 0), by_origin: bool = True, first: Any = None
) -> None:
    """Write an MRC file whose sections, rows and columns are along some axes."""
    with mrcfile.new(path, overwrite=True) as file:
        file.set_data(np.ascontiguousarray(sampled(affine).transpose(order)))
        header = file.header
        header.maps, header.mapr, header.mapc = (axis + 1 for axis in order)
        header.mx, header.my, header.mz = SIZES
        header.cella = tuple((STEPS * SIZES).tolist())
        if by_origin:
            header.origin = tuple(affine[:3, 3].tolist())
        else:
            header.nzstart, header.nystart, header.nxstart = first[list(order)].tolist()


def test_what_mrc_files_say_that_no_grid_has():
    save_mrc("a.mrc", AFFINE)
    with mrcfile.open("a.mrc", "r+") as file:
        file.header.nxstart = 4
    said = "its origin is 97.1, -58.9, 9.45 and its nstart means 2, 0, 0: the origin is taken"
    assert read_grid("a.mrc").notes == (said,)
    with mrcfile.open("a.mrc", "r+") as file:
        file.header.cellb = (90, 101.5, 90)
    said = "a.mrc: the angles of its unit cell are 90, 101.5, 90 degrees, not 90: resample it on a"
    assert said_of("a.mrc").startswith(said)
    with mrcfile.open("a.mrc", "r+") as file:
        file.header.cellb, file.header.cella = (0, 0, 0), (0, 0, 0)
    check(read_grid("a.mrc", spacing=STEPS), STEPS)
    with mrcfile.open("a.mrc", "r+") as file:
        file.header.mapc = 3
    assert "its header is damaged" in said_of("a.mrc")
    volumes = np.zeros((2, 5, 6, 7), np.float32)
    mrcfile.write("stack.mrc", volumes, overwrite=True)
    assert "it is a stack of volumes of 5 sections: save one of them" in said_of("stack.mrc")


# VTK


@pytest.mark.parametrize("name", ["binary", "text", "rectilinear", "cells", "itk"])
def test_legacy_vtk(name):
    path, image = f"{name}.vtk", image_of(AFFINE)
    if name == "itk":
        save_itk(path, AFFINE)
    elif name == "rectilinear":
        image.cast_to_rectilinear_grid().save(path)
    elif name == "cells":
        place = {"dimensions": np.add(SIZES, 1), "origin": CORNER - STEPS / 2}
        cells = pyvista.ImageData(spacing=STEPS, **place)
        cells.cell_data["distance"] = image["distance"]
        cells.save(path)
    else:
        image.save(path, binary=name == "binary")
    check(read_grid(path), STEPS)


# NetCDF


def array_of(order: str = "zyx", falling: str = "") -> xr.DataArray:
    """Return the part as an array whose axes are in an order, some of them falling."""
    places = {name: CORNER[a] + STEPS[a] * np.arange(SIZES[a]) for a, name in enumerate("xyz")}
    array = xr.DataArray(sampled(AFFINE), places, list("xyz"), "distance")
    turned = array.isel({name: slice(None, None, -1) for name in falling})
    return turned.transpose(*order)


@pytest.mark.parametrize(
    "version, order",
    [("NETCDF4", "zyx"), ("NETCDF4", "yxz"), ("NETCDF3_CLASSIC", "xyz"), ("NETCDF3_64BIT", "zxy")],
)
def test_netcdf_at_its_coordinates(version, order):
    for falling in ("", "xz"):
        array_of(order, falling).to_netcdf("a.nc", format=version, engine="netcdf4")
        check(read_grid("a.nc"), STEPS)


def test_netcdf_packed_with_units_a_time_and_named_axes():
    array = array_of()
    packing = {"dtype": "i2", "scale_factor": 0.001, "_FillValue": -32768, "zlib": True}
    array.where(array < 7).expand_dims("time").to_netcdf("a.nc", encoding={"distance": packing})
    grid = read_grid("a.nc")
    assert "NaN" in grid.notes[0]
    known = grid.values < 6.9
    places = grid.to_world(np.moveaxis(np.indices(grid.shape), 0, -1))
    assert np.abs(grid.values - part(places))[known].max() < 6e-4
    for name in "xyz":
        array[name].attrs["units"] = "cm"
    array.to_netcdf("b.nc")
    check(read_grid("b.nc"), STEPS)
    assert read_grid("b.nc").notes[0] == "lengths are in the unit of its axes, cm"
    names = {"x": "east", "y": "north", "z": "height"}
    array = array_of("yxz").rename(names)
    for axis, name in names.items():
        array[name].attrs["axis"] = axis.upper()
    array.to_netcdf("c.nc")
    check(read_grid("c.nc"), STEPS)


# MATLAB


def save_mat(name: str, **variables: Any) -> None:
    """Write variables in version 7.3 if the name says so, else 5."""
    Path(name).unlink(missing_ok=True)
    if "73" in name:
        hdf5storage.savemat(name, variables, format="7.3")
    else:
        scipy.io.savemat(name, variables, do_compression="packed" in name)


@pytest.mark.parametrize("name", ["packed.mat", "v73.mat"])
def test_arrays_of_matlab(name):
    affine = affine_of(OBLIQUE @ np.diag([1, 1.4, 1.8]))
    place = {"spacing": STEPS, "origin": affine[:3, 3], "direction": OBLIQUE}
    save_mat(name, d=sampled(affine), **place)
    grid = read_grid(name)
    check(grid, STEPS)
    assert np.allclose(grid.direction, OBLIQUE)
    assert grid.notes[0].startswith("its axes are taken as x, y, z, the order of ndgrid; ")
    arrays = {"d": np.ascontiguousarray(sampled(AFFINE).T), "e": sampled(AFFINE)}
    save_mat(name, **arrays, text="hello", flat=np.zeros((3, 4)))
    check(read_grid(f"{name}:d", axes="zyx", spacing=STEPS, origin=CORNER), STEPS)
    check(read_grid(f"{name}:e", spacing=STEPS, origin=CORNER, direction=np.eye(3)), STEPS)
    assert said_of(name) == f"{name} holds several arrays, d, e: give {name}:d, say"
    assert f"{name} has no array of three axes 'flat'" in said_of(f"{name}:flat")


# DICOM


def test_one_of_several_series_in_a_folder():
    save_dicom("in", AFFINE)
    shifted = affine_of(np.eye(3))
    save_slices("in", slices_of(shifted, SeriesInstanceUID="1.2.4"), "b")
    Path("in/notes.txt").write_text("no image")
    os.mkdir("in/deeper")
    check(read_grid("in:1.2.3"), STEPS, 6e-4)
    check(read_grid("in:1.2.4"), tolerance=6e-4)
    assert said_of("in") == "in holds several arrays, 1.2.3, 1.2.4: give in:1.2.3, say"
    assert "in has no series of DICOM images '9'" in said_of("in:9")
    os.mkdir("empty")
    assert said_of("empty") == "empty holds no series of DICOM images"


def test_missing_doubled_tilted_and_unplaced_slices_are_refused():
    images = slices_of(AFFINE)

    def said(name, of=images):
        save_slices(name, of)
        return said_of(name)

    gap = said("gap", of=[image for k, image in enumerate(images) if k != 6])
    assert "gap: IM011 is 0.54 mm off from even steps of 0.96: put all slices of one" in gap
    save_slices("twice", images[3:5], "b")
    assert "off from even steps" in said("twice")
    one = said("one", of=images[:1])
    assert "one: IM000 is its only slice: give the folder of a series" in one
    assert find_format("one") is DICOM and is_grid("one")
    os.rename("one/IM000", "one/a.dcm")
    assert "one/a.dcm: a.dcm is its only slice: give the folder of" in said_of("one/a.dcm")
    for k, image in enumerate(images):
        image.ImagePositionPatient[1] += 0.2 * k
    assert "columns 2 and 3 are not at right angles" in said("leaning")
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
    assert np.array_equal(grid.values < 0, sampled(AFFINE) < 0)
    images = slices_of(AFFINE)
    for k, image in enumerate(images):
        image.RescaleSlope = 0.001 * (1 + k % 3)
        stored = np.frombuffer(image.PixelData, np.int16) / (1 + k % 3)
        image.PixelData = np.rint(stored).astype(np.int16).tobytes()
    save_slices("pet", images)
    check(read_grid("pet"), STEPS, 2e-3)


def holding(dataset: pydicom.Dataset, **values: Any) -> pydicom.Dataset:
    """Return a dataset with these values; a dataset among them is a sequence of one."""
    for name, value in values.items():
        setattr(dataset, name, [value] if isinstance(value, pydicom.Dataset) else value)
    return dataset


def test_an_image_of_several_frames():
    """An enhanced image: the place of each frame in a sequence, the rest shared."""
    slices = slices_of(AFFINE)
    image, frames, shared = slices[0], [], pydicom.Dataset()
    for each in slices[::-1]:
        place = holding(pydicom.Dataset(), ImagePositionPatient=each.ImagePositionPatient)
        frames.append(holding(pydicom.Dataset(), PlanePositionSequence=place))
    for group, names in (
        ("PlaneOrientationSequence", ["ImageOrientationPatient"]),
        ("PixelMeasuresSequence", ["PixelSpacing"]),
        ("PixelValueTransformationSequence", ["RescaleSlope", "RescaleIntercept"]),
    ):
        holding(shared, **{group: holding(pydicom.Dataset(), **{n: image[n].value for n in names})})
        for name in names:
            delattr(image, name)
    pixels = b"".join(each.PixelData for each in slices[::-1])
    holding(image, PixelData=pixels, NumberOfFrames=len(slices))
    del image.ImagePositionPatient
    save_slices("plain", [image])
    assert "IM000 has 17 frames without a place each" in said_of("plain")
    holding(image, SharedFunctionalGroupsSequence=shared)
    image.PerFrameFunctionalGroupsSequence = frames
    save_slices("frames", [image])
    check(read_grid("frames"), STEPS, 6e-4)


# Open3D


def test_blocks_that_open3d_saved():
    """By Open3D 0.19: 300 of its voxels, their places, values and weights, as it says them."""
    said = np.load(DATA / "open3d-voxels.npz")
    grid = read_grid(DATA / "open3d-blocks.npz")
    assert grid.spacing == pytest.approx((0.06,) * 3)
    index = grid.to_index(said["places"].astype(float))
    assert np.abs(index - np.rint(index)).max() < 1e-4
    path = DATA / "open3d-blocks.npz"
    with open_volume(path) as (volume, _):
        stored = volume.read()
    found = stored[tuple(np.rint(index).astype(int).T)]
    assert np.array_equal(found, np.where(said["weight"] > 0, said["tsdf"], np.nan), equal_nan=True)
    assert stored.shape == grid.shape and "samples are unknown" in grid.notes[0]


# Damage


def save_any(name: str) -> None:
    """Write the part in the format of the name."""
    placed, cubes = PLACED | ORIENTED, affine_of(np.eye(3))
    if name in placed:
        placed[name](name, AFFINE if name in PLACED else cubes)
    elif name == "a.tif":
        tifffile.imwrite(name, sampled(cubes).T, photometric="minisblack")
    elif name == "a.h5":
        with h5py.File(name, "w") as file:
            file["field"] = sampled(cubes).T
    elif name == "a.vdb":
        Path(name).write_bytes((DATA / "two-balls.vdb").read_bytes())
    elif name == "a.sdf":
        Path(name).write_text(text_sdf(cubes))
    elif ".mrc" in name or ".map" in name:
        save_mrc("plain.mrc", AFFINE)
        data = Path("plain.mrc").read_bytes()
        Path(name).write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    elif name.endswith(".vtk"):
        image_of(AFFINE).save(name, binary="text" not in name)
    elif name.endswith(".nc"):
        old = {"format": "NETCDF3_CLASSIC"} if "3" in name else {}
        array_of().to_netcdf(name, engine="netcdf4", **old)
    else:
        save_mat(name, d=sampled(AFFINE))


SUFFIXES = [
    *("a.nii", "a.nii.gz", "a.nrrd", "a.mha", "a.vti", "a.tif", "a.h5", "a.vdb", "a.sdf"),
    *("a.mgz", "a.vtkhdf", "a.mrc", "a.map.gz", "a.vtk", "a.nc", "a.mat"),
]
FILES = [*SUFFIXES, "itk.h5", "text.vtk", "v3.nc", "v73.mat"]


@pytest.mark.parametrize("name", FILES)
def test_a_truncated_file_is_refused_in_one_line(name, capfd):
    save_any(name)
    assert read_grid(name, field="mask").low < 0  # in a process of its own
    whole = Path(name).read_bytes()
    Path(name).write_bytes(whole[: int(0.9 * len(whole))])
    capfd.readouterr()
    said = said_of(name)
    assert said.startswith(name) and len(said) < 400
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", [*SUFFIXES, "a.hdr"])
def test_another_kind_of_file_is_refused_in_one_line(name, capfd):
    Path(name).write_bytes(b"hello, this is no grid at all\n" * 20)
    Path("a.img").write_bytes(b"hello")
    said = said_of(name)
    assert said.startswith(name) and len(said) < 400
    assert capfd.readouterr() == ("", "")


# Commands


def test_a_missing_library_is_named_with_the_command_that_installs_it(monkeypatch):
    names = [*(name for name in SUFFIXES if find_format(name).extra), "series"]
    for name in names:
        save_any(name)
    monkeypatch.setattr("super_sdf.errors.find_spec", lambda module: None)
    for name in names:
        format_, said = find_format(name), said_of(name)
        wanted = f"pip install -e '.[{format_.extra}]' in a clone of super-sdf"
        assert said.startswith(f"{format_.name} (") and said.endswith(wanted)
