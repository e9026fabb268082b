"""Meshes to files: every format, nothing half-written."""

import os

import numpy as np
import pytest
import trimesh
from conftest import ball, trilinear

from super_sdf import Mesh, reconstruct, write_mesh
from super_sdf.errors import FileError, GridError, OptionError
from super_sdf.files import ply
from super_sdf.files.meshes import check_target, write_pieces


@pytest.fixture
def mesh():
    return reconstruct(ball(14, 4.0), trilinear, 2)


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj", ".off", ".glb", ".3mf"])
def test_formats_come_back_the_same(tmp_path, mesh, suffix):
    write_mesh(mesh, tmp_path / f"out{suffix}")
    back = trimesh.load(tmp_path / f"out{suffix}", force="mesh")
    assert back.is_watertight and back.is_winding_consistent
    assert back.volume == pytest.approx(mesh.volume(), rel=1e-5)
    np.testing.assert_allclose(back.bounds[0], mesh.vertices.min(0), atol=1e-5)


def test_ply_holds_the_very_numbers(tmp_path, mesh, monkeypatch):
    monkeypatch.setattr("super_sdf.files.ply.CHUNK", 1000)
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

    monkeypatch.setattr("super_sdf.files.meshes.write_ply", fail)
    with pytest.raises(FileError, match=r"out\.ply cannot be written: No space left on device"):
        write_mesh(mesh, target, force=True)
    assert target.read_text() == "before" and os.listdir(tmp_path) == ["out.ply"]


def test_3mf_without_its_packages_is_refused_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr("super_sdf.extras.find_spec", lambda name: None)
    with pytest.raises(FileError) as caught:
        check_target(tmp_path / "out.3mf")
    want = "writing .3mf needs lxml, networkx: pip install -e '.[3mf]' in a clone of super-sdf"
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
    write_pieces(iter(pieces), other)
    assert one.read_bytes() == other.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == [one.name, other.name]


def test_pieces_that_end_in_an_error_leave_nothing(mesh, tmp_path):
    def pieces():
        yield mesh
        raise GridError("no surface")

    with pytest.raises(GridError):
        write_pieces(pieces(), tmp_path / "out.ply")
    assert not list(tmp_path.iterdir())
