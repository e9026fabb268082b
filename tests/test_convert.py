"""Conversion of one file: the mesh, the report, and no file after a failure."""

import os
import re

import numpy as np
import pytest
import trimesh
from conftest import ball, trilinear

from super_sdf.convert import ConvertOptions, convert
from super_sdf.errors import FileError, GridError, WriteError
from super_sdf.files import meshes
from super_sdf.files.meshes import MESH_SUFFIXES


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("in.npy", ball(16, 4.0).values)


def test_options_take_effect_and_the_result_is_reported():
    np.save("in.npy", -2 * ball(16, 4.0).values)
    options = ConvertOptions(
        2, spacing=(2.0,), origin=(1.0, 2.0, 3.0), inside="positive", offset=2.0
    )
    steps = []
    done = convert("in.npy", "out.ply", trilinear, options, progress=lambda *s: steps.append(s))
    grid, mesh = done.grid, trimesh.load("out.ply")
    assert (grid.shape, grid.spacing, grid.origin) == ((16,) * 3, (2.0,) * 3, (1.0, 2.0, 3.0))
    assert done.notes == () and done.warnings == () and done.closed
    counts = len(mesh.vertices), len(mesh.faces)
    assert counts == (done.counts["vertices"], done.counts["triangles"])
    np.testing.assert_allclose(done.report()["bounds"], mesh.bounds)
    assert mesh.extents == pytest.approx([20] * 3, rel=0.02)
    assert mesh.bounds.mean(0) == pytest.approx(np.array([1, 2, 3]) + 2 * 7.63, abs=0.2)
    assert list(done.seconds) == ["read", "band", "network", "nodes", "isosurface", "write"]
    assert steps == [(30, 1000), (480, 1000), (630, 1000), (1000, 1000)]


def test_a_failure_writes_nothing_and_a_file_is_replaced_only_by_force():
    np.save("flat.npy", np.ones((4, 4, 4)))
    with pytest.raises(GridError, match=r"^every value is 1: a constant field has no surface$"):
        convert("flat.npy", "out.ply", trilinear, ConvertOptions())
    assert sorted(os.listdir()) == ["flat.npy", "in.npy"]
    convert("in.npy", "out.ply", trilinear, ConvertOptions(2))
    with pytest.raises(FileError, match=r"^out.ply exists: remove it or use --force$"):
        convert("in.npy", "out.ply", trilinear, ConvertOptions(2))
    convert("in.npy", "out.ply", trilinear, ConvertOptions(4), force=True)


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
def test_the_size_of_the_file_is_estimated(suffix):
    cap = suffix in (".ply", ".stl")
    x, y, z = np.indices((24,) * 3) * 0.5
    gyroid = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
    np.save("gyroid.npy", gyroid.astype(np.float32))
    options = ConvertOptions(2, spacing=(1.0,), cap=cap)
    report = convert("gyroid.npy", f"out{suffix}", trilinear, options).report()
    near = pytest.approx(report["triangles"], rel=0.1 if cap else 0.08)
    assert report["expected_triangles"] == near
    size = os.path.getsize(f"out{suffix}")
    assert report["expected_bytes"] == pytest.approx(size, rel=0.35)


def test_a_large_file_is_announced_before_the_work(monkeypatch):
    announced = []

    def work(*_):
        assert announced == ["new.ply will have about 2,500 triangles, 47,424 bytes"]
        raise MemoryError

    convert("in.npy", "out.ply", trilinear, ConvertOptions(2), announce=announced.append)
    assert announced == []
    monkeypatch.setattr(meshes, "LARGE", 40_000)
    with pytest.raises(MemoryError):
        convert("in.npy", "new.ply", work, ConvertOptions(2), announce=announced.append)


def test_a_file_that_its_disk_cannot_hold_is_refused_before_the_work(monkeypatch):
    monkeypatch.setattr(meshes, "free_space", lambda path: 2e6)
    convert("in.npy", "out.ply", trilinear, ConvertOptions(4))
    monkeypatch.setattr(meshes, "free_space", lambda path: 1000)
    want = (
        "big.ply cannot be written: about 10,000 triangles take 189,696 bytes, 1,000 bytes are "
        "free there; use a smaller factor, or another folder"
    )
    with pytest.raises(WriteError, match=re.escape(want)):
        convert("in.npy", "big.ply", None, ConvertOptions(4))
    assert sorted(os.listdir()) == ["in.npy", "out.ply"]
