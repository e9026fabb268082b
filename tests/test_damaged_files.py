"""Grid files that are damaged, that state too much, or that name other files: one line each.

No input here harms another program: they state sizes too large, end early, or have a flipped bit.
"""

from __future__ import annotations

import bz2
import gzip
import os
import zlib
from pathlib import Path

import numpy as np
import pytest
import pyvista
import SimpleITK as sitk  # noqa: N813
from conftest import refusal
from test_formats import affine_of, sampled, save_itk, save_nifti, save_nrrd, save_vti, text_sdf
from test_untrusted_files import count_silent
from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

from super_sdf import SdfGrid, read_grid
from super_sdf.errors import SuperSdfError
from super_sdf.files.formats import find_format
from super_sdf.files.grids import open_volume
from super_sdf.files.readers.raw_files import TYPES
from super_sdf.threads import forget_peak, held_memory

AFFINE = affine_of(np.eye(3))
VALUES = sampled(AFFINE)
RAW = VALUES.ravel("F").tobytes()
MHA = (
    "ObjectType = Image\nNDims = 3\nBinaryData = True\nDimSize = 24 20 17\n"
    "ElementType = MET_FLOAT\nElementSpacing = 0.5 0.5 0.5\n"
)
PLACE = ["spacings: .5 .5 .5"]
NRRD = "NRRD0004\ntype: float\ndimension: 3\nsizes: 24 20 17\nendian: little\n"


pytestmark = pytest.mark.usefixtures("folder")


def write(name: str, *parts: str | bytes) -> str:
    """Write a file of some parts."""
    Path(name).write_bytes(b"".join(p.encode() if isinstance(p, str) else p for p in parts))
    return name


def mha(*lines: str, data: bytes = RAW, file: str = "LOCAL", name: str = "a.mha") -> str:
    """Write a MetaImage file with some more lines in its header."""
    return write(name, MHA, *(f"{line}\n" for line in lines), f"ElementDataFile = {file}\n", data)


def nrrd_file(*lines: str, data: bytes = RAW, name: str = "a.nrrd") -> str:
    """Write an NRRD file with some more lines in its header."""
    return write(name, NRRD, *(f"{line}\n" for line in lines), "\n", data)


def said_of(name: str, **options: object) -> str:
    """Return the one line with which a file is refused."""
    said = refusal(SuperSdfError, read_grid, name, **options)
    assert name in said and len(said) < 400
    return said


# Flipped bits


CHECKED = {
    "a.mha": lambda name: save_itk(name, AFFINE),
    "a.nii.gz": lambda name: save_nifti(name, AFFINE),
    "a.nrrd": lambda name: save_nrrd(name, AFFINE),
    "b.nrrd": lambda name: nrrd_file("encoding: bzip2", *PLACE, data=bz2.compress(RAW), name=name),
    "a.vti": lambda name: save_vti(name, AFFINE),
    "a.npz": lambda name: np.savez_compressed(name, values=VALUES, spacing=0.5),
}
ENDS_OF_TEXT = {".mha": b"= LOCAL\n", ".nrrd": b"\n\n", ".vti": b'<AppendedData encoding="base64">'}


@pytest.mark.parametrize("name", CHECKED)
def test_no_flipped_bit_in_checked_data_passes(name, monkeypatch):
    """Of 60 anywhere behind the text of a header, for which no format has a checksum."""
    monkeypatch.setattr("super_sdf.threads.left_memory", lambda: None)  # it takes a while
    CHECKED[name](name)
    whole, end = Path(name).read_bytes(), ENDS_OF_TEXT.get(Path(name).suffix, b"")
    first = whole.index(end) + len(end)
    place = "spacing", "origin", "direction"

    def read() -> np.ndarray:
        grid = read_grid(name)
        return np.concatenate(
            [grid.values.ravel(), *(np.ravel(getattr(grid, key)) for key in place)]
        )

    assert count_silent(name, [(first, len(whole) - first)], read) == 0


def same_grid(one: SdfGrid, other: SdfGrid) -> bool:
    place = ("spacing", "origin", "direction")
    return np.array_equal(one.values, other.values) and all(
        np.array_equal(getattr(one, key), getattr(other, key)) for key in place
    )


