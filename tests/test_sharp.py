"""The mesher that keeps edges and corners: where they lie, and a manifold on anything."""

import json
from functools import partial

import numpy as np
import pytest
from conftest import ball, is_manifold, trilinear
from hypothesis import HealthCheck, given, settings, strategies as st
from solids import box_distance
from test_isosurface import dense_field

from lab.methods import sharp_isosurface
from super_sdf import SdfGrid, extract_mesh, load_network, make_grid, reconstruct, upsample
from super_sdf.surface.sharp import features
from super_sdf.truth import Solid, read_mesh

extract_sharp = partial(extract_mesh, mesher="sharp")
TURN = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
BOX = np.array([6.2, 5.1, 4.3])


def box_grid(half, samples, middle, turn=TURN):
    """Return the distance to a turned box, at samples of spacing 1."""
    ijk = np.moveaxis(np.indices((samples,) * 3), 0, -1)
    return box_distance((ijk - middle) @ turn, half)


def turned_box(half=BOX, samples=22):
    return SdfGrid.trusted(box_grid(half, samples, samples / 2 + 0.13), 1.0)


def intersections(mesh):
    return len(Solid(mesh).intersecting())


def test_a_smooth_surface_and_a_field_that_is_no_distance_stay_those_of_marching_cubes():
    for grid in (ball(), SdfGrid.trusted(3 * turned_box().values, 1.0)):
        field = upsample(grid, trilinear)
        plain, sharp = extract_mesh(field, grid, mesher="marching"), extract_sharp(field, grid)
        np.testing.assert_array_equal(sharp.vertices, plain.vertices)
        assert set(map(tuple, sharp.faces)) == set(map(tuple, plain.faces))


def test_edges_of_a_box_are_kept_and_most_corners():
    """A corner whose spheres are pierced by .04 spacings, as of two here, is left to the edges."""
    grid = turned_box()
    sharp = extract_sharp(upsample(grid, load_network()), grid)
    assert sharp.is_closed() and is_manifold(sharp)
    signs = np.indices((2, 2, 2)).reshape(3, 8).T * 2 - 1
    corners = (BOX * signs) @ TURN.T + 11.13
    nearest = np.linalg.norm(sharp.vertices[:, None] - corners, axis=2).min(0)
    assert (nearest < 0.12).sum() >= 6 and nearest.max() < 0.3
    assert sharp.volume() == pytest.approx(8 * BOX.prod(), rel=2e-3)
    local, apart = np.abs((sharp.vertices - 11.13) @ TURN), []
    for axis in range(3):  # only across the edge: a vertex lies anywhere along it
        others = [a for a in range(3) if a != axis]
        across = np.linalg.norm(local[:, others] - BOX[others], axis=1)
        for at in np.linspace(0, BOX[axis] - 1, 20):
            apart.append(across[np.abs(local[:, axis] - at) < 0.3].min())
    assert np.mean(apart) < 0.02


@pytest.mark.parametrize("kind", ["mask", "noisy", "distance"])
def test_by_itself_it_is_sharp_where_samples_are_exact(kind):
    values = turned_box().values
    values = values < 0 if kind == "mask" else np.clip(values, -3, 3)
    inside = "positive" if kind == "mask" else "auto"
    grid, network = make_grid(values, spacing=1.0, field=kind, inside=inside), load_network("fast")
    plain, sharp, auto = (
        reconstruct(grid, network, 2, mesher=name) for name in ("marching", "sharp", "auto")
    )
    assert len(auto.vertices) == len((sharp if kind == "distance" else plain).vertices)
    assert (len(sharp.vertices) > len(plain.vertices)) == (kind == "distance")


def test_the_command_takes_a_mesher_and_says_which(folder, command):
    np.save("in.npy", turned_box().values)
    np.save("m.npy", turned_box().values < 0)
    words = ("--spacing", 1, "--quality", "fast", "--factor", 2, "--force")
    sizes, note = {}, "mask values show no edges: the mesh is that of marching cubes"
    for name in ("auto", "sharp", "marching"):
        asked = () if name == "auto" else ("--mesher", name)
        code, out, _ = command("upsample", "in.npy", "a.ply", *asked, *words, "--json")
        assert code == 0 and json.loads(out)["asked"]["mesher"] == name
        sizes[name] = len(read_mesh("a.ply").vertices)
        code, _, err = command("upsample", "m.npy", "m.ply", *asked, *words, "--inside", "positive")
        assert code == 0 and (note in err) == (name == "sharp")
    assert sizes["auto"] == sizes["sharp"] > sizes["marching"]


