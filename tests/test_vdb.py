"""OpenVDB files: those in ``data`` were written by OpenVDB 10.0.1, others here, byte by byte."""

import struct
import uuid
import zlib
from pathlib import Path

import numpy as np
import pytest
from conftest import refusal

from super_sdf import read_grid
from super_sdf.errors import FileError, GridError
from super_sdf.files.grids import open_volume
from super_sdf.files.readers.vdb import ACTIVE_MASK, ZIP

DATA = Path(__file__).parent / "data"


def voxels(path):
    """Return the values of a file, before anything is made of them, and where the first one is."""
    with open_volume(path) as (volume, _):
        return volume.read(), np.array(volume.origin), volume.spacing[0]


def distance(values, origin, spacing, balls):
    """Return the distance to the nearest of some balls (centre, radius) at each sample."""
    places = np.moveaxis(np.indices(values.shape), 0, -1) * spacing + origin
    return np.min([np.linalg.norm(places - centre, axis=-1) - r for centre, r in balls], axis=0)


FAR = [((2048, 0, 0), 3.0), ((2203, 20, 65), 2.5)]
WRITTEN = {
    "far-balls-half": (FAR, -1.5, 1.5, 1e-3),  # 310 voxels apart: in two nodes of the root
    "two-balls": ([((15.5, -11.5, 41.5), 4.2), ((21.5, -11, 42.5), 2.1)], -1.5, 1.5, 1e-5),
    "narrow-inside": ([((27.5,) * 3, 20.0)], -1, 3, 1e-5),  # inactive tiles inside
    "dense": ([((9.5,) * 3, 6.0)], -99, 99, 1e-5),  # by copyFromArray, background 0
    "picogk": ([((1.5, 2.0, 2.5), 3.0)], -1.5, 1.5, 1e-5),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_balls_that_openvdb_wrote_are_at_their_place(name):
    balls, low, high, error = WRITTEN[name]
    values, *place = voxels(DATA / f"{name}.vdb")
    assert np.abs(values - distance(values, *place, balls).clip(low, high)).max() < error
    assert len(values) > 310 or "far" not in name


def test_turned_axes_and_the_unit_of_picogk():
    """A ball of radius 1.5 at (10, 9, 7): i along y, j along -z, k along x."""
    grid = read_grid(DATA / "turned-ball.vdb")
    exact = distance(grid.values, np.array(grid.origin), 0.5, [((10, 9, 7), 1.5)])
    assert np.abs(grid.values - exact.clip(-1.5, 1.5)).max() < 1e-5
    notes = read_grid(DATA / "picogk.vdb").notes
    assert "lengths are in millimetres, as PicoGK states" in notes


def test_a_level_of_distances_is_refused_with_the_offset_that_it_is():
    said = refusal(GridError, read_grid, DATA / "two-balls.vdb", level=0.2, scale=2)
    assert said.endswith("for densities, and the file states distances: give offset=0.4 instead")


def test_a_level_set_that_was_cut_keeps_its_inside():
    """The same, with the background from i = 28 on: half of the ball, and no hollow one."""
    values, origin, spacing = voxels(DATA / "cut.vdb")
    exact = distance(values, origin, spacing, [((27.5,) * 3, 20.0)]).clip(-1, 3)
    exact[int(28 - origin[0]) :] = 3
    np.testing.assert_allclose(values, exact, atol=1e-5)


def test_a_density_keeps_its_tiles_and_is_meshed_at_a_level():
    """40 x 32 x 24 voxels of 1, all but one leaf of them in tiles; a corner of 4^3 is 0.25."""
    grid = read_grid(DATA / "density.vdb", level=0.125)
    solid = np.zeros(grid.shape, bool)
    solid[2:-2, 2:-2, 2:-2] = True
    np.testing.assert_array_equal(grid.values < 0, solid)
    assert grid.shape == (44, 36, 28)


def text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def mask(*on: int, size: int) -> bytes:
    chosen = np.zeros(size, bool)
    chosen[list(on)] = True
    return np.packbits(chosen, bitorder="little").tobytes()


def packed(data: bytes, flags: int) -> bytes:
    """Return numbers as they follow in the file: with their length if the grid is zipped."""
    if not flags & ZIP:
        return data
    short = zlib.compress(data)
    return struct.pack("<q", len(short)) + short


def one_leaf(leaf: bytes, active: bytes, *, flags: int) -> bytes:
    """Return a file whose only leaf begins at voxel 0; its values are ``leaf``, background 3."""
    head = struct.pack("<qIII?", 0x56444220, 224, 10, 0, True)
    head += str(uuid.UUID(int=0)).encode() + struct.pack("<I", 0)
    head += struct.pack("<I", 1) + text("surface") + text("Tree_float_5_4_3") + text("")
    place = len(head) + 24
    grid = struct.pack("<II", flags, 0)  # no metadata
    grid += text("ScaleMap") + struct.pack("<15d", *(0.5,) * 15)
    tree = struct.pack("<IfII", 1, 3.0, 0, 1) + struct.pack("<iii", 0, 0, 0)
    for size in (32**3, 16**3):
        values = b"" if flags & ACTIVE_MASK else np.full(size, 3.0, "<f4").tobytes()
        state = 0 if flags & ACTIVE_MASK else 6
        tree += mask(0, size=size) + mask(size=size) + bytes([state]) + packed(values, flags)
    tree += active
    return head + struct.pack("<qqq", place, 0, 0) + grid + tree + active + leaf


# By the state of a leaf: the values that it states, and those below and above voxel 300.
INACTIVE = [
    ((), (3.0, 3.0)),
    ((), (-3.0, -3.0)),
    ((-2.0,), (-2.0, -2.0)),
    ((), (-3.0, 3.0)),
    ((-2.0,), (-2.0, 3.0)),
    ((-2.0, 1.5), (-2.0, 1.5)),
]


@pytest.mark.parametrize("state", range(6))
def test_inactive_values_as_a_leaf_states_them(tmp_path, state):
    """Voxels 0 to 99 are active, 1 to 100 in value; of the others those from 300 on are masked."""
    numbers, flags = np.arange(1, 101, dtype="<f4"), ACTIVE_MASK | ZIP
    stated, inactive = INACTIVE[state]
    leaf = bytes([state]) + np.array(stated, "<f4").tobytes()
    leaf += mask(*range(300, 512), size=512) if state > 2 else b""
    leaf += packed(numbers.tobytes(), flags)
    data = one_leaf(leaf, mask(*range(100), size=512), flags=flags)
    (tmp_path / "a.vdb").write_bytes(data)
    values, origin, _ = voxels(tmp_path / "a.vdb")
    expected = np.repeat([0.0, *inactive], (100, 200, 212))
    expected[:100] = numbers
    whole = np.full((12, 12, 12), 3.0)  # two voxels of background on each side
    whole[2:-2, 2:-2, 2:-2] = expected.reshape(8, 8, 8)
    held = [slice(int(2 * x + 2), int(2 * x + 2) + n) for x, n in zip(origin, values.shape)]
    np.testing.assert_array_equal(values, whole[tuple(held)])


def said_of(path: Path, content: bytes, kind: type[Exception] = FileError) -> str:
    """Return why a file of this content is refused."""
    path.write_bytes(content)
    return refusal(kind, read_grid, path)


def test_files_that_are_damaged_end_early_or_are_others(tmp_path):
    """Also with a string of 4 GB, or no voxel at all."""
    path, hundred = tmp_path / "a.vdb", mask(*range(100), size=512)
    leaf = bytes([0]) + np.ones(100, "<f4").tobytes()
    whole = one_leaf(leaf, hundred, flags=ACTIVE_MASK)
    damaged = whole.replace(text("surface"), struct.pack("<I", 2**32 - 1) + b"surface")
    assert said_of(path, damaged) == f"{path}: it is truncated or damaged"
    said = said_of(path, one_leaf(b"\0", mask(size=512), flags=ACTIVE_MASK), GridError)
    assert said == f"{path}: it has no active voxel: it holds no surface"
    whole = (DATA / "two-balls.vdb").read_bytes()
    for size in (4, 60, 700, len(whole) - 1):
        assert said_of(path, whole[:size]) == f"{path}: it is truncated or damaged"
    said = said_of(path, whole[:8] + struct.pack("<I", 220) + whole[12:])
    assert said == f"{path}: it is no .vdb file of OpenVDB 3 or later: save it with openvdb.write"


def test_one_of_several_grids_is_named(command):
    path = DATA / "three-grids.vdb"
    said = refusal(FileError, read_grid, path)
    assert said.endswith(f"holds several arrays, density, surface: give {path}:density, say")
    code, out, _ = command("info", path)
    same = "dtype: float32; spacing: 1, 1, 1; origin"
    first = f"{path}:density: shape: 8, 8, 8; {same}: -1, -1, -1"
    assert out.splitlines()[2:] == [first, f"{path}:surface: shape: 15, 15, 15; {same}: -4, -4, -4"]
    assert code == 0