def test_a_compressed_stream_is_whole_and_ends_where_the_file_does():
    packed = zlib.compress(RAW)
    size = f"CompressedDataSize = {len(packed)}"
    good = read_grid(mha("CompressedData = True", size, data=packed))
    assert same_grid(read_grid(mha("CompressedData = True", data=packed)), good)
    cases = {
        "a.mha is damaged: its end, with the checksum, is missing": packed[:-2],
        "a.mha is damaged: it holds more than its header promises": packed + b"x",
        "a.mha is damaged: 4 bytes are missing": zlib.compress(RAW[:-4]),
    }
    for said, data in cases.items():
        assert said_of(mha("CompressedData = True", data=data)) == said
    more = zlib.compress(RAW + b"1234")
    assert "it holds more" in said_of(mha("CompressedData = True", data=more))
    said = said_of(mha("CompressedData = True", size, data=packed[:-2]))
    sizes = f"its CompressedDataSize is {len(packed):,}, but {len(packed) - 2:,} bytes follow"
    assert said == f"a.mha is damaged: {sizes}"


def test_raw_data_is_as_long_as_the_header_says():
    promised = "24 x 20 x 17 float32, 32,640 bytes"
    for write_file, name in ((mha, "a.mha"), (nrrd_file, "a.nrrd")):
        lines = ["encoding: raw"] if name == "a.nrrd" else []
        short, long = (said_of(write_file(*lines, data=data)) for data in (RAW[:-4], RAW + b"abcd"))
        shape = "17 x 20 x 24 float32, 32,640 bytes"
        assert short == f"{name} is truncated: {shape} are promised, but 32,636 follow"
        assert long.startswith(f"{name} holds more than its header promises: {shape}")
    save_nifti("a.nii", AFFINE)
    whole = Path("a.nii").read_bytes()
    said = f"a.nii is truncated: its header promises {promised} from byte 352 on"
    assert said_of(write("a.nii", whole[:-1])).startswith(said)


# Headers that state too much


@pytest.mark.parametrize("first, size", [("", "999999999999999999"), ("-", "1000000000")])
def test_sizes_that_no_file_has_are_refused_at_once(size, first):
    huge = f"{first}{size} {size} {size}"
    write("a.mha", MHA.replace("24 20 17", huge), "ElementDataFile = LOCAL\n", RAW)
    write("a.nrrd", NRRD.replace("24 20 17", huge), "encoding: gzip\n\n", gzip.compress(RAW))
    write("b.nrrd", NRRD.replace("24 20 17", huge), "encoding: ascii\n\n", "1 2 3")
    write("a.sdf", f"{huge}\n0 0 0\n1\n1 2 3\n")
    write("b.sdf", f"#sdf 1\ndim {huge}\ndata\n1234")
    save_vti("a.vti", AFFINE)
    write("a.vti", Path("a.vti").read_bytes().replace(b"7 23", b"7 99999999"))
    forget_peak()
    held = held_memory()
    for name in ("a.mha", "a.nrrd", "b.nrrd", "a.sdf", "b.sdf", "a.vti"):
        said_of(name)
    assert held_memory(peak=True) - held < 30e6


@pytest.mark.parametrize(
    "line, said",
    [
        ("DimSize = 24 20 x", "a.mha: its header is damaged: it states DimSize twice"),
        ("Offset = 1 2", "a.mha: its Offset is '1 2': give 3 numbers"),
        ("TransformMatrix = 1 0 0 0 1 0 0 0 nan", "a.mha: its TransformMatrix is "),
        ("no field", "a.mha: its header is damaged: the line 'no field' is no NAME = VALUE"),
        ("BinaryData = False", "a.mha: its header is damaged: it states BinaryData twice"),
        ("HeaderSize = 12 3x", "a.mha: its HeaderSize is '12 3x': give whole numbers"),
        ("HeaderSize = 999999999", "a.mha is truncated: "),
        ("CompressedData = True\nHeaderSize = -1", "a.mha: it is compressed, in several files or"),
    ],
)
def test_fields_of_metaimage_are_checked(line, said):
    assert said_of(mha(line)).startswith(said)


def test_an_unknown_type_of_metaimage_is_refused():
    write("a.mha", MHA.replace("MET_FLOAT", "MET_STRING"), "ElementDataFile = LOCAL\n", RAW)
    assert said_of("a.mha").startswith("a.mha: its ElementType is 'MET_STRING': give one of MET_")


