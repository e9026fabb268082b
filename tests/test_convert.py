"""Conversion of one file: the mesh, the report, and no file after a failure."""

import os

import numpy as np
import pytest
import trimesh
from conftest import ball, trilinear

from super_sdf.convert import ConvertOptions, convert
from super_sdf.errors import FileError, GridError


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
