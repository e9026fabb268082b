"""The choice of a mesher: names, and the same mesh for any slabs, groups, threads and memory."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from batches import rows
from corpus.random_fields import facets
from hypothesis import given, settings
from hypothesis import strategies as st
from test_slabs import assert_same, in_pieces, joined, rod

from super_sdf import SdfGrid, extract_mesh, load_network, options, reconstruct, upsample
from super_sdf.machine import resources
from super_sdf.mesh import join_meshes
from super_sdf.slabs import cutting
from super_sdf.steps import meshers
from super_sdf.steps.marching import extract_pieces
from super_sdf.steps.sharp import mesher as sharp


@pytest.fixture(scope="module")
def network():
    return load_network("fast", threads=1)


def bar(shape=(56, 16, 14), half=(24.3, 3.2, 2.6)):
    """The distance to a square bar, tilted and rolled, whose edges cross many planes; spacing 1."""
    tilt, roll = np.array([[1, 0.08, 0], [-0.08, 1, 0], [0, 0, 1]]), 0.5
    cosine, sine = np.cos(roll), np.sin(roll)
    turn = np.array([[1, 0, 0], [0, cosine, sine], [0, -sine, cosine]]) @ tilt
    ijk = np.indices(shape).reshape(3, -1) - (np.array(shape)[:, None] / 2 + 0.13)
    beyond = np.abs(turn @ ijk / np.hypot(1, 0.04)) - np.array(half)[:, None]
    distance = np.linalg.norm(np.maximum(beyond, 0), axis=0) + np.minimum(beyond.max(0), 0)
    return distance.reshape(shape)


FIELDS = {
    "bar": bar(),
    "bar that leaves the grid": bar()[6:50, :10],
    "rod": rod()[:40],
}


def test_each_name_gives_its_mesh(network):
    grid = SdfGrid.trusted(FIELDS["bar"], 1.0)
    field = upsample(grid, network)
    plain, sharp = (extract_mesh(field, grid, mesher=name) for name in ("marching", "sharp"))
    assert_same(plain, join_meshes(extract_pieces(field, grid)))
    assert len(sharp.vertices) > len(plain.vertices)
    assert_same(sharp, reconstruct(grid, network, mesher="sharp"))
    assert_same(plain, reconstruct(grid, network, mesher="marching"))


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("factor, cap", [(2, True), (4, False), (8, True)])
def test_slabs_change_nothing(network, monkeypatch, name, factor, cap):
    grid = SdfGrid.trusted(FIELDS[name], 1.0)
    options = {"factor": factor, "cap": cap, "mesher": "sharp"}
    (whole,) = in_pieces(grid, network, monkeypatch, 1, **options)
    one = joined([whole])
    for pieces in (3, 20 if factor < 8 else 8):
        parts = in_pieces(grid, network, monkeypatch, pieces, **options)
        assert len(parts) > 1
        assert_same(joined(parts), one)
        assert sum(part.counts["vertices"] for part in parts) == whole.counts["vertices"]


@settings(max_examples=6)
@given(st.integers(0, 10**6), st.integers(2, 30), st.booleans())
def test_slabs_change_nothing_on_random_facets(network, seed, pieces, cap):
    values = facets(np.random.default_rng(seed), (36, 9, 8))
    values.flat[0], values.flat[-1] = 1, -1
    grid = SdfGrid.trusted(values, 1.0)
    options = {"factor": 2, "cap": cap, "mesher": "sharp"}
    with pytest.MonkeyPatch.context() as patch:
        (whole,) = in_pieces(grid, network, patch, 1, **options)
        parts = in_pieces(grid, network, patch, pieces, **options)
    assert_same(joined(parts), joined([whole]))


def test_slabs_need_all_the_planes_that_the_mesher_names(network, monkeypatch):
    """With fewer final planes the mesh differs, so the tests above can fail."""
    grid = SdfGrid.trusted(FIELDS["bar"], 1.0)
    one = reconstruct(grid, network, mesher="sharp")
    few = replace(meshers.BY_NAME["sharp"], planes_beside=lambda factor: 1)
    monkeypatch.setitem(meshers.BY_NAME, "sharp", few)
    monkeypatch.setattr(cutting, "REACH_IN_VOXELS", 1)
    mesh = joined(in_pieces(grid, network, monkeypatch, 4, mesher="sharp"))
    assert not np.array_equal(mesh.vertices, one.vertices)


@pytest.mark.parametrize("factor", [2, 4])
def test_groups_and_threads_change_nothing(network, monkeypatch, factor):
    grid = SdfGrid.trusted(FIELDS["bar that leaves the grid"], 1.0)
    field = upsample(grid, network, factor)
    mesher = meshers.BY_NAME["sharp"]
    one = join_meshes(mesher.extract(field, grid, 7, 1))
    monkeypatch.setattr(resources, "CHUNK", 5000)
    monkeypatch.setattr(resources, "MIN_PER_THREAD", 1000)
    for groups, number in ((1, 2), (4, 1), (9, 3)):
        size = sum(sharp.voxel_bytes(factor)) * len(field.voxel_ijk)
        monkeypatch.setattr(sharp, "GROUP_BYTES", size // groups)
        pieces = mesher.extract(field, grid, 7, number)
        assert len(pieces) > 1 or groups == 1
        assert_same(join_meshes(pieces), one)


def test_the_command_takes_a_mesher_and_says_which(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    np.save("in.npy", FIELDS["bar"])
    words = ("--spacing", 1, "--quality", "fast", "--json", "--quiet")
    code, out, _ = command("upsample", "in.npy", "sharp.ply", "--mesher", "sharp", *words)
    assert code == 0 and json.loads(out)["mesher"] == "sharp"
    code, out, _ = command("upsample", "in.npy", "plain.ply", *words)
    assert code == 0 and json.loads(out)["mesher"] == options.DEFAULT_MESHER
    sizes = [Path(name).stat().st_size for name in ("sharp.ply", "plain.ply")]
    assert sizes[0] > sizes[1]
    code, out, err = command("upsample", "in.npy", "x.ply", "--mesher", "dual", *words)
    assert code == 2 and not Path("x.ply").exists()
    assert err.endswith("'--mesher': 'dual' is not one of 'marching', 'sharp'.\n")


@pytest.mark.usefixtures("grid_folder")
def test_a_batch_with_another_mesher_is_made_again(run_batch):
    run_batch("in/a.npy")
    assert "nothing to do" in run_batch("in/a.npy", "--mesher", "marching")[2]
    assert "nothing to do" not in run_batch("in/a.npy", "--mesher", "sharp")[2]
    assert "nothing to do" in run_batch("in/a.npy", "--mesher", "sharp")[2]
    Path("list.jsonl").write_text('{"in": "in/a.npy", "out": "a.ply", "mesher": "marching"}')
    assert "nothing to do" not in run_batch("list.jsonl", "--mesher", "sharp")[2]
    assert [row["mesher"] for row in rows()] == ["marching", "sharp", "marching"]
