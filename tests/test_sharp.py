"""The mesher that keeps edges and corners: where they lie, and a manifold on anything."""

import numpy as np
import pytest
from conftest import ball, count_fans, trilinear
from hypothesis import given, settings
from hypothesis import strategies as st
from test_isosurface import dense_field

from lab.methods import sharp_isosurface
from super_sdf import Mesh, SdfGrid, extract_mesh, load_network, upsample
from super_sdf.steps.cell_cases import loop_table, triangle_table
from super_sdf.steps.sharp.features import Rule
from super_sdf.steps.sharp.patches import Patches, Placed, triangles_of, unfolded

TURN = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]


def extract_sharp(field, grid) -> Mesh:
    return extract_mesh(field, grid, mesher="sharp")


def turned_box(half, samples=22):
    """The distance to a box that does not stand along the axes, spacing 1."""
    ijk = np.indices((samples,) * 3).reshape(3, -1) - (samples / 2 + 0.13)
    beyond = np.abs(TURN.T @ ijk) - half[:, None]
    distance = np.linalg.norm(np.maximum(beyond, 0), axis=0) + np.minimum(beyond.max(0), 0)
    return SdfGrid.trusted(distance.reshape((samples,) * 3), 1.0)


def test_loops_make_the_triangles_of_the_table():
    loops, (counts, table) = loop_table(), triangle_table()
    for case in range(len(counts)):
        made = []
        for loop in range(loops.first[case], loops.first[case] + loops.times[case]):
            places = loops.triangles[loop, : loops.sides[loop] - 2]
            made += loops.edges[loop][places].tolist()
        assert made == table[case, : counts[case]].tolist()


def test_a_smooth_surface_and_a_field_that_is_no_distance_stay_those_of_marching_cubes():
    box = turned_box(np.array([6.2, 5.1, 4.3]))
    for grid in (ball(), SdfGrid.trusted(3 * box.values, 1.0)):
        field = upsample(grid, trilinear)
        plain, sharp = extract_mesh(field, grid), extract_sharp(field, grid)
        np.testing.assert_array_equal(sharp.vertices, plain.vertices)
        assert set(map(tuple, sharp.faces)) == set(map(tuple, plain.faces))


def test_edges_of_a_box_are_kept_and_most_corners():
    """A corner whose spheres are pierced by .04 spacings, as of two here, is left to the edges."""
    half = np.array([6.2, 5.1, 4.3])
    grid = turned_box(half)
    sharp = extract_sharp(upsample(grid, load_network()), grid)
    assert sharp.is_closed() and (count_fans(sharp.faces) == 1).all()
    signs = np.indices((2, 2, 2)).reshape(3, 8).T * 2 - 1
    corners = (half * signs) @ TURN.T + 11.13
    nearest = np.linalg.norm(sharp.vertices[:, None] - corners, axis=2).min(0)
    assert (nearest < 0.12).sum() >= 6 and nearest.max() < 0.3
    assert sharp.volume() == pytest.approx(8 * half.prod(), rel=2e-3)
    local, apart = np.abs((sharp.vertices - 11.13) @ TURN), []
    for axis in range(3):  # only across the edge: a vertex lies anywhere along it
        others = [a for a in range(3) if a != axis]
        across = np.linalg.norm(local[:, others] - half[others], axis=1)
        for at in np.linspace(0, half[axis] - 1, 20):
            apart.append(across[np.abs(local[:, axis] - at) < 0.3].min())
    assert np.mean(apart) < 0.02


@settings(max_examples=50)
@given(st.integers(0, 10**6), st.sampled_from([0.05, 0.3, 1.0]))
def test_any_lattice_gives_a_closed_manifold_with_features_everywhere(seed, least):
    """With every patch a feature: fans and turned sides, ambiguous faces among them."""
    lattice = np.random.default_rng(seed).normal(size=(9, 9, 7)).astype(np.float32) * least
    lattice[[0, -1]] = lattice[:, [0, -1]] = lattice[:, :, [0, -1]] = 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("super_sdf.steps.sharp.features.SHARP_COSINE", 1.1)
        patch.setattr("super_sdf.steps.sharp.features.LEAST_SLOPE_TRUST", 0)
        patch.setattr("super_sdf.steps.sharp.features.RULE", Rule(1.0, ()))
        mesh = extract_sharp(*dense_field(lattice))
    if len(mesh.faces):
        assert mesh.open_edges() == 0
        assert (count_fans(mesh.faces) == 1).all()


def test_the_true_distance_is_meshed_on_its_edges():
    """Of a dense field, as for the bound in evaluations."""
    half = np.array([3.1, 2.5, 2.1])
    lattice = turned_box(4 * half, 49).values.astype(np.float32) / 4
    mesh = sharp_isosurface(lattice, 0.25, 0.0)
    assert mesh.is_closed() and (count_fans(mesh.faces) == 1).all()
    middle = (49 / 2 + 0.13) / 4
    for signs in np.indices((2, 2, 2)).reshape(3, 8).T * 2 - 1:
        corner = TURN @ (half * signs) + middle
        assert np.linalg.norm(mesh.vertices - corner, axis=1).min() < 0.03
    assert mesh.volume() == pytest.approx(8 * half.prod(), rel=1e-3)


# Fans round the vertices of features, on two squares in a plane.
SQUARES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0]], float)


def patches(*loops):
    """Return patches with four crossings each; fans do not need more."""
    zeros, four = np.zeros(len(loops), np.int64), np.full(len(loops), 4, np.int64)
    middles = np.zeros((len(loops), 3))
    return Patches(zeros.astype(np.int32), middles, zeros, four, np.array(loops))


def placed(*peaks):
    """Return vertices on the squares, whose planes face upwards, and on as many patches."""
    upwards = np.tile([0.0, 0.0, 1.0], (len(SQUARES), 1))
    return Placed(SQUARES, upwards, np.arange(len(peaks)), np.array(peaks, float))


@pytest.mark.parametrize(
    ("peak", "want"),
    [
        ([0.9, 0.2, 0], [0.9, 0.2, 0]),
        ([0.9, 0.2, 5], [0.9, 0.2, 5]),
        ([2.5, 0.5, 0], [1.5, 0.5, 0]),
    ],
)
def test_a_vertex_beyond_a_side_of_its_fan_goes_half_way_to_the_middle(peak, want):
    """One over its patch stays."""
    np.testing.assert_allclose(unfolded(patches([0, 1, 2, 3]), placed(peak)).peak, [want])


@pytest.mark.parametrize("height, is_turned", [(0.5, True), (2, False)])
def test_the_side_of_two_fans_joins_their_vertices_where_that_does_not_fold(height, is_turned):
    two = patches([0, 1, 2, 3], [1, 4, 5, 2])
    _, triangles = triangles_of(two, placed([0.5, 0.5, 0], [1.5, height, 0]))
    edges = {(int(t[k]), int(t[k - 2])) for t in triangles for k in range(3)}
    turned, kept = {(6, 7), (7, 6)}, {(1, 2), (2, 1)}
    there, absent = (turned, kept) if is_turned else (kept, turned)
    assert there <= edges and not absent & edges
