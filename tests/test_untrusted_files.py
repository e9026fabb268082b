"""Files from elsewhere: what they name, leave out, promise or hold damaged is said in a line."""

from __future__ import annotations

import bz2
import os
import re
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
import tifffile
from conftest import refusal, said_of
from placed import CUBES, sampled, save

from super_sdf import read_grid
from super_sdf.errors import FileError
from super_sdf.truth import read_mesh

VALUES = sampled(CUBES)
RAW = VALUES.ravel("F").tobytes()
MHA = (
    "ObjectType = Image\nNDims = 3\nBinaryData = True\nDimSize = 24 20 17\n"
    "ElementType = MET_FLOAT\nElementSpacing = 0.5 0.5 0.5\n"
)
NRRD = "NRRD0004\ntype: float\ndimension: 3\nsizes: 24 20 17\nendian: little\nspacings: .5 .5 .5\n"

APART = "which is not in its folder: put both into one folder"

pytestmark = pytest.mark.usefixtures("folder")


def write(name: str, *parts: str | bytes) -> str:
    """Write a file of some parts."""
    Path(name).write_bytes(b"".join(p.encode() if isinstance(p, str) else p for p in parts))
    return name


def mha(*lines: str, data: bytes = RAW) -> str:
    """Write a MetaImage file with some more lines in its header."""
    return write("a.mha", MHA, *(f"{line}\n" for line in lines), "ElementDataFile = LOCAL\n", data)


def nrrd_file(*lines: str, data: bytes = RAW) -> str:
    """Write an NRRD file with some more lines in its header."""
    return write("a.nrrd", NRRD, *(f"{line}\n" for line in lines), "\n", data)


@pytest.mark.parametrize("line", ["NDims = 3", "DimSize = 24 20 17", "ElementType = MET_FLOAT"])
def test_metaimage_without_a_field_is_one_line(line, capfd):
    write("a.mha", MHA.replace(line, "Comment = none"), "ElementDataFile = LOCAL\n", RAW)
    said = "its header is damaged: NDims, DimSize, ElementType or ElementDataFile is missing"
    assert said in refusal(FileError, read_grid, "a.mha") and capfd.readouterr().err == ""


# Data that is not as its header promises


