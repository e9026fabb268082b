"""Zarr stores of both formats, however they are chunked; OME-NGFF metadata; ``info`` of a file."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import zarr
from conftest import ball, said_of

from super_sdf import read_grid

SHAPE = (30, 26, 22)  # x, y, z: no chunk divides them
VALUES = ball(shape=SHAPE, radius=7.3).values

pytestmark = pytest.mark.usefixtures("folder")


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
