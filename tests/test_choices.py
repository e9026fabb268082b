"""One of several in a file: segments of DICOM, times, channels, classes, keys; names of labels."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import nibabel
import nrrd
import numpy as np
import pytest
import pyvista
import tifffile
import trimesh
import xarray
import zarr
from conftest import refusal
from placed import holding, write_image

from super_sdf import read_grid
from super_sdf.errors import GridError, SuperSdfError
from super_sdf.files.grids import names_in, open_volume

pytestmark = pytest.mark.usefixtures("folder")

PLACE = np.moveaxis(np.indices((18, 22, 28)), 0, -1)  # z, y, x
ONE = (np.linalg.norm(PLACE - [8, 10, 12], axis=-1) - 6.3).astype(np.float32)
TWO = np.stack([ONE, ONE - 1])


def read(path: str) -> np.ndarray:
    """Return the samples of a file, (z, y, x), as they are stored."""
    with open_volume(Path(path)) as (volume, _):
        return volume.read().T if volume.axes != "zyx" else volume.read()


# Segmentations of DICOM

SHAPE = (5, 7)  # rows, columns: a frame is no whole number of bytes


def save_segments(
    path: str, frames: list[tuple[int, float, np.ndarray]], labels: list[str], **about: object
) -> None:
    """Write frames, each a segment's number, its height and its mask, along x = -y, y = x."""
    of_frames = [
        holding(
            SegmentIdentificationSequence=holding(ReferencedSegmentNumber=number),
            PlanePositionSequence=holding(ImagePositionPatient=[1, 2, height]),
        )
        for number, height, _ in frames
    ]
    shared = holding(
        PlaneOrientationSequence=holding(ImageOrientationPatient=[0, 1, 0, -1, 0, 0]),
        PixelMeasuresSequence=holding(PixelSpacing=[0.5, 0.25], SpacingBetweenSlices=2),
    )
    masks = np.array([mask for *_, mask in frames])
    is_packed = masks.dtype == bool
    bits = 1 if is_packed else 8
    pixels = np.packbits(masks, bitorder="little") if is_packed else masks
    image = holding(
        SOPClassUID="1.2.840.10008.5.1.4.1.1.66.4",
        SOPInstanceUID="1.2.3.4",
        SeriesInstanceUID="1.2.3",
        **{"Rows": SHAPE[0], "Columns": SHAPE[1], "SamplesPerPixel": 1},
        **{"BitsAllocated": bits, "BitsStored": bits, "HighBit": bits - 1},
        PhotometricInterpretation="MONOCHROME2",
        PixelRepresentation=0,
        NumberOfFrames=len(frames),
        SegmentationType="BINARY",
        SharedFunctionalGroupsSequence=shared,
        PixelData=pixels.tobytes() + bytes(pixels.nbytes % 2),
    )
    image.SegmentSequence = [
        holding(SegmentNumber=n, SegmentLabel=label) for n, label in enumerate(labels, 1)
    ]
    image.PerFrameFunctionalGroupsSequence = of_frames
    Path(path).parent.mkdir(exist_ok=True)
    write_image(path, holding(image, **about))


def mask(seed: int) -> np.ndarray:
    """Return a mask of a frame."""
    return np.random.default_rng(seed).random(SHAPE) < 0.5


