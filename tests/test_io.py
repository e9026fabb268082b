"""Files in, files out: every kind of array, every format, nothing half-written."""

import os

import numpy as np
import pytest
import trimesh
from conftest import ball, trilinear

from super_sdf import Mesh, SdfGrid, io, ply, read_grid, reconstruct, write_mesh
from super_sdf.errors import FileError, GridError, OptionError
from super_sdf.io import check_target


@pytest.fixture
def mesh():
    return reconstruct(ball(14, 4.0), trilinear, 2)


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


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj", ".off", ".glb", ".3mf"])
def test_formats_come_back_the_same(tmp_path, mesh, suffix):
    write_mesh(mesh, tmp_path / f"out{suffix}")
    back = trimesh.load(tmp_path / f"out{suffix}", force="mesh")
    assert back.is_watertight and back.is_winding_consistent
    assert back.volume == pytest.approx(mesh.volume(), rel=1e-5)
    np.testing.assert_allclose(back.bounds[0], mesh.vertices.min(0), atol=1e-5)


def test_ply_holds_the_very_numbers(tmp_path, mesh, monkeypatch):
    monkeypatch.setattr("super_sdf.ply.CHUNK", 1000)
    for dtype in (np.float32, np.float64):
        exact = Mesh(mesh.vertices.astype(dtype), mesh.faces)
        write_mesh(exact, tmp_path / "out.ply", force=True)
        back = trimesh.load(tmp_path / "out.ply", process=False)
        np.testing.assert_array_equal(back.vertices.astype(dtype), exact.vertices)
        np.testing.assert_array_equal(back.faces, mesh.faces)


def test_a_failed_write_leaves_what_was_there(tmp_path, mesh, monkeypatch):
    target = tmp_path / "out.ply"
    target.write_text("before")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("super_sdf.io.write_ply", fail)
    with pytest.raises(FileError, match=r"out\.ply cannot be written: No space left on device"):
        write_mesh(mesh, target, force=True)
    assert target.read_text() == "before" and os.listdir(tmp_path) == ["out.ply"]


def test_3mf_without_its_packages_is_refused_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr("super_sdf.io.find_spec", lambda name: None)
    with pytest.raises(FileError) as caught:
        check_target(tmp_path / "out.3mf")
    want = "writing .3mf needs lxml and networkx: pip install 'super-sdf[3mf]'"
    assert str(caught.value) == want


def test_only_known_formats_and_free_places_are_written(tmp_path, mesh):
    with pytest.raises(OptionError, match=r"give one of \.ply, \.stl, \.obj, \.off, \.glb, \.3mf"):
        write_mesh(mesh, tmp_path / "out.xyz")
    write_mesh(mesh, tmp_path / "out.ply")
    with pytest.raises(FileError, match="exists: remove it or use --force"):
        write_mesh(mesh, tmp_path / "out.ply")


@pytest.mark.parametrize("suffix", [".ply", ".stl"])
def test_a_mesh_in_pieces_makes_the_same_file(mesh, tmp_path, monkeypatch, suffix):
    monkeypatch.setattr(ply, "SPOOL_BYTES", 1000)  # triangles go to a file beside
    half, some = len(mesh.vertices) // 2, len(mesh.faces) // 3
    pieces = [
        Mesh(mesh.vertices[:half], mesh.faces[:0]),
        Mesh(mesh.vertices[half:], mesh.faces[:some]),
        Mesh(mesh.vertices[:0], mesh.faces[some:]),
    ]
    one, other = tmp_path / f"one{suffix}", tmp_path / f"other{suffix}"
    write_mesh(mesh, one)
    io.write_pieces(iter(pieces), other)
    assert one.read_bytes() == other.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == [one.name, other.name]


def test_pieces_that_end_in_an_error_leave_nothing(mesh, tmp_path):
    def pieces():
        yield mesh
        raise GridError("no surface")

    with pytest.raises(GridError):
        io.write_pieces(pieces(), tmp_path / "out.ply")
    assert not list(tmp_path.iterdir())


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