def test_skips_of_nrrd_are_bounded():
    said = "a.nrrd: it has no 1,000,000 lines to skip (line skip)"
    assert said_of(nrrd_file("encoding: raw", "line skip: 1000000")) == said
    assert "truncated" in said_of(nrrd_file("encoding: raw", "byte skip: 1000000000"))
    said = "a.nrrd: its encoding is 'gzip', byte skip 8: save it as raw"
    assert said_of(nrrd_file("encoding: gzip", "byte skip: 8")) == said
    grid = read_grid(nrrd_file("encoding: raw", *PLACE, "byte skip: -1", data=b"x" + RAW))
    assert np.array_equal(grid.values.T.ravel(), VALUES.T.ravel())
    lines = "encoding: raw", *PLACE, "line skip: 2"
    assert same_grid(read_grid(nrrd_file(*lines, data=b"a\nb\n" + RAW)), grid)
    text = " ".join(map(repr, VALUES.ravel("F").tolist())).encode()
    assert same_grid(read_grid(nrrd_file("encoding: text", *PLACE, data=text)), grid)
    assert "truncated" in said_of(nrrd_file("encoding: text", data=text[:-200]))


def test_an_extension_of_nifti_is_not_loaded():
    """It claims 100 MB, which the file unpacks to."""
    save_nifti("a.nii", AFFINE)
    whole = bytearray(Path("a.nii").read_bytes())
    whole[108:112] = np.float32(1e8).tobytes()
    whole[348:352] = b"\1\0\0\0"
    claim = np.array([int(1e8) - 352, 6], "<i4").tobytes()
    packed = gzip.compress(bytes(whole[:352]) + claim + bytes(int(1e8) - 360) + RAW, 1)
    write("a.nii.gz", packed)
    forget_peak()
    held = held_memory()
    assert read_grid("a.nii.gz").shape == (24, 20, 17)
    assert held_memory(peak=True) - held < 60e6


