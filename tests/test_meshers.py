"""The choice of a mesher: names, and the same mesh for any threads."""

import json
from pathlib import Path

import numpy as np
import pytest
from batches import rows

from super_sdf import SdfGrid, extract_mesh, load_network, make_grid, reconstruct, upsample
from super_sdf import threads as resources
from super_sdf.surface.extract import extract


@pytest.fixture(scope="module")
def network():
    return load_network("fast", threads=1)


def bar(shape=(44, 13, 12), half=(18.3, 2.8, 2.3)):
    """The distance to a square bar, tilted and rolled, whose edges cross many planes; spacing 1."""
    tilt, roll = np.array([[1, 0.08, 0], [-0.08, 1, 0], [0, 0, 1]]), 0.5
    cosine, sine = np.cos(roll), np.sin(roll)
    turn = np.array([[1, 0, 0], [0, cosine, sine], [0, -sine, cosine]]) @ tilt
    ijk = np.indices(shape).reshape(3, -1) - (np.array(shape)[:, None] / 2 + 0.13)
    beyond = np.abs(turn @ ijk / np.hypot(1, 0.04)) - np.array(half)[:, None]
    distance = np.linalg.norm(np.maximum(beyond, 0), axis=0) + np.minimum(beyond.max(0), 0)
    return distance.reshape(shape)


def assert_same(one, other):
    np.testing.assert_array_equal(one.vertices, other.vertices)
    np.testing.assert_array_equal(one.faces, other.faces)


FIELDS = {
    "bar": bar(),
    "bar that leaves the grid": bar()[6:38, :8],
}


def test_each_name_gives_its_mesh(network):
    grid = SdfGrid.trusted(FIELDS["bar"], 1.0)
    field = upsample(grid, network, 2)
    plain, sharp = (extract_mesh(field, grid, mesher=name) for name in ("marching", "sharp"))
    assert len(sharp.vertices) > len(plain.vertices)
    for name, mesh in {"marching": plain, "sharp": sharp, "auto": sharp}.items():
        assert_same(mesh, reconstruct(grid, network, 2, mesher=name))
        assert_same(mesh, extract_mesh(field, grid, mesher=name))


@pytest.mark.parametrize("kind", ["mask", "noisy", "truncated"])
def test_by_itself_it_is_sharp_where_samples_are_exact(kind, network):
    values = FIELDS["bar"] < 0 if kind == "mask" else np.clip(FIELDS["bar"], -3, 3)
    grid = make_grid(
        values, spacing=1.0, field=kind, inside="positive" if kind == "mask" else "auto"
    )
    plain, sharp, auto = (
        reconstruct(grid, network, 2, mesher=name) for name in ("marching", "sharp", "auto")
    )
    assert_same(auto, sharp if kind == "truncated" else plain)
    assert (len(sharp.vertices) > len(plain.vertices)) == (kind == "truncated")


def test_edges_that_a_mask_cannot_show_are_a_note(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    np.save("mask.npy", FIELDS["bar"] < 0)
    words = ("--spacing", 1, "--inside", "positive", "--factor", 2, "--force")
    note = "Note: mask values show no edges: the mesh is that of marching cubes\n"
    for name, count in {"auto": 0, "marching": 0, "sharp": 1}.items():
        code, _, err = command("upsample", "mask.npy", "a.ply", "--mesher", name, *words)
        assert code == 0 and err.count(note) == count


def test_threads_change_nothing(network, monkeypatch):
    grid = SdfGrid.trusted(FIELDS["bar that leaves the grid"], 1.0)
    field = upsample(grid, network, 2)
    one, keys = extract(field, grid, mesher="sharp", cap=True)
    monkeypatch.setattr(resources, "CHUNK", 5000)
    monkeypatch.setattr(resources, "MIN_PER_THREAD", 1000)
    more, same = extract(field, grid, mesher="sharp", cap=True, threads=3)
    assert_same(more, one)
    np.testing.assert_array_equal(keys, same)
    assert len(np.unique(keys)) == len(keys)


def test_the_command_takes_a_mesher_and_says_which(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    np.save("in.npy", FIELDS["bar"])
    words = ("--spacing", 1, "--quality", "fast", "--factor", 2, "--json", "--quiet")
    asked = {"auto": (), "sharp": ("--mesher", "sharp"), "marching": ("--mesher", "marching")}
    for name, option in asked.items():
        code, out, _ = command("upsample", "in.npy", f"{name}.ply", *option, *words)
        assert code == 0 and json.loads(out)["asked"]["mesher"] == name
    sizes = [Path(f"{name}.ply").stat().st_size for name in asked]
    assert sizes[0] == sizes[1] > sizes[2]
    code, out, err = command("upsample", "in.npy", "x.ply", "--mesher", "dual", *words)
    assert code == 2 and not Path("x.ply").exists()
    assert err.endswith("'--mesher': 'dual' is not one of 'auto', 'marching', 'sharp'.\n")


@pytest.mark.usefixtures("grid_folder")
def test_a_batch_with_another_mesher_is_made_again(run_batch):
    run_batch("in/a.npy", "--mesher", "marching")
    assert "nothing to do" in run_batch("in/a.npy", "--mesher", "marching")[2]
    assert "nothing to do" not in run_batch("in/a.npy", "--mesher", "sharp")[2]
    assert "nothing to do" in run_batch("in/a.npy", "--mesher", "sharp")[2]
    Path("list.jsonl").write_text('{"in": "in/a.npy", "out": "a.ply", "mesher": "marching"}')
    assert "nothing to do" not in run_batch("list.jsonl", "--mesher", "sharp")[2]
    assert [row["asked"]["mesher"] for row in rows()] == ["marching", "sharp", "marching"]
