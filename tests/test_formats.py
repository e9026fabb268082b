"""Grids of every format: at the right place, side and size; what is particular in some; damage."""

from __future__ import annotations

import itertools
import os
import re
from pathlib import Path

import h5py
import mrcfile
import nibabel
import nrrd
import numpy as np
import pydicom
import pytest
import pyvista
import SimpleITK as sitk  # noqa: N813
import tifffile
import trimesh
from conftest import ball, refusal, said_of
from placed import (
    AFFINE,
    CUBES,
    DATA,
    FIRST,
    OBLIQUE,
    PLACED,
    SIZES,
    STEPS,
    TURNS,
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
    text_sdf,
)

from super_sdf import read_grid
from super_sdf.errors import FileError, GridError, SuperSdfError
from super_sdf.files import formats
from super_sdf.files.formats import DICOM, find_format, is_grid
from super_sdf.files.grids import open_volume

pytestmark = pytest.mark.usefixtures("folder")


@pytest.mark.parametrize("is_oblique", [False, True])
@pytest.mark.parametrize("turn", range(0, len(TURNS), 5))
@pytest.mark.parametrize("name", PLACED)
def test_axes_in_any_order_and_direction_with_any_spacing(name, turn, is_oblique):
    """The axes come in the order and sense in which they are nearest to the world's."""
    nearest = OBLIQUE if is_oblique else np.eye(3)
    save(name, affine_of(nearest @ TURNS[turn]))
    grid = read_grid(name)
    check(grid, STEPS[np.abs(TURNS[turn]).argmax(1)], 6e-4 if name == "series" else 2e-5)
    assert np.allclose(grid.direction, nearest, atol=1e-5)


def test_a_direction_is_given_where_the_file_has_none():
    affine = affine_of(OBLIQUE)
    place = {"spacing": STEPS, "origin": affine[:3, 3], "direction": OBLIQUE}
    np.save("c.npy", np.ascontiguousarray(sampled(affine)))
    np.save("zyx.npy", sampled(affine).T)
    np.savez("a.npz", values=sampled(affine), **place)
    save("a.tif", affine)
    with h5py.File("a.h5", "w") as file:
        for name, direction in (("field", np.eye(3)[::-1]), ("turned", OBLIQUE)):
            file[name] = sampled(affine).T
            file[name].attrs.update({**place, "direction": direction.ravel()})
    for name, options in (
        ("c.npy", place),
        ("zyx.npy", {**place, "axes": "zyx"}),
        ("a.tif", place),
        ("a.h5:/field", place),  # what is given replaces what is stated
        ("a.npz", {}),
        ("a.h5:/turned", {}),
    ):
        grid = read_grid(name, **options)
        check(grid)
        assert np.allclose(grid.direction, OBLIQUE)
    assert read_grid("a.npz", direction=np.eye(3)).is_straight


def test_three_dialects_of_sdf():
    values, low = sampled(CUBES), CUBES[:3, 3].astype("<f4")
    Path("text.sdf").write_text(text_sdf())
    tag = "#sdf 1\ndim {} {} {}\ndata\n".format(*SIZES).encode()
    Path("tagged.sdf").write_bytes(tag + values.tobytes())
    high = (low + np.array(SIZES) * 0.5).astype("<f4")
    head = np.array(SIZES, "<i4").tobytes() + low.tobytes() + high.tobytes()
    Path("boxed.sdf").write_bytes(head + values.tobytes())
    check(read_grid("text.sdf"), 0.5)
    check(read_grid("tagged.sdf", spacing=0.5, origin=low), 0.5)
    check(read_grid("boxed.sdf"), 0.5)


def test_a_given_spacing_and_origin_replace_those_of_the_file():
    """The origin is that of the file's sample (0, 0, 0), also if its axes run backwards."""
    affine = affine_of(np.diag([-1.0, 1.0, -1.0]))
    nibabel.save(nibabel.Nifti1Image(sampled(affine), np.diag([-3, 2, -1, 1])), "a.nii")
    check(read_grid("a.nii", spacing=STEPS, origin=affine[:3, 3]))


