"""Grids from files: every kind of array, mapped or not."""

from zipfile import ZIP_BZIP2, ZipFile

import numpy as np
import pytest
from conftest import ball, trilinear

from super_sdf import SdfGrid, read_grid, reconstruct
from super_sdf.errors import FileError
from super_sdf.grid.planes import PlaneFile


@pytest.mark.parametrize("dtype", [">f4", "<f8", "f2", ">i4", "i8", "i1"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_every_dtype_and_order_is_read(tmp_path, dtype, order):
    values = np.clip(ball().values * 8, -120, 120).astype(dtype)
    np.save(tmp_path / "in.npy", np.asarray(values, order=order))
    np.testing.assert_array_equal(read_grid(tmp_path / "in.npy", spacing=8).values, values)


def test_options_go_before_the_keys_of_an_npz(tmp_path):
    np.savez(tmp_path / "in.npz", values=ball().values, spacing=1.0, origin=[1, 2, 3])
    grid = read_grid(tmp_path / "in.npz")
    assert grid.origin == (1.0, 2.0, 3.0) and grid.notes == ()
    other = read_grid(tmp_path / "in.npz", origin=(4, 5, 6), spacing=1.01)
    assert other.origin == (4.0, 5.0, 6.0) and other.spacing == (1.01,) * 3


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("save", [np.save, np.savez_compressed])
@pytest.mark.parametrize("room", [0.0, 0.25])
def test_a_file_is_read_as_the_array_is(tmp_path, monkeypatch, order, save, room):
    """In place, unpacked in memory, and unpacked into a temporary file."""
    values = np.asarray(np.round(100 * ball(shape=(14, 12, 17), radius=4.0).values), ">f8", order)
    path = tmp_path / ("in.npy" if save is np.save else "in.npz")
    save(path, **{"arr" if save is np.save else "values": values})
    monkeypatch.setattr("super_sdf.files.grids.ROOM_SHARE", room)
    monkeypatch.setattr("super_sdf.files.unpacking.PIECE", 3000)
    grid = read_grid(path, spacing=100)
    in_place = save is np.save and order == "C"
    assert isinstance(grid.samples, PlaneFile) == (in_place or not room)
    np.testing.assert_array_equal(grid.planes(2, 5), values[2:5])
    read, given = (reconstruct(g, trilinear, 2) for g in (grid, SdfGrid(values, 100)))
    np.testing.assert_array_equal(read.vertices, given.vertices)
    np.testing.assert_array_equal(read.faces, given.faces)
    if isinstance(grid.samples, PlaneFile):  # read plane by plane
        assert "loaded" not in vars(grid.samples)
    np.testing.assert_array_equal(grid.values, values)


def test_members_packed_with_bzip2_are_read_and_checked(tmp_path):
    np.savez(tmp_path / "in.npz", values=ball().values, spacing=1.0)
    path = tmp_path / "bz2.npz"
    with ZipFile(tmp_path / "in.npz") as plain, ZipFile(path, "w", ZIP_BZIP2) as packed:
        for name in plain.namelist():
            packed.writestr(name, plain.read(name))
    np.testing.assert_array_equal(read_grid(path).values, ball().values)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(FileError, match=r"is damaged|cannot be read"):
        read_grid(path)