def test_compressed_metaimage_is_whole_and_has_the_promised_size():
    packed = zlib.compress(RAW)
    for line in (f"CompressedDataSize = {len(packed)}", "Comment = no size"):
        grid = read_grid(mha("CompressedData = True", line, data=packed))
        assert np.array_equal(grid.values, VALUES)
    said = "a.mha is truncated or damaged: 32,640 bytes are promised"
    longer, shorter = zlib.compress(RAW + bytes(10)), zlib.compress(RAW[:-4])
    for data in (packed[:-2], packed[: len(packed) // 2], shorter, longer):
        assert said_of(mha("CompressedData = True", data=data)).startswith(said)


@pytest.mark.parametrize("packing", ["raw", "text", "bzip2", "gzip"])
def test_nrrd_in_every_encoding(packing):
    text = " ".join(map(repr, VALUES.ravel("F").tolist())).encode()
    gz = zlib.compressobj(wbits=31)
    data = {
        **{"raw": RAW, "text": text, "bzip2": bz2.compress(RAW)},
        "gzip": gz.compress(RAW) + gz.flush(),
    }[packing]
    assert np.array_equal(read_grid(nrrd_file(f"encoding: {packing}", data=data)).values, VALUES)
    said = said_of(nrrd_file(f"encoding: {packing}", data=data[: len(data) // 2]))
    assert said.startswith("a.nrrd")


@pytest.mark.parametrize("huge", ["999999999999999999 " * 3, "-1000000000 1000000000 1000000000"])
def test_sizes_that_no_file_has_are_refused_at_once(huge):
    write("a.mha", MHA.replace("24 20 17", huge), "ElementDataFile = LOCAL\n", RAW)
    write("a.nrrd", NRRD.replace("24 20 17", huge), "encoding: gzip\n\n", RAW)
    write("a.sdf", f"{huge}\n0 0 0\n1\n1 2 3\n")
    write("b.sdf", f"#sdf 1\ndim {huge}\ndata\n1234")
    save("a.vti", CUBES)
    write("a.vti", Path("a.vti").read_bytes().replace(b"7 23", b"7 99999999"))
    for name in ("a.mha", "a.nrrd", "a.sdf", "b.sdf", "a.vti"):
        assert said_of(name).startswith(name)


def test_a_spacing_of_vtk_that_is_no_number_is_refused():
    save("a.vti", CUBES)
    text = re.sub(rb'Spacing="\S+', b'Spacing="nan', Path("a.vti").read_bytes())
    assert said_of(write("a.vti", text)).startswith("a.vti: Spacing is [nan, ")


def test_what_is_loaded_whole_is_refused_if_it_would_not_fit():
    save("a.tif")
    said = "a.tif, 17 x 20 x 24 float32, loaded whole, needs "
    assert said_of("a.tif", max_memory=1000).startswith(said)
    np.savez_compressed("bomb.npz", values=np.zeros((200, 200, 200), np.float32))
    assert "float32, loaded whole, needs " in said_of("bomb.npz", max_memory=1000)


def test_damaged_numpy_files_are_a_line():
    np.savez("a.npz", values=VALUES)
    whole = bytearray(Path("a.npz").read_bytes())
    whole[9000] ^= 1
    assert "CRC" in said_of(write("a.npz", bytes(whole)))
    assert said_of(write("a.npz", bytes(whole[:9000]))).startswith("a.npz")


# Data in other files


DETACHED = {"a.mhd": MHA + "ElementDataFile = ", "a.nhdr": NRRD + "encoding: raw\ndata file: "}


@pytest.mark.parametrize("name", DETACHED)
def test_data_is_read_beside_its_header_alone(name, tmp_path):
    os.makedirs("in/below")
    write("out.raw", RAW)
    os.chdir("in")
    write("below/a.raw", RAW)
    os.mkfifo("pipe.raw")
    os.symlink("/dev/zero", "zero.raw")
    os.symlink("../out.raw", "link.raw")
    os.symlink("..", "up")
    above = ("../out.raw", "below/../../out.raw", "link.raw", "up/out.raw")
    above += ("LIST\n../out.raw", "../p%03d.raw 3 19 1")
    for data, said in {
        **dict.fromkeys((str(tmp_path / "out.raw"), *above), APART),
        "pipe.raw": "pipe.raw is no regular file: give a file",
        "zero.raw": APART,
        "none.raw": "none.raw does not exist",
        "below": "below is a folder: give a file",
    }.items():
        write(name, DETACHED[name], f"{data}\n")
        assert said_of(name).endswith(said)
    write(name, DETACHED[name], "below/a.raw\n")
    assert read_grid(name, spacing=0.5).shape == (24, 20, 17)


def test_numbers_of_hdf5_in_other_files_are_refused():
    write("b.raw", RAW)
    with h5py.File("a.h5", "w") as file:
        file.create_dataset("d", VALUES.shape, "<f4", external=[("b.raw", 0, len(RAW))])
    said = "a.h5: the numbers of /d are in other files: save them in this one"
    assert said_of("a.h5") == said


def ome_set(other):
    """Write an OME-TIFF whose pages from the tenth on are said to be in another file."""
    text = (
        '<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="urn:uuid:1">'
        '<Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYZTC" Type="float" '
        'SizeX="24" SizeY="20" SizeZ="17" SizeC="1" SizeT="1">'
        '<Channel ID="Channel:0" SamplesPerPixel="1"/>'
        '<TiffData FirstZ="0" IFD="0" PlaneCount="9">'
        '<UUID FileName="a.ome.tif">urn:uuid:1</UUID></TiffData>'
        '<TiffData FirstZ="9" IFD="0" PlaneCount="8">'
        f'<UUID FileName="{other}">urn:uuid:2</UUID></TiffData></Pixels></Image></OME>'
    )
    about = {"photometric": "minisblack", "metadata": None, "contiguous": False}
    for name, own, part in (
        ("a.ome.tif", text, VALUES.T[:9]),
        ("b.ome.tif", text.replace("urn:uuid:1", "urn:uuid:2", 1), VALUES.T[9:]),
    ):
        with tifffile.TiffWriter(name) as file:
            for number, page in enumerate(part):
                file.write(page, description=None if number else own, **about)


def test_files_of_an_ome_set_are_read_beside_the_file(tmp_path):
    ome_set("b.ome.tif")
    assert np.array_equal(read_grid("a.ome.tif", spacing=0.5).values, VALUES)
    for name in ("../b.ome.tif", str(tmp_path.parent / "b.ome.tif")):
        ome_set(name)
        assert said_of("a.ome.tif").endswith(f"names the file {name!r}, {APART}")
    os.mkfifo("pipe.tif")
    ome_set("pipe.tif")
    assert said_of("a.ome.tif").endswith("pipe.tif is no regular file: give a file")


# What is no regular file


WHAT_IS_WRONG = {
    "folder.npy": "is a folder: give a file",
    **dict.fromkeys(("pipe.npy", "zero.npy"), "is no regular file: give a file"),
    "dangling.npy": "does not exist",
    "missing.npy": "does not exist",
    "n" * 300 + ".npy": "cannot be read: File name too long",
}


@pytest.mark.parametrize("name", WHAT_IS_WRONG, ids=ascii)
def test_what_is_no_regular_file_is_named_as_grid_and_as_mesh(name):
    Path("folder.npy").mkdir()
    os.mkfifo("pipe.npy")
    Path("zero.npy").symlink_to("/dev/zero")
    Path("dangling.npy").symlink_to("nothing.npy")
    np.save("file", VALUES)
    Path("link.npy").symlink_to("file.npy")
    assert np.array_equal(read_grid("link.npy", spacing=0.5).values, VALUES)
    assert refusal(FileError, read_grid, name) == f"{name} {WHAT_IS_WRONG[name]}"
    if name in ("folder.npy", "pipe.npy", "zero.npy", "dangling.npy"):
        Path("a.ply").symlink_to(name)
        assert refusal(FileError, read_mesh, "a.ply") == f"a.ply {WHAT_IS_WRONG[name]}"


# Where ITK places a MetaImage


@pytest.mark.parametrize(
    "lines",
    [
        ["Offset = 1 2 3"],
        ["Position = 1 2 3", "Offset = 4 5 6", "Origin = 7 8 9"],
        ["Position = 1 2 3", "Offset = 4 5 6"],
        ["TransformMatrix = 0 1 0 0 0 -1 1 0 0", "CenterOfRotation = 1 1 1"],
        ["Rotation = 0 1 0 -1 0 0 0 0 1", "Comment = a = b", "Comment = c"],
        ["Orientation = 0.8 0.6 0 -0.6 0.8 0 0 0 1", "AnatomicalOrientation = RAI"],
        ["TransformMatrix = 1 0 0 0 1 0 0 0 -1", "Rotation = 0 1 0 -1 0 0 0 0 1"],
        ["ElementSize = 3 4 5", "Offset = -1e-3 2 1e2"],
        ["HeaderSize = -1"],
        ["ElementToIntensityFunctionSlope = 2"],
        ["", "Offset: 1 2 3\r"],
    ],
)  # fmt: skip
def test_a_metaimage_is_placed_where_itk_places_it(lines):
    name = mha(*lines)
    grid, image = read_grid(name), sitk.ReadImage(name)
    for index in ((0, 0, 0), (23, 0, 0), (4, 19, 16)):
        ijk = grid.to_index(np.array(image.TransformIndexToPhysicalPoint(index)))
        assert np.abs(ijk - np.rint(ijk)).max() < 1e-5
        assert grid.values[tuple(np.rint(ijk).astype(int))] == image[index]
