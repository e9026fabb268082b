"""Grids from files: every kind of array, mapped or not."""

import numpy as np
import pytest
from conftest import ball, trilinear

from super_sdf import SdfGrid, read_grid, reconstruct


@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8", ">f8", "f2", "i2", ">i4", "i8", "i1"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_every_dtype_and_order_is_read(tmp_path, dtype, order):
    values = np.clip(ball().values * 8, -120, 120).astype(dtype)
    np.save(tmp_path / "in.npy", np.asarray(values, order=order))
    grid = read_grid(tmp_path / "in.npy", spacing=8)
    np.testing.assert_array_equal(grid.values, values)
    field = reconstruct(grid, trilinear)
    assert field.vertices.max() < 8 * 16


def test_npz_keys_and_options_that_go_before_them(tmp_path):
    grid = ball()
    np.savez(tmp_path / "in.npz", values=grid.values, spacing=1.0, origin=[1, 2, 3])
    assert read_grid(tmp_path / "in.npz").origin == (1.0, 2.0, 3.0)
    assert read_grid(tmp_path / "in.npz").notes == ()
    other = read_grid(tmp_path / "in.npz", origin=(4, 5, 6), spacing=1.01)
    assert other.origin == (4.0, 5.0, 6.0) and other.spacing == (1.01,) * 3


def test_npy_is_mapped_not_loaded(tmp_path):
    np.save(tmp_path / "in.npy", ball().values)
    assert isinstance(read_grid(tmp_path / "in.npy").values, np.memmap)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<i2"])
def test_a_mapped_file_is_read_as_the_array_is(tmp_path, dtype, order):
    values = np.asarray(np.round(100 * ball(14, 4.0).values), dtype, order=order)
    np.save(tmp_path / "in.npy", values)
    grid = read_grid(tmp_path / "in.npy", spacing=100)
    assert isinstance(grid.samples, np.memmap)
    mapped, loaded = (reconstruct(g, trilinear) for g in (grid, SdfGrid(values, 100)))
    np.testing.assert_array_equal(mapped.vertices, loaded.vertices)
    np.testing.assert_array_equal(mapped.faces, loaded.faces)
