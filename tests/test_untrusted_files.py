"""Files from elsewhere: what they name, leave out, unpack to or hold damaged is said in a line."""

from __future__ import annotations

import json
import os
import re
import resource
import struct
import subprocess
import sys
import threading
import zipfile
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import trimesh
import zarr
from batches import FAST
from conftest import ball, refusal

from super_sdf import read_grid
from super_sdf.errors import FileError, GridError, OutOfMemoryError, SuperSdfError, seen
from super_sdf.files import apart
from super_sdf.files.readers.zarr_files import CODECS
from super_sdf.truth.mesh_files import read_mesh

FLIPS = 60
BOMB = 3 << 27  # bytes that kilobytes unpack to
ZIPPED = zarr.codecs.GzipCodec()


pytestmark = pytest.mark.usefixtures("folder")


@pytest.fixture(scope="module")
def values():
    """Return a ball, (z, y, x), in a shape that no chunk divides."""
    return ball(shape=(30, 26, 22), radius=7.3).values


def read(path, **options):
    """Return the values of a file in the order of the file."""
    return read_grid(path, spacing=1, **options).values.T


def store(values, path="a.zarr", **layout):
    """Write a Zarr array in chunks of 8 x 8 x 8, without a name for its group."""
    about = {"shape": values.shape, "dtype": values.dtype, "chunks": (8, 8, 8), **layout}
    array = zarr.create_array(path, **about)
    array[:] = values
    return array


def edited(path, change):
    """Change the JSON document in a file."""
    found = json.loads(Path(path).read_text())
    change(found)
    Path(path).write_text(json.dumps(found))


def said_of(path, kind=FileError, **options):
    """Return the one line with which a file is refused."""
    return refusal(kind, read, path, **options)


# Codecs


PICKLE = {"name": "pickle"}
PICKLE_AT = {
    "compressor": lambda about: about.update(compressor={"id": "pickle"}),
    "filters": lambda about: about.update(filters=[{"id": "pickle"}]),
    "codecs": lambda about: about["codecs"].append(PICKLE),
    "a bare name": lambda about: about["codecs"].append("pickle"),
    "within a shard": lambda about: about["codecs"][0]["configuration"]["codecs"].append(PICKLE),
    "index of a shard": (
        lambda about: about["codecs"][0]["configuration"]["index_codecs"].append(PICKLE)
    ),
}


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize("place", PICKLE_AT)
def test_a_codec_that_is_not_in_the_list_is_refused_by_its_name(values, place):
    version = 2 if place in ("compressor", "filters") else 3
    store(values, zarr_format=version, **({"shards": (16, 16, 16)} if "shard" in place else {}))
    edited("a.zarr/.zarray" if version == 2 else "a.zarr/zarr.json", PICKLE_AT[place])
    assert said_of("a.zarr") == (
        "a.zarr names the codec 'pickle', which is not among those that are read "
        f"({', '.join(sorted(CODECS))}): store it with one of these"
    )


def test_only_the_array_that_is_read_must_have_known_codecs(values):
    zarr.open_group("g.zarr", mode="w")
    store(values, "g.zarr/a")
    store(values, "g.zarr/b")
    edited("g.zarr/b/zarr.json", PICKLE_AT["codecs"])
    assert np.array_equal(read("g.zarr:/a"), values)
    assert "names the codec 'pickle'" in said_of("g.zarr:/b")


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize("path", ["../a", "a//b", "./a", "c"])
def test_metadata_of_an_image_names_an_array_of_the_store(values, path):
    zarr.open_group("i.zarr", mode="w")
    store(values, "i.zarr/a")
    image = {"multiscales": [{"axes": list("zyx"), "datasets": [{"path": path}]}]}
    edited("i.zarr/zarr.json", lambda about: about["attributes"].update(ome=image))
    assert said_of("i.zarr") == (f"i.zarr is damaged: its metadata names no array at {path!r}")


# Other files


