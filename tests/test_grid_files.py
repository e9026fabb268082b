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