@pytest.fixture
def features_everywhere():
    """Let every patch be a feature: fans and turned sides, ambiguous faces among them."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("LEAST_SLOPE_TRUST", "LEAST_SPHERES"):
            patch.setattr(features, name, 0)
        patch.setattr(features, "SHARP_COSINE", 1.1)
        patch.setattr(features, "HALF_ANGLE_COSINE", 1.1)
        patch.setattr(features, "load_rule", lambda: features.Rule(1.0, ()))
        yield patch


def noise(seed, least):
    lattice = np.random.default_rng(seed).normal(size=(9, 9, 7)).astype(np.float32) * least
    lattice[[0, -1]] = lattice[:, [0, -1]] = lattice[:, :, [0, -1]] = 1
    return dense_field(lattice)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 10**6), st.sampled_from([0.05, 0.3, 1.0]))
def test_any_lattice_gives_a_closed_manifold_of_features(features_everywhere, seed, least):
    mesh = extract_sharp(*noise(seed, least))
    if len(mesh.faces):
        assert mesh.open_edges() == 0
        assert is_manifold(mesh)


def test_no_triangles_intersect_with_features_everywhere(features_everywhere):
    """In noise, where marching cubes has none; and there are hundreds if folds are left."""
    fields = [noise(seed, 1.0) for seed in range(8)]
    plain = [intersections(extract_mesh(*field, mesher="marching")) for field in fields]
    assert plain.count(0) > 4
    assert all(intersections(extract_sharp(*field)) <= n for field, n in zip(fields, plain))
    features_everywhere.setattr(features, "without_folds", lambda *of: of[1])
    assert intersections(extract_sharp(*fields[0])) > 100


def test_a_blade_and_a_gap_do_not_intersect():
    """Sheets half a fine spacing apart, turned: each of the fans reaches into the other's cells."""
    for half in ([0.9, 5.1, 4.3], [0.3, 5.1, 4.3], [6.2, 0.15, 0.15]):
        lattice = turned_box(4 * np.array(half), 49).values.astype(np.float32) / 4
        for field in (lattice, -np.minimum(lattice, 5.0)):
            assert intersections(sharp_isosurface(field, 0.25, 0.0)) == 0


def test_a_piece_in_a_cell_that_a_fan_enters_does_not_intersect():
    """A speck beside the edge of a carved block, joined to no feature."""
    draw = np.random.default_rng(110).uniform
    a, b, c, d = (box_grid(middle=draw(3, 10, 3), half=draw(0.5, 5, 3), samples=14) for _ in "abcd")
    grid = SdfGrid.trusted(np.maximum(np.minimum(a, b), -np.minimum(c, d)), 1.0)
    assert intersections(reconstruct(grid, load_network("fast"), 2, mesher="sharp")) == 0


@pytest.mark.parametrize("turn, half", [(TURN, [3.1, 2.5, 2.1]), (np.eye(3), [3.0, 2.5, 2.0])])
def test_the_true_distance_is_meshed_on_its_edges(turn, half):
    """Of a dense field; also along the lattice, where triangles share planes, vertices nodes."""
    lattice = box_grid(4 * np.array(half), 49, 49 / 2 + 0.13 * (turn is TURN), turn) / 4
    mesh = sharp_isosurface(lattice.astype(np.float32), 0.25, 0.0)
    assert mesh.is_closed() and mesh.volume() == pytest.approx(8 * np.prod(half), rel=1e-3)
    local = (mesh.vertices - (49 / 2 + 0.13 * (turn is TURN)) / 4) @ turn
    for signs in np.indices((2, 2, 2)).reshape(3, 8).T * 2 - 1:
        assert np.linalg.norm(local - half * signs, axis=1).min() < 0.03
    for axis in range(3):
        across = np.delete(np.abs(local) - half, axis, 1)
        assert (np.linalg.norm(across, axis=1) < 0.03).sum() > 16 * half[axis]
