"""Zarr stores of both formats, however they are chunked; OME-NGFF metadata; ``info`` of a file."""

import json
from pathlib import Path

import numpy as np
import pytest
import zarr
from conftest import ball

from super_sdf import read_grid

SHAPE = (30, 26, 22)  # x, y, z
MODEL = ("--quality", "fast", "--spacing", "1", "-q")


pytestmark = pytest.mark.usefixtures("folder")


@pytest.fixture(scope="module")
def values():
    return ball(shape=SHAPE, radius=7.3).values


def store(path, array, version=3, name=None, **layout):
    """Write an array as a Zarr array, or below a group."""
    about = {"shape": array.shape, "dtype": array.dtype, **layout}
    about.setdefault("chunks", (8,) * array.ndim)
    made = zarr.create_array(path, name=name, zarr_format=version, **about)
    made[:] = array
    return made


def test_a_store_in_a_zip_file(values, command):
    with zarr.storage.ZipStore("a.zarr.zip", mode="w") as zipped:
        store(zipped, values.T, name="deep/field")
    np.testing.assert_array_equal(read_grid("a.zarr.zip", spacing=1).values, values)
    np.testing.assert_array_equal(read_grid("a.zarr.zip:/deep/field", spacing=1).values, values)
    Path("b.zarr.zip").write_bytes(Path("a.zarr.zip").read_bytes()[:-40])
    assert command("upsample", "b.zarr.zip", "o.ply")[2] == (
        "Error: b.zarr.zip cannot be read as Zarr: File is not a zip file\n"
    )


def image(path, levels, axes="zyx", version="0.5", whole=()):
    """Write an OME-Zarr image; ``levels`` are (array, transformations)."""
    group = zarr.open_group(path, mode="a", zarr_format=2 if version == "0.4" else 3)
    datasets = []
    for number, (array, steps) in enumerate(levels):
        about = {"shape": array.shape, "dtype": array.dtype, "chunks": (8,) * array.ndim}
        group.create_array(str(number), **about)[:] = array
        datasets.append({"path": str(number), "coordinateTransformations": steps})
    kinds, in_space = {"t": "time", "c": "channel"}, {"type": "space", "unit": "micrometer"}
    named = [{"name": a, **({"type": kinds[a]} if a in kinds else in_space)} for a in axes]
    about = {"axes": named, "datasets": datasets, "coordinateTransformations": list(whole)}
    scales = {"multiscales": [about]}
    group.attrs.update(scales if version == "0.4" else {"ome": {"version": version, **scales}})


def scale(*numbers):
    return {"type": "scale", "scale": list(numbers)}


def translation(*numbers):
    return {"type": "translation", "translation": list(numbers)}


@pytest.mark.parametrize("version", ["0.4", "0.5"])
def test_levels_of_an_image_and_their_transformations(values, version):
    """That of the whole image is applied last: 2 * (0.5 i + t) + 1."""
    half = values[::2, ::2, ::2]
    levels = [
        (values.T, [scale(0.5, 0.5, 0.5), translation(3, 2, 1)]),
        (half.T, [scale(1, 1, 1), translation(3, 2, 1)]),
    ]
    image("i.zarr", levels, version=version, whole=[scale(2, 2, 2), translation(1, 1, 1)])
    fine, coarse = read_grid("i.zarr"), read_grid("i.zarr:/1")
    assert fine.spacing == (1, 1, 1) and fine.origin == (3, 5, 7)
    assert fine.notes[0] == "lengths are in the unit of its axes, micrometer"
    np.testing.assert_array_equal(fine.values, values)
    assert coarse.spacing == (2, 2, 2) and coarse.origin == (3, 5, 7)
    np.testing.assert_array_equal(coarse.values, half)
    assert read_grid("i.zarr:/0").origin == fine.origin


def test_axes_of_time_and_channel_have_length_one(values):
    five = values.T[None, None]
    image("i.zarr", [(five, [scale(9, 9, 1, 1, 1), translation(9, 9, 3, 2, 1)])], axes="tczyx")
    grid = read_grid("i.zarr")
    assert grid.shape == SHAPE and grid.spacing == (1, 1, 1) and grid.origin == (1, 2, 3)
    np.testing.assert_array_equal(grid.values, values)


def test_info_of_a_file_prints_its_chunks(command, values):
    store("a.zarr", values.T, chunks=(4, 4, 4), shards=(16, 8, 8))
    said = command("info", "a.zarr")[1]
    assert said.splitlines() == [
        "file: a.zarr",
        "format: Zarr",
        "shape: 30, 26, 22",
        "dtype: float32",
        "bytes: 68,640",
        "axes in the file: zyx",
        "spacing: not stated",
        "origin: not stated",
        "zarr format: 3",
        "chunks: 4, 4, 4",
        "shards: 16, 8, 8",
    ]
    image("i.zarr", [(values.T, [scale(1, 1, 1), translation(3, 2, 1)])], version="0.4")
    found = json.loads(command("info", "i.zarr", "--json")[1])
    assert found["spacing"] == [1, 1, 1] and found["origin"] == [1, 2, 3]
    assert found["chunks"] == [8, 8, 8] and found["zarr format"] == 2
    assert found["notes"] == ["lengths are in the unit of its axes, micrometer"]
