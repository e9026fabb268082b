"""The certificate of a mesh, on surfaces whose residuals have closed forms."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from solids import cube, inverted, joined, saved

from super_sdf import Mesh, SdfGrid, check
from super_sdf.check import check_mesh

H = 1 / 24  # of the grids
RADIUS = 0.4
NO_EVIDENCE = "no sample is exact, so no limit on residuals can be shown to be kept"


def sphere_values() -> np.ndarray:
    axis = np.arange(-0.6, 0.6 + H / 2, H)
    return np.sqrt(sum(x**2 for x in np.meshgrid(axis, axis, axis, indexing="ij"))) - RADIUS


def grid_of(values: np.ndarray) -> SdfGrid:
    return SdfGrid.trusted(values.astype(np.float32), H, (-0.6,) * 3)


def round_mesh(radius: float = RADIUS, subdivisions: int = 5) -> Mesh:
    """Return a fine sphere with vertices on it: triangles are at most 1e-4 voxels inside."""
    found = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Mesh(np.array(found.vertices), np.array(found.faces, np.int32))


GRID, BALL = grid_of(sphere_values()), round_mesh()


def moved(mesh: Mesh, x: float) -> Mesh:
    return Mesh(mesh.vertices + np.array([x, 0, 0]), mesh.faces)


def test_a_sphere_touches_the_balls_of_its_own_grid_also_inside_out():
    found = check_mesh(BALL, GRID)
    figures = found.figures()
    assert len(found.values) > 3000 and found.samples["noisy"] == 0
    assert figures["largest"] < 0.005 and figures["share_above_tenth"] == 0
    assert found.faults() == []
    assert found.surface.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=1e-3)
    assert found.surface.area == pytest.approx(4 * np.pi * RADIUS**2, rel=1e-3)
    assert (found.surface.components, found.surface.self_intersections) == (1, 0)
    found = check_mesh(inverted(BALL), GRID)
    assert found.figures()["largest"] < 0.005  # its triangles are where they should be
    assert not found.surface.report()["oriented"] and found.surface.volume < 0
    assert found.wrong_side[found.values < -0.1].all()
    assert "triangles that face inward" in found.faults()


def test_a_shift_is_its_cosine():
    """Along x by a: a sample in direction n is off by a n_x, the mean of its absolute a / 2."""
    whole = check_mesh(moved(BALL, 0.1 * H), GRID)
    found, figures = whole, whole.figures()
    assert figures["largest"] == pytest.approx(0.1, abs=0.01)
    assert figures["mean"] == pytest.approx(0.05, abs=0.005)
    cosine = found.points[:, 0] / np.linalg.norm(found.points, axis=1)
    clear = np.abs(found.values) > 0.2
    want = -0.1 * cosine * np.sign(found.values)
    np.testing.assert_allclose(found.residuals[clear], want[clear], atol=0.01)
    at = np.array(figures["largest_at"])
    assert abs(at[0]) > 0.9 * np.linalg.norm(at)
    front = BALL.vertices[:, 0] > 0.95 * RADIUS
    residuals = np.abs(whole.residuals_at(BALL.vertices)[front])
    assert residuals.mean() == pytest.approx(0.1, abs=0.01)
    assert np.isnan(whole.residuals_at(np.array([[9.0, 9, 9]]))).all()


def test_holes_components_and_twists_are_counted():
    coarse = round_mesh(subdivisions=2)
    lidless = check.examine_surface(Mesh(coarse.vertices, coarse.faces[1:]))
    assert lidless.open_edges == 3
    assert lidless.report()["manifold"] and lidless.report()["oriented"]
    hollow = check.examine_surface(joined(coarse, inverted(round_mesh(0.5 * RADIUS, 2))))
    assert (hollow.components, hollow.cavities, hollow.faults()) == (2, 1, [])
    assert " triangles, 1 piece (cavities: 1), volume" in hollow.counts()
    half = joined(cube(), moved(cube(), 0.3))
    assert "pairs of triangles that intersect" in check.examine_surface(half).faults()[0]
    faces = cube().faces.copy()
    faces[0] = faces[0][::-1]
    twisted = check.examine_surface(Mesh(cube().vertices, faces))
    assert twisted.flipped_edges == 3 and not twisted.report()["oriented"]
    doubled = check.examine_surface(Mesh(cube().vertices, np.concatenate([faces, faces[5:6]])))
    assert doubled.crowded_edges == 3 and not doubled.report()["manifold"]
    collapsed = np.concatenate([cube().faces, [[0, 0, 1]]]).astype(np.int32)
    assert check.examine_surface(Mesh(cube().vertices, collapsed)).faults() == []


def test_slivers_and_needles_are_counted():
    spiked = round_mesh(subdivisions=3)
    spiked.vertices[0] *= 3.0
    flat = np.array([[0, 0, 0], [1, 0, 0], [0.5, 0.004, 0]])
    found = check.examine_surface(joined(spiked, Mesh(flat, np.array([[0, 1, 2]], np.int32))))
    assert (found.slivers, found.needles) == (1, 1)


def test_a_vertex_shared_by_two_pieces_is_pinched():
    other = cube()
    corner = np.flatnonzero((cube().vertices == 0.5).all(1))[0]
    opposite = np.flatnonzero((other.vertices == -0.5).all(1))[0]
    faces = other.faces + 8
    faces[faces == opposite + 8] = corner
    vertices = np.concatenate([cube().vertices, other.vertices + 1])
    found = check.examine_surface(Mesh(vertices, np.concatenate([cube().faces, faces])))
    assert (found.pinched_vertices, found.open_edges, found.components) == (1, 0, 1)
    assert not found.report()["manifold"] and found.report()["closed"]


def test_a_smaller_sphere_does_not_reach_outside_and_is_pierced_inside():
    found = check_mesh(round_mesh(RADIUS - 0.2 * H), GRID)
    clear, outside = np.abs(found.values) > 0.3, found.values > 0
    np.testing.assert_allclose(found.residuals[clear & outside], 0.2, atol=0.01)
    np.testing.assert_allclose(found.residuals[clear & ~outside], -0.2, atol=0.01)
    between = (found.values < -0.001) & (found.values > -0.19)  # inside, the mesh says outside
    distance = np.abs(found.values)
    expected = between & (distance + np.abs(found.residuals + distance) > 0.1)
    assert np.array_equal(found.wrong_side, expected) and found.wrong_side.any()


def test_sides_of_a_mesh_that_meets_itself_are_by_winding_number():
    """A point in both balls is behind one sheet and nearest to the inner one, seen from inside."""
    found = check_mesh(joined(BALL, round_mesh(0.5 * RADIUS, 3)), GRID)
    assert found.surface.components == 2
    assert not found.wrong_side.any()


def test_a_piece_far_from_every_sample_is_noticed():
    """The samples near the surface see nothing of it, but those round it promise empty balls."""
    coarse, speck = round_mesh(subdivisions=4), round_mesh(0.02, 2)
    found = check_mesh(joined(coarse, speck), GRID)
    assert found.figures()["largest"] < 0.02
    assert found.strays == len(speck.vertices)
    outside = check_mesh(moved(coarse, 2.0), GRID)
    assert outside.beyond == len(coarse.vertices) and "within the grid" in str(outside.faults())


def test_truncated_and_noisy_samples_promise_nothing():
    near, early = (
        check_mesh(BALL, grid_of(np.clip(sphere_values(), -limit * H, limit * H)))
        for limit in (1.5, 0.9)
    )
    whole = check_mesh(BALL, GRID)
    assert len(near.values) == len(whole.values)  # beyond 1.4 voxels none counts anyway
    assert np.abs(early.values).max() < 0.9 and early.samples["cut_off"] > 1000
    assert early.figures()["largest"] < 0.005
    noise = np.random.default_rng(0).uniform(-1, 1, sphere_values().shape) * H
    found = check_mesh(BALL, grid_of(sphere_values() + noise))
    assert len(found.values) == 0 and found.samples["noisy"] > 3000
    assert found.report()["residual"] is None and found.strays is None
    assert "residual unknown, since no sample is exact; faults: none" in found.lines()
    assert found.exceeded(None, 9.0) == [NO_EVIDENCE] and found.exceeded(None, None) == []


def test_of_a_mask_the_volume_is_beside_that_of_its_samples(here, command):
    np.savez("mask.npz", values=sphere_values() < 0, spacing=H, origin=(-0.6, -0.6, -0.6))
    assert command("upsample", "mask.npz", "mask.ply", "--quality", "fast", "-q")[0] == 0
    code, out, _ = command("check", "mask.ply", "mask.npz")
    inside = np.count_nonzero(sphere_values() < 0) * H**3
    share = trimesh.load("mask.ply").volume / inside - 1
    want = f"volume {share:+.2%} off that of the samples, {inside:.6g}; faults: none"
    assert code == 0 and want in out and abs(share) < 0.02
    assert "noisy" not in out and "residual" not in out
    code, out, _ = command("check", "mask.ply", "mask.npz", "--unit", "mm")
    assert f" ({trimesh.load('mask.ply').volume / 1000:.6g} ml), area" in out
    moved = command("check", "mask.ply", "mask.npz", "--no-faults", "--origin", "-.5,-.5,-.5")
    assert moved[0] == 1 and " vertices where the grid has no surface" in moved[2]
    report = json.loads(command("check", "mask.ply", "mask.npz", "--json")[1])
    assert report["sample_volume"] == pytest.approx(inside)
    assert '"sample_volume": null' in command("check", "ball.ply", "ball.npz", "--json")[1]


def test_each_label_of_a_scene_is_checked(here, command):
    inside = sphere_values() < 0
    labels = inside * (1 + (np.indices(inside.shape)[0] > len(inside) // 2))
    np.savez("labels.npz", values=labels, spacing=H, origin=(-0.6, -0.6, -0.6))
    Path("names.csv").write_text("1,left\n2,right\n")
    how = ("--unit", "mm", "--names", "names.csv")
    command("upsample", "labels.npz", "both.glb", "--labels", "all", *how, "-q")
    counts = [np.count_nonzero(labels == n) * H**3 for n in (1, 2)]
    parts = json.loads(command("check", "both.glb", "--unit", "mm", "--json")[1])["parts"]
    found = [(part["name"], part["components"], part["faults"]) for part in parts]
    assert found == [("left", 1, []), ("right", 1, [])]
    np.testing.assert_allclose([1000 * part["volume_ml"] for part in parts], counts, rtol=0.03)
    code, out, _ = command("check", "both.glb", "labels.npz", *how)
    row = r"(\w+): .* 1 piece, volume .* ml\), .*% off that of the samples, (\S+); faults: none\n"
    assert code == 0 and [n for _, n in re.findall(row, out)] == [f"{n:.6g}" for n in counts]
    code, _, err = command("check", "both.glb", "labels.npz", "--unit", "mm")
    assert code == 2 and "both.glb has a part 'left': give the --names that it was made with" in err
    assert command("check", "both.glb")[1].count(" ml), area ") == 2  # it is in metres
    command("upsample", "labels.npz", "one.glb", "--labels", "right", *how, "-q")
    assert command("check", "one.glb", "labels.npz", *how)[1].startswith("right: ")
    scene = trimesh.load_scene("both.glb")
    scene.geometry["right"].update_faces(np.arange(len(scene.geometry["right"].faces)) > 0)
    scene.export("open.glb")
    assert command("check", "open.glb", "-q")[::2] == (
        1,
        "Limit exceeded: right has 3 open edges\n",
    )


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with a grid of the sphere, its mesh, and a shifted one."""
    monkeypatch.chdir(tmp_path)
    np.savez("ball.npz", values=GRID.values, spacing=H, origin=(-0.6, -0.6, -0.6))
    saved(BALL, Path("ball.ply"))
    saved(moved(BALL, 0.1 * H), Path("off.ply"))
    return tmp_path


