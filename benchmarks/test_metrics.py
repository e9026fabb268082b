"""The measures against closed forms, and the methods against each other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from benchmarks import metrics, quality
from export.sampling import TriMesh, signed_distance
from super_sdf.band import NEIGHBOURHOOD

N = metrics.SAMPLE_COUNT
CUBE_CORNERS = "013 032 467 475 045 051 237 276 026 064 157 173"
CUBE_FACES = np.array([[int(corner) for corner in face] for face in CUBE_CORNERS.split()])


def square(z: float = 0.0) -> TriMesh:
    """Return the unit square at height z, two triangles looking up."""
    corners = np.array([[0, 0, z], [1, 0, z], [1, 1, z], [0, 1, z]], float)
    return TriMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def cube() -> TriMesh:
    """Return the cube of side 1 round the origin, outward."""
    return TriMesh(np.indices((2, 2, 2)).reshape(3, -1).T - 0.5, CUBE_FACES)


def sphere(radius: float = 0.4, size: int = 32) -> TriMesh:
    """Return the isosurface of an exact sphere, as the baselines make theirs."""
    axis = np.linspace(-0.5, 0.5, size + 1, dtype=np.float32)
    field = np.sqrt(sum(x**2 for x in np.meshgrid(axis, axis, axis))) - np.float32(radius)
    return quality.isosurface(field, 1 / size, -0.5)


def case_of(mesh: TriMesh, size: int, factor: int) -> quality.Case:
    """Return the mesh, put into the frame and sampled."""
    shape = quality.Shape.__new__(quality.Shape)  # not from a file
    shape.mesh = metrics.normalise(mesh)
    return quality.Case(shape, size, factor)


def trilinear_network(
    patches: np.ndarray, table: np.ndarray, voxels: np.ndarray, offsets: np.ndarray
) -> np.ndarray:
    """Stand in for the network: trilinear interpolation of the patch, (D, Q)."""
    to_sample = np.abs(offsets[:, None] - 2 * NEIGHBOURHOOD).clip(0, 2) / 2  # (Q, 27, 3)
    return patches[voxels] @ (1 - to_sample).prod(2).T.astype(np.float32)


def inverted(mesh: TriMesh) -> TriMesh:
    """Return the mesh inside out."""
    return TriMesh(mesh.vertices, mesh.faces[:, ::-1])


def test_two_samplings_of_a_square_show_the_floor() -> None:
    drawn = [metrics.sample_surface(square(), (7, stream)) for stream in range(2)]
    figures = metrics.compare_samples(*drawn)
    assert figures["cd"] == pytest.approx(2 / (np.pi * N), rel=0.02)
    expected = 1 - np.exp(-N * np.pi * metrics.F1_DISTANCE**2)
    assert figures["recall"] == pytest.approx(expected, abs=0.004)
    assert figures["precision"] == pytest.approx(expected, abs=0.004)
    assert figures["f1"] == pytest.approx(expected, abs=0.004)
    assert figures["nc"] == figures["signed_nc"] == pytest.approx(1)


def test_samples_are_uniform_in_area_and_lie_on_the_surface() -> None:
    stretched = TriMesh(cube().vertices * [1, 2, 3], cube().faces)  # faces of 2, 3 and 6
    drawn = metrics.sample_surface(stretched, (7, 0))
    shares = np.abs(drawn.normals).mean(0)
    np.testing.assert_allclose(shares, np.array([6, 3, 2]) / 11, atol=0.01)
    assert metrics.distance_or_dot(stretched, drawn.points).max() < 1e-12
    np.testing.assert_allclose(drawn.points.mean(0), 0, atol=0.01)


@pytest.mark.parametrize("gap", [0.002, 0.004, 0.25])
def test_parallel_planes(gap: float) -> None:
    low, high = square(), square(gap)
    drawn = metrics.sample_surface(low, (7, 0)), metrics.sample_surface(high, (7, 1))
    exact = metrics.compare_surfaces(low, high, *drawn)
    for key in ("p2s", "p2s_there", "p2s_back", "p99", "max"):
        assert exact[key] == pytest.approx(gap)
    sampled = metrics.compare_samples(*drawn)
    assert sampled["cd"] == pytest.approx(2 * gap**2 + 2 / (np.pi * N), rel=0.02)
    # Within 0.003 are the points of a disc whose radius is what the gap leaves.
    disc = max(metrics.F1_DISTANCE**2 - gap**2, 0)
    assert sampled["f1"] == pytest.approx(1 - np.exp(-N * np.pi * disc), abs=0.005)


def test_a_shape_inside_out_has_opposite_normals() -> None:
    outside = metrics.sample_surface(sphere(), (7, 0))
    inside = metrics.sample_surface(inverted(sphere()), (7, 0))
    figures = metrics.compare_samples(outside, inside)
    assert figures["nc"] == pytest.approx(1, abs=0.001)
    assert figures["signed_nc"] == pytest.approx(-1, abs=0.001)


def test_a_sphere_is_closed_and_outward() -> None:
    ball = sphere()
    assert metrics.is_closed(ball.faces)
    assert metrics.volume(ball) == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=0.01)
    assert metrics.is_closed(inverted(ball).faces)
    assert metrics.volume(inverted(ball)) < 0
    assert not metrics.is_closed(ball.faces[1:])
    assert not metrics.is_closed(np.concatenate([ball.faces[1:], ball.faces[:1, ::-1]]))


def test_an_edge_of_four_faces_is_not_closed() -> None:
    doubled = np.concatenate([CUBE_FACES, CUBE_FACES])
    assert metrics.is_closed(CUBE_FACES)
    assert not metrics.is_closed(doubled)


def test_an_empty_result_is_a_dot_at_the_origin() -> None:
    drawn = metrics.sample_surface(cube(), (7, 0))
    dot = metrics.sample_surface(quality.EMPTY, (7, 1))
    assert dot.points.tolist() == [[0, 0, 0]]
    figures = metrics.compare_samples(drawn, dot)
    mean_square = np.mean(np.sum(drawn.points**2, axis=1))
    assert figures["cd"] == pytest.approx(mean_square + 0.25, rel=1e-3)
    assert (figures["f1"], figures["nc"], figures["signed_nc"]) == (0, 0.5, 0)
    exact = metrics.compare_surfaces(cube(), quality.EMPTY, drawn, dot)
    assert exact["p2s_back"] == pytest.approx(0.5)
    assert not metrics.is_closed(quality.EMPTY.faces)


def test_the_sharp_edges_of_a_cube() -> None:
    box = TriMesh(cube().vertices * 0.2, CUBE_FACES)
    sharp = metrics.sharp_edges(box)
    assert len(sharp) == 12  # not the 6 diagonals of its sides
    drawn = metrics.sample_edges(box.vertices, sharp, (7, 0))
    assert (np.isclose(np.abs(drawn), 0.1).sum(1) >= 2).all()
    near = metrics.edge_points(metrics.sample_surface(box, (7, 1)))
    off_edge = np.linalg.norm(0.1 - np.sort(np.abs(near), axis=1)[:, 1:], axis=1)
    assert len(near) and off_edge.max() < metrics.EDGE_RADIUS
    figures = metrics.compare_edges(box.vertices, sharp, drawn, near)
    assert figures["ef1"] == pytest.approx(1, abs=0.02)
    assert 0 < figures["ecd"] < 2 * metrics.EDGE_RADIUS**2
    assert metrics.compare_edges(box.vertices, sharp, drawn, np.zeros((0, 3)))["ef1"] == 0


def test_a_smooth_shape_has_no_edge_to_compare() -> None:
    ball = sphere()
    sharp = metrics.sharp_edges(ball)
    drawn = metrics.sample_edges(ball.vertices, sharp, (7, 0))
    near = metrics.edge_points(metrics.sample_surface(ball, (7, 0)))
    assert len(sharp) == len(drawn) == len(near) == 0
    figures = metrics.compare_edges(ball.vertices, sharp, drawn, near)
    assert figures == {"ecd": None, "ef1": None}


def test_the_frame() -> None:
    moved = TriMesh(cube().vertices * [3, 4, 12] + 5, cube().faces)
    framed = metrics.normalise(moved).vertices
    np.testing.assert_allclose(framed.max(0), np.array([3, 4, 12]) / 26)
    np.testing.assert_allclose(framed.min(0), -np.array([3, 4, 12]) / 26)


@pytest.mark.parametrize("order", [1, 3])
def test_upsampling_keeps_samples_and_straight_lines(order: int) -> None:
    coarse = np.random.default_rng(1).random((16, 16, 16))
    fine = quality.upsample(coarse, 4, order)
    np.testing.assert_allclose(fine[2::4, 2::4, 2::4], coarse, atol=1e-6)
    ramp = np.broadcast_to(np.arange(32.0)[:, None, None], (32, 32, 32))
    middle = quality.upsample(ramp, 4, order)[40:-40, 64, 64]
    np.testing.assert_allclose(middle, np.arange(40, 89) / 4 - 0.5, atol=1e-4)


def test_upsampling_is_that_of_scipy() -> None:
    coarse = np.random.default_rng(2).random((6, 6, 6))
    position = np.meshgrid(*[np.arange(25) / 4 - 0.5] * 3, indexing="ij")
    expected = ndimage.map_coordinates(coarse, position, order=3, mode="nearest")
    np.testing.assert_allclose(quality.upsample(coarse, 4, 3), expected, atol=1e-5)


@pytest.mark.parametrize("factor", [2, 4])
def test_the_truth_is_exact_near_the_surface_and_right_in_sign(factor: int) -> None:
    case = case_of(cube(), 12, factor)
    nodes = np.indices(case.truth.shape).reshape(3, -1).T
    exact = signed_distance(case.shape.mesh, nodes * case.fine - 0.5).reshape(case.truth.shape)
    # On the very surface the winding number may say either; the distance there is 0.
    away = np.abs(exact) > 1e-6
    assert (np.sign(case.truth) == np.sign(exact))[away].all()
    near = np.abs(exact) < 3**0.5 * case.fine
    np.testing.assert_allclose(np.abs(case.truth[near]), np.abs(exact[near]), atol=1e-6)
    np.testing.assert_allclose(case.truth[case.band & away], exact[case.band & away], atol=1e-6)


def test_ours_with_a_trilinear_network_is_the_trilinear_baseline(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    case = case_of(sphere(), 16, 4)
    monkeypatch.setattr(quality, "load_once", lambda model: trilinear_network)
    ours, our_field = quality.our_surface(case, "any")
    mesh, field = quality.upsampled_surface(case, 1)
    near = case.band & (np.abs(field) < case.spacing)  # patches are cut off at 3 h
    np.testing.assert_allclose(our_field[near], field[near], atol=1e-6)
    assert metrics.is_closed(ours.faces)
    assert metrics.volume(ours) == pytest.approx(metrics.volume(mesh), rel=1e-3)
    assert metrics.distance_or_dot(mesh, ours.vertices).max() < case.fine / 4
