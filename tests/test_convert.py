"""Conversion of one file: options, the report, and two files that appear together."""

import os

import numpy as np
import pytest
import trimesh
from conftest import ball, trilinear

from super_sdf.convert import convert
from super_sdf.errors import GridError
from super_sdf.options import Options


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("in.npy", ball(16, 4.0).values)


def test_options_take_effect_and_the_result_is_reported():
    np.save("in.npy", -2 * ball(16, 4.0).values)
    options = Options(2, spacing=2.0, origin=(1.0, 2.0, 3.0), inside="positive", offset=2.0)
    steps = []
    done = convert("in.npy", "out.ply", trilinear, options, progress=lambda *s: steps.append(s))
    grid, mesh = done.grid, trimesh.load("out.ply")
    assert (grid.shape, grid.spacing, grid.origin) == ((16,) * 3, (2.0,) * 3, (1.0, 2.0, 3.0))
    assert done.notes == () and done.warnings == () and done.closed
    counts = len(mesh.vertices), len(mesh.faces)
    assert counts == (done.counts["vertices"], done.counts["triangles"])
    assert counts == (len(done.mesh.vertices), len(done.mesh.faces))
    np.testing.assert_allclose(done.report()["bounds"], mesh.bounds)
    assert mesh.extents == pytest.approx([20] * 3, rel=0.02)
    assert mesh.bounds.mean(0) == pytest.approx(np.array([1, 2, 3]) + 2 * 7.63, abs=0.2)
    assert list(done.seconds) == ["read", "band", "network", "nodes", "isosurface", "write"]
    assert steps == sorted(steps) and steps[-1] == (1000, 1000)


def test_mesh_and_field_appear_together_or_not_at_all(monkeypatch):
    def refuse(path, *, force):
        raise GridError("no")

    told = {"save_field": "out.npz"}
    with monkeypatch.context() as patch, pytest.raises(GridError):
        patch.setattr("super_sdf.convert.check_free", refuse)  # when both are complete
        convert("in.npy", "out.ply", trilinear, Options(2), **told)
    assert os.listdir() == ["in.npy"]
    done = convert("in.npy", "out.ply", trilinear, Options(2), **told)
    assert sorted(os.listdir()) == ["in.npy", "out.npz", "out.ply"]
    assert done.saved_field["shape"] == [33, 33, 33]