def test_raw_data_of_hdf5_is_read_beside_the_file(values, tmp_path, monkeypatch):
    raw = values.astype("<f4").tobytes()
    Path("deep").mkdir()
    Path("deep/a.raw").write_bytes(raw)
    Path("b.raw").write_bytes(raw)
    for name in ("a.raw", "../b.raw", str(tmp_path / "b.raw")):
        with h5py.File("deep/a.h5", "w") as file:
            about = {"shape": values.shape, "dtype": "<f4"}
            file.create_dataset("d", **about, external=[(name, 0, len(raw))])
        if name == "a.raw":
            assert np.array_equal(read("deep/a.h5"), values)
            continue
        assert said_of("deep/a.h5") == (
            f"deep/a.h5 names the file {seen(name)}, which is not in its folder: put both into one "
            "folder"
        )
    Path("deep/a.raw").unlink()
    os.mkfifo("deep/a.raw")
    with h5py.File("deep/a.h5", "w") as file:
        file.create_dataset("d", **about, external=[("a.raw", 0, len(raw))])
    assert said_of("deep/a.h5").endswith("deep/a.raw is a named pipe: give a file")


def test_coordinates_in_other_files_lie_beside_the_file(values):
    os.mkdir("deep")
    np.arange(float(values.shape[2])).tofile("z.raw")
    with h5py.File("deep/a.h5", "w") as file:
        file["d"] = values.T
        raw = [("../z.raw", 0, 8 * values.shape[2])]
        scale = file.create_dataset("z", (values.shape[2],), "f8", external=raw)
        scale.make_scale("z")
        file["d"].dims[0].attach_scale(scale)
    assert said_of("deep/a.h5") == (
        "deep/a.h5 names the file '../z.raw', which is not in its folder: put both into one folder"
    )


def test_virtual_datasets_are_refused(values):
    with h5py.File("b.h5", "w") as file:
        file["d"] = values
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[:] = h5py.VirtualSource("b.h5", "d", values.shape)
    with h5py.File("a.h5", "w") as file:
        file.create_virtual_dataset("d", layout)
    assert said_of("a.h5") == (
        "a.h5:/d is a virtual dataset, put together of others: save its values as a dataset of "
        "their own"
    )


def test_links_and_pipes_in_a_store(values):
    store(values)
    chunk = Path("a.zarr/c/0/0/0")
    chunk.rename("a.zarr/first")
    chunk.symlink_to(Path("a.zarr/first").resolve())
    assert np.array_equal(read("a.zarr"), values)
    Path("a.zarr/first").rename("elsewhere")
    chunk.unlink()
    chunk.symlink_to(Path("elsewhere").resolve())
    assert said_of("a.zarr") == (
        "a.zarr names the file 'c/0/0/0', which is not in its folder: put both into one folder"
    )
    chunk.unlink()
    os.mkfifo(chunk)
    assert said_of("a.zarr") == "a.zarr/c/0/0/0 is a named pipe: give a file"


def ome_set(values, other):
    """Write an OME-TIFF whose second half of pages is said to be in another file."""
    half = len(values) // 2
    z, y, x = values.shape
    text = (
        '<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="urn:uuid:1">'
        f'<Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYZTC" Type="float" '
        f'SizeX="{x}" SizeY="{y}" SizeZ="{z}" SizeC="1" SizeT="1">'
        '<Channel ID="Channel:0" SamplesPerPixel="1"/>'
        f'<TiffData FirstZ="0" IFD="0" PlaneCount="{half}">'
        '<UUID FileName="a.ome.tif">urn:uuid:1</UUID></TiffData>'
        f'<TiffData FirstZ="{half}" IFD="0" PlaneCount="{z - half}">'
        f'<UUID FileName="{other}">urn:uuid:2</UUID></TiffData></Pixels></Image></OME>'
    )
    about = {"photometric": "minisblack", "metadata": None, "contiguous": False}
    for name, part in (("a.ome.tif", values[:half]), ("b.ome.tif", values[half:])):
        own = text if name == "a.ome.tif" else text.replace("urn:uuid:1", "urn:uuid:2", 1)
        with tifffile.TiffWriter(name) as file:
            for page in part:
                file.write(page, description=own, **about)
                own = None


