"""One file to another: what is written, what is told, and nothing where it fails."""

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


def test_the_options_reach_the_mesh_and_the_findings_the_caller():
    np.save("in.npy", -2 * ball(16, 4.0).values)
    options = ConvertOptions(2, (2.0,), (1.0, 2.0, 3.0), "positive", 2.0)
    done = convert("in.npy", "out.ply", trilinear, options)
    assert (done.shape, done.spacing, done.origin) == ((16,) * 3, (2.0,) * 3, (1.0, 2.0, 3.0))
    assert done.notes == () and done.warnings == () and done.closed
    mesh = trimesh.load("out.ply")
    counts = len(mesh.vertices), len(mesh.faces)
    assert counts == (done.counts["vertices"], done.counts["triangles"])
    assert mesh.extents == pytest.approx([20] * 3, rel=0.02)
    assert mesh.bounds.mean(0) == pytest.approx(np.array([1, 2, 3]) + 2 * 7.63, abs=0.2)


def test_stages_are_timed_and_steps_told():
    steps = []
    done = convert(
        "in.npy", "out.ply", trilinear, ConvertOptions(2), progress=lambda *s: steps.append(s)
    )
    assert list(done.seconds) == ["read", "band", "network", "nodes", "isosurface", "write"]
    assert steps == [(20, 1000), (800, 1000), (900, 1000), (1000, 1000)]


@pytest.mark.parametrize("cap", [False, True])
def test_closed_is_what_the_mesh_is(cap):
    np.save("cut.npy", ball(16, 4.0).values[:9])
    done = convert("cut.npy", "out.ply", trilinear, ConvertOptions(2, cap=cap))
    assert done.closed == cap == trimesh.load("out.ply").is_watertight
    assert len(done.warnings) == (not cap)


def test_a_failure_writes_nothing_and_a_file_is_replaced_only_by_force():
    np.save("flat.npy", np.ones((4, 4, 4)))
    with pytest.raises(GridError, match=r"^every value is 1: a constant field has no surface$"):
        convert("flat.npy", "out.ply", trilinear, ConvertOptions())
    assert sorted(os.listdir()) == ["flat.npy", "in.npy"]
    convert("in.npy", "out.ply", trilinear, ConvertOptions(2))
    with pytest.raises(FileError, match=r"^out.ply exists: remove it or use --force$"):
        convert("in.npy", "out.ply", trilinear, ConvertOptions(2))
    convert("in.npy", "out.ply", trilinear, ConvertOptions(4), force=True)
