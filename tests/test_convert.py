"""Conversion of one file: the mesh, the report, and no file after a failure."""

import os

import numpy as np
import pytest
import trimesh
from conftest import ball, trilinear
from test_slabs import in_pieces

import super_sdf.convert
from super_sdf import SdfGrid
from super_sdf.convert import ConvertOptions, convert
from super_sdf.errors import FileError, GridError, MeshError
from super_sdf.surface.mesh import Mesh


class Close:
    """Trilinear interpolation, which says how far it sees."""

    receptive_field = 1
    __call__ = staticmethod(trilinear)


CLOSE = Close()


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


def without_one(faces, first):
    """Leave out a triangle that has one side on the plane between the last two slabs."""
    return np.delete(faces, np.flatnonzero((faces < first).sum(1) == 2)[0], 0)


def with_one_twice(faces, first):
    """Repeat such a triangle."""
    return np.append(faces, faces[(faces < first).sum(1) == 2][:1], 0)


BETWEEN = (
    "1 open edge at plane {1}, between planes {0} to {2} and planes {1} to {3}: run it again, "
)


@pytest.mark.parametrize(
    "cap, end, spoil, want",
    [
        (True, 9, without_one, BETWEEN),
        (False, 16, without_one, BETWEEN),
        (False, 9, with_one_twice, BETWEEN),
        (True, 16, lambda faces, _: faces[:-1], "3 open edges in planes "),
    ],
)
def test_slabs_that_do_not_meet_and_holes_are_errors(monkeypatch, cap, end, spoil, want):
    """Whether the surface ends within the grid, is capped or is left open."""
    values = ball(16, 4.0).values[:, :end]
    np.save("cut.npy", values)
    slabs = in_pieces(SdfGrid(values, 1.0), CLOSE, monkeypatch, 3, factor=2, cap=cap)
    before = sum(slab.counts["vertices"] for slab in slabs[:2])
    mesh = slabs[2].meshes[0]
    slabs[2].meshes[0] = Mesh(mesh.vertices, spoil(mesh.faces, before))
    monkeypatch.setattr(super_sdf.convert, "reconstruct_slabs", lambda *_, **__: iter(slabs))
    with pytest.raises(MeshError) as caught:
        convert("cut.npy", "out.ply", trilinear, ConvertOptions(2, cap=cap))
    assert not os.path.exists("out.ply")
    (first, start), (_, stop) = slabs[1].planes, slabs[2].planes
    said = want.format(first, start, start - 1, stop - 1)
    assert str(caught.value).startswith(f"the mesh is torn, with {said}")


def test_a_failure_writes_nothing_and_a_file_is_replaced_only_by_force():
    np.save("flat.npy", np.ones((4, 4, 4)))
    with pytest.raises(GridError, match=r"^every value is 1: a constant field has no surface$"):
        convert("flat.npy", "out.ply", trilinear, ConvertOptions())
    assert sorted(os.listdir()) == ["flat.npy", "in.npy"]
    convert("in.npy", "out.ply", trilinear, ConvertOptions(2))
    with pytest.raises(FileError, match=r"^out.ply exists: remove it or use --force$"):
        convert("in.npy", "out.ply", trilinear, ConvertOptions(2))
    convert("in.npy", "out.ply", trilinear, ConvertOptions(4), force=True)