def test_files_of_an_ome_set_are_read_beside_the_file(values, tmp_path):
    ome_set(values, "b.ome.tif")
    assert np.array_equal(read("a.ome.tif"), values)
    for name in ("../b.ome.tif", str(tmp_path.parent / "b.ome.tif")):
        ome_set(values, name)
        assert said_of("a.ome.tif") == (
            f"a.ome.tif names the file {name!r}, which is not in its folder: put both into one "
            "folder"
        )
    os.mkfifo("pipe.tif")
    ome_set(values, "pipe.tif")
    assert said_of("a.ome.tif").endswith("pipe.tif is a named pipe: give a file")


# Parts that are not stored


LAYOUTS = {
    "2": {"zarr_format": 2},
    "sharded": {"chunks": (4, 4, 4), "shards": (16, 16, 16)},
    "in a shard": {"chunks": (8, 8, 8), "shards": (32, 32, 32)},
}


def partly(values, path, kind, fill):
    """Write the first 24 planes of a grid of 30, and leave out the others."""
    whole = np.where(np.arange(len(values))[:, None, None] < 24, values, values.dtype.type(fill))
    if kind == "hdf5":
        with h5py.File(path, "w") as file:
            about = {"shape": values.shape, "dtype": values.dtype, "chunks": (8, 8, 8)}
            file.create_dataset("d", **about, fillvalue=fill)[:24] = values[:24]
    elif kind == "zip":
        with zarr.storage.ZipStore(path, mode="w") as zipped:
            store(whole, zipped, fill_value=fill)
    else:
        store(whole, path, fill_value=fill, **LAYOUTS[kind])
    return whole


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize("kind", ["hdf5", "2", "zip", "sharded", "in a shard"])
def test_chunks_that_are_not_stored_are_counted(values, kind):
    path = {"hdf5": "a.h5", "zip": "a.zarr.zip"}.get(kind, "a.zarr")
    partly(values, path, kind, 0)
    # the last of 4 layers of chunks of 8, the last two of 8 layers of chunks of 4
    absent, total = (84, 336) if kind == "sharded" else (12, 48)
    assert said_of(path, GridError) == (
        f"{path}: {absent:,} of its {total:,} chunks are not stored and read as 0, which is the "
        "surface: write them all, or give the array a fill value other than 0 (NaN for unknown)"
    )


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize("kind", ["hdf5", "2", "sharded"])
def test_another_fill_value_is_as_good_as_a_stored_one(values, kind):
    path, far = "a.h5" if kind == "hdf5" else "a.zarr", np.float32(9.0)
    narrow = partly(values, path, kind, far)
    assert np.array_equal(read(path, field="exact"), narrow)


def test_a_fill_value_of_nan_is_unknown(values):
    deep = np.where(np.arange(len(values))[:, None, None] < 24, values, np.nan)
    store(deep.astype("f4"), fill_value=np.nan)
    grid = read_grid("a.zarr", spacing=1)
    assert np.isfinite(grid.values).all() and np.array_equal(grid.values.T[:24], values[:24])


def test_background_of_a_mask_need_not_be_stored(values):
    mask = (values < 0).astype(np.uint8)
    store(mask)
    with h5py.File("a.h5", "w") as file:
        file.create_dataset("d", data=mask[:24], chunks=(8, 8, 8), maxshape=(None,) * 3)
        file["d"].resize(mask.shape)
    for path in ("a.zarr", "a.h5"):
        assert (read(path) < 0).sum() == mask.sum()


def test_strips_that_are_not_stored(values):
    tifffile.imwrite("a.tif", values, photometric="minisblack", compression="zlib")
    edit_strip("a.tif", 5, size=0)
    assert said_of("a.tif", GridError).startswith(
        f"a.tif: 1 of its {len(values)} chunks are not stored and read as 0, which is the surface"
    )


def edit_strip(path, page, size, place=None):
    """Change where the only strip of a page is, and how many bytes it takes."""
    raw = bytearray(Path(path).read_bytes())
    with tifffile.TiffFile(path) as file:
        tags = file.pages[page].tags
        struct.pack_into("<I", raw, tags["StripByteCounts"].valueoffset, size)
        if place is not None:
            struct.pack_into("<I", raw, tags["StripOffsets"].valueoffset, place)
    Path(path).write_bytes(raw)