def test_a_number_without_end_is_refused():
    text = text_sdf(AFFINE)
    write("a.sdf", text[: len(text) // 2], "1" * 3_000_000)
    assert said_of("a.sdf").startswith("a.sdf is damaged: a value of 1,0")


# Bombs

BOMB = 1 << 26


@pytest.mark.parametrize("name", ["a.mha", "a.nii.gz", "a.vti", "a.npz"])
def test_a_bomb_is_refused_within_the_bound(name, monkeypatch):
    """Zeros of 67 MB in some kilobytes, with 50 MB allowed: before anything is unpacked."""
    make_bomb(name, bytes(BOMB))
    assert Path(name).stat().st_size < BOMB / 500
    monkeypatch.setattr("super_sdf.files.unpacking._scratch_file", None)  # no room is taken
    forget_peak()
    held = held_memory()
    said = said_of(name, max_memory=held + 5 * 10**7)
    assert "like a zip bomb, and does not fit in memory" in said
    assert held_memory(peak=True) - held < 30e6


def make_bomb(name: str, zeros: bytes) -> None:
    """Write zeros as a grid of bytes of 512 x 512 x 256."""
    sizes = "512 512 256"
    if name == "a.mha":
        text = MHA.replace("24 20 17", sizes).replace("MET_FLOAT", "MET_UCHAR")
        write(name, text, "CompressedData = True\nElementDataFile = LOCAL\n", zlib.compress(zeros))
    elif name == "a.npz":
        np.savez_compressed(name, values=np.frombuffer(zeros, np.uint8).reshape(256, 512, 512))
    elif name == "a.nii.gz":
        save_nifti("a.nii", AFFINE)
        head = bytearray(Path("a.nii").read_bytes()[:352])
        head[42:48] = np.array([512, 512, 256], "<i2").tobytes()
        head[70:74] = np.array([2, 8], "<i2").tobytes()
        write(name, gzip.compress(bytes(head) + zeros))
    else:
        packed = zlib.compress(zeros)
        text = (
            '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64"'
            ' compressor="vtkZLibDataCompressor"><ImageData WholeExtent="{0}"><Piece Extent="{0}">'
            '<PointData><DataArray type="UInt8" Name="d" format="appended" offset="0"/></PointData>'
        )
        text += '</Piece></ImageData><AppendedData encoding="raw">_'
        words = np.array([1, BOMB, BOMB, len(packed)], "<u8").tobytes()
        write(name, text.format("0 511 0 511 0 255"), words, packed)


@pytest.mark.parametrize("name", ["a.mha", "a.nrrd"])
def test_what_goes_on_after_the_samples_is_not_unpacked(name):
    """A header of 33 kB before a stream of 67 MB."""
    stream = RAW + bytes(BOMB)
    if name == "a.mha":
        mha("CompressedData = True", data=zlib.compress(stream))
    else:
        nrrd_file("encoding: gzip", data=gzip.compress(stream))
    del stream
    forget_peak()
    held = held_memory()
    assert said_of(name) == f"{name} is damaged: it holds more than its header promises"
    assert held_memory(peak=True) - held < 30e6


# Data beside a header

DETACHED = {
    "a.mhd": lambda data: write("a.mhd", MHA, f"ElementDataFile = {data}\n"),
    "a.nhdr": lambda data: write("a.nhdr", NRRD, f"encoding: raw\ndata file: {data}\n"),
}


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
    elsewhere = ": put both into one folder"
    for data, said in {
        str(tmp_path / "out.raw"): elsewhere,
        "../out.raw": elsewhere,
        "below/../../out.raw": elsewhere,
        "link.raw": elsewhere,
        "up/out.raw": elsewhere,
        "pipe.raw": "pipe.raw is a named pipe: give a file",
        "zero.raw": "zero.raw is a device: give a file",
        "none.raw": "none.raw does not exist",
        "below": "below is a folder: give a file",
    }.items():
        DETACHED[name](data)
        assert said_of(name).endswith(said)
    DETACHED[name]("below/a.raw")
    assert read_grid(name, spacing=0.5).shape == (24, 20, 17)


@pytest.mark.parametrize("name", DETACHED)
def test_a_header_that_is_a_link_has_its_data_beside_what_it_leads_to(name):
    os.makedirs("store")
    os.makedirs("links")
    write("store/a.raw", RAW)
    DETACHED[name]("a.raw")
    os.rename(name, f"store/{name}")
    for file in ("a.raw", name):
        os.symlink(f"../store/{file}", f"links/{file}")
    assert read_grid(f"links/{name}", spacing=0.5).shape == (24, 20, 17)


def test_lists_and_patterns_of_metaimage_are_what_itk_reads():
    for number, plane in enumerate(np.ascontiguousarray(VALUES.T)):
        write(f"p{number + 3:03d}.raw", plane.tobytes())
    names = "".join(f"p{number + 3:03d}.raw\n" for number in range(17))
    for name, text in {
        "list.mhd": f"ElementDataFile = LIST\n{names}",
        "pattern.mhd": "ElementDataFile = p%03d.raw 3 19 1\n",
    }.items():
        write(name, MHA, text)
        assert np.array_equal(sitk.GetArrayFromImage(sitk.ReadImage(name)).T, VALUES)
        assert np.array_equal(read_grid(name).values, VALUES)
    write("list.mhd", MHA, "ElementDataFile = LIST\n", names.replace("p004", "../p004"))
    assert "names the file '../p004.raw', which is not in its folder" in said_of("list.mhd")
    write("list.mhd", MHA, "ElementDataFile = LIST\n", names[:50])
    assert said_of("list.mhd").startswith("list.mhd")
    write("pattern.mhd", MHA, "ElementDataFile = p%099999d.raw 3 19 1\n")
    said = "pattern.mhd: its ElementDataFile is 'p%099999d.raw 3 19 1': give NAME%03d.raw 1 17 1"
    assert said_of("pattern.mhd") == said


# Placement and types: ITK and VTK read the same


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


def test_a_spacing_below_0_is_that_of_itk():
    name = write("a.mha", MHA.replace("0.5 0.5", "-0.5 0.5"), "ElementDataFile = LOCAL\n", RAW)
    image, grid = sitk.ReadImage(name), read_grid(name)
    assert image.GetDirection()[0] == -1
    assert np.allclose(grid.origin, image.TransformIndexToPhysicalPoint((23, 0, 0)))
    assert np.array_equal(grid.values, VALUES[::-1])


@pytest.mark.parametrize(
    "order", ["", "BinaryDataByteOrderMSB = True", "ElementByteOrderMSB = True"]
)
@pytest.mark.parametrize("kind", TYPES)
def test_every_type_of_metaimage_is_what_itk_reads(kind, order):
    lines = f"ElementType = {kind}\nDimSize = 4 3 2\n{order}\nElementDataFile = LOCAL\n"
    size = 24 * np.dtype(TYPES[kind]).itemsize
    data = np.random.default_rng(3).integers(0, 120, size, np.uint8).tobytes()
    write("a.mha", "ObjectType = Image\nNDims = 3\n", lines, data)
    with open_volume(Path("a.mha"), find_format("a.mha"), "xyz", (1 << 20, None)) as volume:
        values = volume.read(0, 2)
    assert np.array_equal(values, sitk.GetArrayFromImage(sitk.ReadImage("a.mha")))


def read_vti(name: str) -> np.ndarray:
    """Return the samples of a file (z, y, x), read in three parts."""
    with open_volume(Path(name), find_format(name), "xyz", (1 << 20, None)) as volume:
        return np.concatenate([volume.read(*ends) for ends in ((0, 3), (3, 4), (4, 8))])


@pytest.mark.parametrize("order, word", [("Little", "64"), ("Big", "32")])
@pytest.mark.parametrize("packing", ["None", "ZLib", "LZ4", "LZMA"])
@pytest.mark.parametrize("mode", ["Ascii", "Binary", "raw", "base64"])
def test_every_encoding_of_vtk_is_what_vtk_reads(mode, packing, order, word):
    image = pyvista.ImageData(dimensions=(6, 7, 8))
    image.extent = 3, 8, -2, 4, 1, 8
    image["d"] = np.random.default_rng(5).random(6 * 7 * 8) * 100
    writer = vtkXMLImageDataWriter()
    writer.SetFileName("a.vti")
    writer.SetInputData(image)
    if mode in ("raw", "base64"):
        writer.SetDataModeToAppended()
        writer.SetEncodeAppendedData(mode == "base64")
    else:
        getattr(writer, f"SetDataModeTo{mode}")()
    getattr(writer, f"SetCompressorTypeTo{packing}")()
    getattr(writer, f"SetByteOrderTo{order}Endian")()
    getattr(writer, f"SetHeaderTypeToUInt{word}")()
    writer.SetBlockSize(1000)
    assert writer.Write()
    assert np.array_equal(read_vti("a.vti"), pyvista.read("a.vti")["d"].reshape(8, 7, 6))


PIECE = '<Piece Extent="{}"><PointData><DataArray type="Float32" Name="d" format="ascii">{}'
PIECE += "</DataArray></PointData></Piece>"


def pieces(*extents: str, name: str = "a.vti") -> str:
    """Write a file over points 0 to 3, 0 to 4, 0 to 7 whose value is x + 10 y + 100 z."""
    parts = []
    for extent in extents:
        a, b, c, d, e, f = map(int, extent.split())
        z, y, x = np.mgrid[e : f + 1, c : d + 1, a : b + 1]
        parts.append(PIECE.format(extent, " ".join(map(str, (x + 10 * y + 100 * z).ravel()))))
    head = (
        '<VTKFile type="ImageData" byte_order="LittleEndian"><ImageData WholeExtent="0 3 0 4 0 7">'
    )
    return write(name, head, *parts, "</ImageData></VTKFile>")


def test_pieces_may_overlap_but_leave_nothing_out():
    z, y, x = np.mgrid[0:8, 0:5, 0:4]
    whole = x + 10 * y + 100 * z
    pieces("0 3 0 4 0 3", "0 3 0 4 3 7")
    assert np.array_equal(read_vti("a.vti"), whole)
    pieces("0 2 0 4 0 7", "1 3 0 2 0 7", "2 3 1 4 0 7")
    assert np.array_equal(read_vti("a.vti"), whole)
    said = "a.vti: {} of its 160 samples are in no piece: save it with all pieces"
    assert said_of(pieces("0 3 0 4 0 3", "0 3 0 4 5 7")) == said.format(20)
    assert said_of(pieces("0 2 0 4 0 7", "1 3 0 2 0 7")) == said.format(16)
    assert said_of(pieces()) == "a.vti holds no array of points or cells"
    said = "a.vti is damaged: its piece (0, 4, 0, 4, 0, 7) is not in the whole extent"
    assert said_of(pieces("0 4 0 4 0 7")) == said


def test_xml_that_no_vtk_file_has_is_refused():
    pieces("0 3 0 4 0 7")
    text = Path("a.vti").read_text()
    write("a.vti", '<!DOCTYPE a [<!ENTITY b "c">]>', text)
    assert said_of("a.vti") == "a.vti has a document type: VTK image data has none"
    write("a.vti", text.replace('Name="d"', f'Name="{"d" * 3_000_000}"'))
    assert said_of("a.vti") == "a.vti is damaged: a tag is too long"
    write("a.vti", text.replace("ascii", "appended"))
    assert said_of("a.vti").startswith("a.vti:d is damaged: its offset is ''")
    write("a.vti", text.replace("</Piece>", "<a>" * 1000))
    assert said_of("a.vti").startswith("a.vti is no VTK image data, truncated or damaged: ")