@pytest.mark.parametrize("dtype", [">f4", "<f8", "f2", ">i4", "i8", "i1"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_every_dtype_and_order_is_read(dtype, order):
    values = np.clip(ball().values * 8, -120, 120).astype(dtype)
    np.save("in.npy", np.asarray(values, order=order))
    np.testing.assert_array_equal(read_grid("in.npy", spacing=8).values, values)


def test_what_is_no_grid_is_refused_with_the_way_out(command):
    for name in ("a.nii", "a.zarr"):
        os.mkdir(name)
    first = "super-sdf sample part.stl part.npz -n 64"
    for name, said in {
        "part.stl": f"is a mesh, not a grid: sample it first, {first}",
        "part.step": f"is a CAD model, not a grid: sample it first, export part.stl, then {first}",
        "a.nii": "is a folder: give a file",
        "a.zarr": "cannot be read as Zarr: No group found in store",
        "no.zarr": "does not exist",
    }.items():
        code, _, err = command("upsample", name, "o.ply")
        assert code == (2 if "part" in name else 1) and err.count("\n") == 1
        assert err.startswith(f"Error: {name} {said}")


def test_components_and_missing_axes_are_refused():
    sitk.WriteImage(sitk.Image([4, 4, 4], sitk.sitkVectorFloat32, 3), "v.mha")
    tifffile.imwrite("rgb.tif", np.zeros((5, 6, 7, 3), np.uint8), photometric="rgb")
    nrrd.write("two.nrrd", np.zeros((4, 5)))
    for name in ("v.mha", "rgb.tif", "two.nrrd"):
        with pytest.raises(GridError, match=f"{name} has .*: give a (file|stack) of three axes"):
            read_grid(name)


def test_the_page_on_formats_lists_those_of_the_table():
    page = (Path(__file__).parent.parent / "docs" / "guides" / "formats.md").read_text()
    for format_ in (*formats.FORMATS, formats.DICOM):
        start = f"| {format_.name} | `{'`, `'.join(format_.suffixes)}` | "
        assert start + (f"`{format_.extra}`" if format_.extra else "none") in page


def test_another_package_brings_formats(monkeypatch, command):
    """The package is that of the page on formats."""
    page = (Path(__file__).parent.parent / "docs" / "guides" / "formats.md").read_text()
    table, code = (re.search(rf"```{kind}\n(.*?)```", page, re.S)[1] for kind in ("toml", "python"))
    table = re.sub(r'project\.entry-points\.|"', "", table)
    Path("my_formats.py").write_text(code)
    Path("my_formats-1.0.dist-info").mkdir()
    Path("my_formats-1.0.dist-info/entry_points.txt").write_text(table)
    monkeypatch.syspath_prepend(Path.cwd())
    (0.5 * ball(64, 20.0).values).astype("f4").tofile("in.raw64")
    grid = read_grid("in.raw64")
    assert grid.shape == (64, 64, 64) and grid.spacing == (0.5,) * 3 and is_grid("in.raw64")
    words = "--factor", 2, "--quality", "fast", "-q"
    assert command("batch", "in.raw64", "--out", ".", *words)[0] == 0
    assert command("upsample", "in.raw64", "out.pts", *words)[0] == 0
    vertices = np.loadtxt("out.pts")
    assert np.allclose(vertices, trimesh.load("in.ply", process=False).vertices, atol=1e-5)
    Path("bad.raw64").write_bytes(b"1234")
    said = "bad.raw64 cannot be read as .raw64: cannot reshape array"
    assert refusal(FileError, read_grid, "bad.raw64").startswith(said)


SUFFIXES = [
    *("a.nii", "a.nii.gz", "a.nrrd", "a.mha", "a.vti", "a.tif", "a.h5", "a.vdb", "a.sdf"),
    *("a.mgz", "a.vtkhdf", "a.mrc", "a.map.gz", "a.vtk", "a.nc", "a.mat"),
]


@pytest.mark.parametrize("damage", ["truncated", "another kind"])
@pytest.mark.parametrize("name", [*SUFFIXES, "a.hdr", "itk.h5", "text.vtk", "v3.nc", "v73.mat"])
def test_a_damaged_file_is_refused_in_one_line(name, damage, capfd):
    save(name)
    assert read_grid(name, field="mask").low < 0
    data = Path("a.img" if name == "a.hdr" else name)
    if damage == "truncated":
        data.write_bytes(data.read_bytes()[: int(0.9 * data.stat().st_size)])
    else:
        Path(name).write_bytes(b"hello, this is no grid at all\n" * 20)
    capfd.readouterr()
    said = refusal(SuperSdfError, read_grid, name)
    assert said.startswith(name) and len(said) < 400
    assert capfd.readouterr() == ("", "")


def test_a_missing_library_is_named_with_the_command_that_installs_it(monkeypatch):
    names = [*(name for name in SUFFIXES if find_format(name).extra), "series"]
    for name in names:
        save(name)
    monkeypatch.setattr("super_sdf.errors.find_spec", lambda module: None)
    for name in names:
        format_, said = find_format(name), refusal(SuperSdfError, read_grid, name)
        wanted = f"pip install -e '.[{format_.extra}]' in a clone of super-sdf"
        assert said.startswith(f"{format_.name} (") and said.endswith(wanted)


# What is particular in files of medicine, microscopy, simulation and scanning


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
    labels = array.copy(data=np.where(array < 2, np.where(array < 1, -1, 2), 0).astype("i2"))
    labels.to_netcdf("d.nc", encoding={"distance": {"_FillValue": -1}})
    assert (read_grid("d.nc", label=2).values < 0).sum() == (array < 2).sum()
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