# Damage


def count_silent(path, pieces, read_again):
    """Flip one bit at a time in pieces (offset, size) of a file; count wrong results.

    A result is wrong if nothing is raised and it is not that of the whole file.
    """
    whole, good = Path(path).read_bytes(), read_again()
    places = np.concatenate([np.arange(start, start + size) for start, size in pieces])
    rng, silent, errors = np.random.default_rng(0), 0, 0
    for place in rng.choice(places, FLIPS):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << rng.integers(8)
        Path(path).write_bytes(damaged)
        try:
            silent += not np.array_equal(read_again(), good)
        except SuperSdfError as error:
            errors += 1
            assert str(error).startswith(str(path)) and "\n" not in str(error)
    Path(path).write_bytes(whole)
    assert errors > 0
    return silent


@pytest.mark.parametrize("layout", [{}, {"shards": (16, 16, 16)}])
def test_a_flipped_bit_in_a_zipped_store_is_found(values, in_process, layout):
    with zarr.storage.ZipStore("a.zarr.zip", mode="w") as zipped:
        store(values, zipped, **layout)
    size = Path("a.zarr.zip").stat().st_size
    assert count_silent("a.zarr.zip", [(0, size)], lambda: read("a.zarr.zip")) == 0


@pytest.mark.parametrize("checked", [{"fletcher32": True}, {"compression": "gzip"}])
def test_a_flipped_bit_in_hdf5_with_a_checksum_is_found(values, in_process, checked):
    with h5py.File("a.h5", "w") as file:
        data = file.create_dataset("d", data=values, chunks=(8, 8, 8), **checked)
        chunks = [data.id.get_chunk_info(n) for n in range(data.id.get_num_chunks())]
    pieces = [(chunk.byte_offset, chunk.size) for chunk in chunks]
    assert count_silent("a.h5", pieces, lambda: read("a.h5")) == 0


def test_a_flipped_bit_in_a_packed_tiff_is_found(values, in_process):
    tifffile.imwrite("a.tif", values, photometric="minisblack", compression="zlib")
    with tifffile.TiffFile("a.tif") as file:
        pieces = [(p.dataoffsets[0], p.databytecounts[0]) for p in file.pages]
    assert count_silent("a.tif", pieces, lambda: read("a.tif")) == 0


def test_a_flipped_bit_in_3mf_is_found():
    trimesh.creation.icosphere(1).export("a.3mf")
    size = Path("a.3mf").stat().st_size
    assert count_silent("a.3mf", [(0, size)], lambda: read_mesh("a.3mf").vertices) == 0


# Crashes


@pytest.mark.parametrize(
    "start, said", [("import os; os.abort()", "SIGABRT"), ("raise SystemExit(3)", "exit code 3")]
)
def test_a_library_that_crashes_is_a_line(values, command, monkeypatch, start, said):
    store(values)
    monkeypatch.setattr(apart, "START", start)
    reason = (
        f"a.zarr cannot be read: the library that reads it crashed ({said}); the file is probably "
        "damaged, save it again"
    )
    assert command("upsample", "a.zarr", "a.ply") == (1, "", f"Error: {reason}\n")
    np.save("b.npy", values)
    code, _, err = command("batch", "a.zarr", "b.npy", "--out", "out", "--jobs", "1", *FAST)
    assert code == 1 and reason in err and os.listdir("out/").count("b.ply") == 1


def test_nothing_is_taken_from_the_current_folder(values):
    for name in ("pickle", "h5py", "numpy", "super_sdf"):
        Path(f"{name}.py").write_text("open('marker', 'w').close()")
    with h5py.File("a.h5", "w") as file:
        file["d"] = values
    assert np.array_equal(read("a.h5"), values) and not Path("marker").exists()


# Bombs


def packed_zeros(size):
    """Return zeros that zlib packed a thousand times smaller."""
    packer, piece = zlib.compressobj(1), bytes(1 << 20)
    parts = [packer.compress(piece) for _ in range(size >> 20)]
    return b"".join(parts) + packer.flush()