def test_the_command_prints_figures(here, command):
    code, out, err = command("check", "ball.ply", "ball.npz", "--max-mean", 0.01, "--no-faults")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0].startswith("mesh: 10,242 vertices, 20,480 triangles, 1 piece, volume 0.26")
    assert lines[1] == (
        "shape: 0 slivers (triangles with an angle under 0.5 degrees), "
        "0 needles (vertices at the tip of a spike)"
    )
    assert lines[2].endswith(" that may be truncated, 0 noisy")
    assert re.match(r"largest residual: 0\.000\d+ in world units, at \(", lines[3]), lines[3]
    assert re.match(r"residual 0\.001\d voxels in the mean, [+-]0\.00\d+ at most, ", lines[4])
    assert re.search(r", 0\.00% of \d,\d+ samples above 0\.1; faults: none$", lines[4]), lines[4]


def test_exceeded_limits_are_exit_code_1_and_json_has_all(here, command):
    """Of a mean of 0.05 voxels, a largest residual of 0.1."""
    check_off = ("check", "off.ply", "ball.npz", "--json")
    assert command(*check_off, "--tolerance", 0.2 * H, "--max-mean", 0.1)[::2] == (0, "")
    code, out, err = command(*check_off, "--tolerance", H / 20, "--max-mean", 0.01)
    report = json.loads(out)
    assert code == 1
    world, mean = report["limits_exceeded"]
    assert err.splitlines() == [f"Limit exceeded: {said}" for said in report["limits_exceeded"]]
    worst = report["residual"]["largest"] * H
    assert world == f"the largest residual is {worst:.4g} in world units, --tolerance is {H / 20:g}"
    assert mean.startswith("the mean residual is 0.0") and mean.endswith(", --max-mean is 0.01")
    assert report["residual"]["mean"] == pytest.approx(0.05, abs=0.005)
    assert report["samples"]["noisy"] == report["strays"] == report["beyond"] == 0
    assert report["surface"]["closed"] and report["surface"]["self_intersections"] == 0


def test_the_offset_is_that_of_the_mesh(here, command):
    saved(round_mesh(RADIUS + H), Path("grown.ply"))
    words = ("check", "grown.ply", "ball.npz", "--tolerance", 0.01 * H, "-q")
    assert command(*words, "--offset", H) == (0, "", "")
    assert command(*words)[0] == 1
    code, _, err = command(*words, "--offset", H, "--tolerance", "nan")
    assert code == 1 and "in world units, --tolerance is nan\n" in err
    code, _, err = command(*words, "--offset", "nan")
    assert code == 2 and err.startswith("Error: --offset is 'nan': give a finite number, in world")