def test_segments_are_placed_by_height_and_frames_left_out_are_empty():
    """Of ``gap`` two frames are stored, 6 apart where 2 is stated; out of order, with another."""
    left, right = mask(0), mask(1)
    frames = [(1, 16.0, right), (2, 12.0, ~left), (1, 10.0, left)]
    save_segments("in/seg.dcm", frames, ["gap", "other"])
    want = np.zeros((8, *SHAPE), np.uint8)
    want[2], want[5] = left, right
    for path in ("in/seg.dcm:gap", "in:gap"):
        assert np.array_equal(read(path), want)
        with open_volume(Path(path)) as (volume, _):
            assert (volume.spacing, volume.origin) == ((0.25, 0.5, 2), (1, 2, 6))
            assert np.array_equal(volume.direction, [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    want[3][~left] = 2
    assert np.array_equal(read("in/seg.dcm"), want)
    assert {n: name for n, (name, _) in names_in("in").items()} == {1: "gap", 2: "other"}
    said = refusal(SuperSdfError, read_grid, "in:no")
    assert said == "in has no series of DICOM images 'no': it holds 1.2.3, gap, other"
    with open_volume(Path("in")) as (volume, _):
        assert volume.hint == "labels"
    assert "the values look like labels (0, 1, 2)" in refusal(GridError, read_grid, "in")


def test_a_segment_alone_is_a_mask_as_are_fractions_over_a_half():
    save_segments("a.dcm", [(1, 0.0, mask(0))], ["only"])
    assert read("a.dcm").max() == 1 and read("a.dcm").sum() == mask(0).sum()
    parts = np.arange(35, dtype=np.uint8).reshape(SHAPE) * 7
    about = {"SegmentationType": "FRACTIONAL", "MaximumFractionalValue": 250}
    save_segments("b.dcm", [(1, 0.0, parts)], ["only"], **about)
    assert np.array_equal(read("b.dcm")[2], parts > 125)
    about = {"SOPClassUID": "1.2.840.10008.5.1.4.1.1.66.7", "SegmentationType": "LABELMAP"}
    save_segments("c.dcm", [(0, 0.0, parts % 3)], ["one", "two"], **about)
    assert np.array_equal(read("c.dcm")[2], parts % 3)
    assert np.array_equal(read("c.dcm:two")[2], parts % 3 == 2)


def test_a_segmentation_that_is_cut_off_is_refused():
    save_segments("a.dcm", [(1, 2.0 * k, mask(k)) for k in range(6)], ["only"])
    Path("a.dcm").write_bytes(Path("a.dcm").read_bytes()[:-12])
    assert "cannot be read: it is truncated" in refusal(SuperSdfError, read_grid, "a.dcm")


def test_segments_that_do_not_go_together_are_refused():
    save_segments("a.dcm", [(1, 0.0, mask(0)), (2, 0.0, mask(0))], ["one", "two"])
    said = "a.dcm: its segments overlap: give one of them, a.dcm:two"
    assert refusal(GridError, read, "a.dcm").endswith(said.partition(": ")[2])
    save_segments("b.dcm", [(1, 0.0, mask(0)), (1, 2.9, mask(0))], ["one"])
    assert "0.9 mm off from even steps of 2" in refusal(GridError, read, "b.dcm")


def test_labels_are_called_what_the_file_says(command):
    labels = np.zeros((20, 16, 14), np.uint8)
    labels[3:9, 4:12, 3:11], labels[9:16, 4:12, 3:11] = 1, 7
    header = {"space": "left-posterior-superior", "space directions": np.eye(3)}
    for n, (name, value, colour) in enumerate([("liver", 7, "1 0 0.5"), ("spleen", 1, "0 1 0")]):
        about = {"Name": name, "LabelValue": value, "Color": colour, "Layer": 0}
        header |= {f"Segment{n}_{key}": str(each) for key, each in about.items()}
    nrrd.write("a.seg.nrrd", labels, header)
    assert names_in("a.seg.nrrd") == {1: ("spleen", (0, 255, 0)), 7: ("liver", (255, 0, 128))}
    words = ("upsample", "a.seg.nrrd", "o.glb", "--labels", "liver", "--factor", 2, "--json")
    assert [row["name"] for row in json.loads(command(*words)[1])["labels"]] == ["liver"]
    assert "liver" in trimesh.load("o.glb").geometry
    assert command("upsample", "a.seg.nrrd", "o.ply", "--label", "liver", "-q")[0] == 0
    assert "; its labels: 7 (liver), 1 (spleen)" in refusal(GridError, read_grid, "a.seg.nrrd")


# Times, channels, classes


def save_several() -> dict[str, np.ndarray]:
    """Write files with the two fields in an axis that is not in space; return what is read."""
    where = {name: np.arange(float(n)) for name, n in zip("zyx", ONE.shape)}
    dims = ("time", "z", "y", "x")
    xarray.DataArray(TWO, dims=dims, coords=where, name="phi").to_netcdf("sim.nc")
    nibabel.save(nibabel.Nifti1Image(TWO.T, np.eye(4)), "a.nii.gz")
    tifffile.imwrite("a.tif", TWO, imagej=True, metadata={"axes": "TZYX"})
    np.savez("a.npz", probabilities=TWO, scale=np.ones(3))
    np.savez("b.npz", **{"one": ONE, "two": ONE, "two[1]": TWO[1]})
    nrrd.write("a.nrrd", TWO, {"kinds": ["list", "domain", "domain", "domain"]})
    zarr.create_array("a.zarr", shape=TWO.shape, dtype="f4")[...] = TWO
    with h5py.File("a.h5", "w") as file:
        file["deep/phi"] = TWO[:, None]
    np.save("a.npy", TWO)
    return {
        **{"sim.nc:phi[1]": TWO[1], "sim.nc[0]": ONE, "a.nii.gz[1]": TWO[1], "a.tif[1]": TWO[1]},
        **{"a.npz:probabilities[1]": TWO[1].T, "a.npz[0]": ONE.T, "b.npz:two": ONE.T},
        **{"a.nrrd[1]": TWO[1].T, "a.zarr[1]": TWO[1], "a.h5:/deep/phi[1]": TWO[1]},
        **{"a.npy[1]": TWO[1].T, "b.npz:two[1]": TWO[1].T},
    }


def test_a_number_chooses_a_time_a_channel_or_a_class():
    for path, want in save_several().items():
        found = read(path)
        assert np.array_equal(found, want), path
    for path, axis in (("sim.nc", "time"), ("a.nii.gz", 3), ("a.tif", "t"), ("a.npz", 0)):
        said = f"{path}: its axis {axis} has 2 entries, from 0 on: choose one, {path}[0], say"
        assert refusal(GridError, read_grid, path) == said
    assert "time has 2 entries, from 0 on: choose one" in refusal(GridError, read_grid, "sim.nc[2]")
    said = "b.npz has 0 axes to choose from by [0], [1], ..."
    assert refusal(SuperSdfError, read_grid, "b.npz:one[1]") == said
    assert "NIfTI files hold one array" in refusal(SuperSdfError, read_grid, "a.nii.gz:phi")


def test_batches_name_the_meshes_of_chosen_arrays(command):
    save_several()
    words = ("--out", "out", "--quality", "fast", "--field", "smooth", "--spacing", "1", "-q")
    code, _, err = command("batch", "a.npz:probabilities[1]", "a.tif[0]", *words)
    assert code == 0, err
    Path("scans").mkdir()
    Path("scans/slice.dcm").write_bytes(b"one of many")
    assert "scans holds no grid (" in command("batch", "scans", *words)[2]
    assert {path.name for path in Path("out").glob("*.ply")} == {"a-probabilities-1.ply", "a-0.ply"}


# What else files say


def test_depth_is_turned():
    down = {"units": "m", "positive": "down"}
    where = {"depth": ("depth", np.arange(18.0), down)}
    where |= {
        name: (name, np.arange(float(n)), {"units": "m"}) for name, n in (("y", 22), ("x", 28))
    }
    xarray.DataArray(ONE, dims=("depth", "y", "x"), coords=where, name="d").to_netcdf("a.nc")
    with open_volume(Path("a.nc")) as (volume, _):
        assert np.array_equal(volume.direction[:, 0], [0, 0, -1])


def test_a_number_of_several_at_each_point_of_vtk():
    image = pyvista.ImageData(dimensions=ONE.shape[::-1])
    image["v"] = TWO.reshape(2, -1).T
    image.save("a.vti")
    assert np.array_equal(read("a.vti:v[1]"), TWO[1])
    assert "has 2 numbers per sample: give an array of one, or NAME[0]" in refusal(
        GridError, read_grid, "a.vti:v[2]"
    )