def make_bomb(name, values):
    """Write a file of the name: kilobytes that unpack to gigabytes, or claim to."""
    huge = {"shape": (1200, 1000, 1000), "dtype": "f4", "chunks": (100, 100, 100)}
    one = {"shape": (900, 900, 900), "dtype": "f4", "chunks": (900, 900, 900)}
    packing = {"photometric": "minisblack", "compression": "zlib"}
    if name == "huge.zarr":
        zarr.create_array(name, **huge, fill_value=1.0)
    elif name == "many.zarr":
        zarr.create_array(name, shape=(300,) * 3, chunks=(1, 1, 1), dtype="f4", fill_value=1.0)
    elif name == "chunk.zarr":
        store(values, name, compressors=zarr.codecs.numcodecs.Zlib())
        Path(name, "c/0/0/0").write_bytes(packed_zeros(BOMB))
    elif name == "one.h5":
        with h5py.File(name, "w") as file:
            file.create_dataset("d", **one, compression="gzip", fillvalue=1.0)
    elif name == "strip.tif":
        tifffile.imwrite(name, values, **packing)
        packed, place = packed_zeros(BOMB), Path(name).stat().st_size
        edit_strip(name, 3, len(packed), place)
        with open(name, "ab") as file:
            file.write(packed)
    elif name == "page.tif":
        tifffile.imwrite(name, values[:3], **packing)
        raw = bytearray(Path(name).read_bytes())
        with tifffile.TiffFile(name) as file:
            for tag in [p.tags[n] for p in file.pages for n in ("ImageWidth", "ImageLength")]:
                struct.pack_into("<I" if tag.dtype == 4 else "<H", raw, tag.valueoffset, 40_000)
        Path(name).write_bytes(raw)


BOMBS = {
    "huge.zarr": "huge.zarr, 1200 x 1000 x 1000 float32, 4,800,000,000 bytes, is compressed to 0 ",
    "one.h5": "one.h5 is stored in chunks of 900 x 900 x 900 samples, 2.92 GB each, and to unpack ",
    "page.tif": "page.tif is stored in planes of 1 x 40000 x 40000 samples, 6.40 GB each, and to ",
    "many.zarr": "many.zarr has 27,000,000 chunks, of which 0 are stored: store it in larger ones",
    "chunk.zarr": r"chunk.zarr unpacks to more than the \d+ MB of memory that are left for it; ",
    "strip.tif": r"strip.tif unpacks to more than the \d+ MB of memory that are left for it; allow",
}


# Prints the peak of a command and of what it starts. Linux counts the memory of the process that
# starts another one to that one's peak, so a small process starts it.
PEAK = """
import os, sys
pid = os.spawnv(os.P_NOWAIT, sys.argv[1], sys.argv[1:])
_, status, used = os.wait4(pid, 0)
print(used.ru_maxrss)
sys.exit(os.waitstatus_to_exitcode(status))
"""


@pytest.mark.parametrize("name", BOMBS)
def test_what_a_file_unpacks_to_is_bounded(values, name):
    """The command says so, and no process of it takes more than the bound."""
    bound = 400_000_000
    make_bomb(name, values)
    assert sum(path.stat().st_size for path in Path().rglob("*")) < 2_000_000
    words = ["upsample", name, "o.ply", "--spacing", "1", "--max-memory", str(bound)]
    done = subprocess.run(
        [sys.executable, "-c", PEAK, sys.executable, "-m", "super_sdf", *words],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1 and re.match(f"Error: {BOMBS[name]}", done.stderr)
    assert done.stderr.count("\n") == 1 and not Path("o.ply").exists()
    assert int(done.stdout) * 1024 < bound


def test_what_a_3mf_unpacks_to_is_bounded():
    with (
        zipfile.ZipFile("a.3mf", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("3D/3dmodel.model", "w") as member,
    ):
        for _ in range(BOMB >> 20):
            member.write(bytes(1 << 20))
    with pytest.raises(OutOfMemoryError, match=r"^a\.3mf unpacks to 403 MB, and to read it takes "):
        read_mesh("a.3mf", max_memory=1_000_000_000)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert peak < 10**9 and threading.active_count() < 50
