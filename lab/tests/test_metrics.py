"""The measures of surfaces, edges, angles and triangles against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from solids import CUBE_FACES, cube, inverted, sphere, square

from lab import edges, metrics
from lab.edges import EdgeCurves
from lab.measuring import Task, measure_method
from lab.shapes import Case, Setting, Shape
from lab.surfaces import EMPTY
from super_sdf import Mesh
from super_sdf.truth.solid import Solid

SEED = 7, 0
N = metrics.SAMPLE_COUNT
H = 0.05  # spacing of a coarse grid


def distances(
    reference: Mesh, result: Mesh, drawn: metrics.SurfacePoints, result_drawn: metrics.SurfacePoints
) -> metrics.Numbers:
    """Return the figures of the distances between two meshes, at points drawn from both."""
    there = metrics.distance_or_dot(Solid(result), drawn.points)
    return metrics.compare_distances(
        there, metrics.distance_or_dot(Solid(reference), result_drawn.points)
    )


def test_two_samplings_of_a_square_show_the_floor() -> None:
    drawn = [metrics.sample_surface(square(), (7, stream)) for stream in range(2)]
    figures = metrics.compare_samples(*drawn)
    assert figures["cd"] == pytest.approx(2 / (np.pi * N), rel=0.02)
    expected = 1 - np.exp(-N * np.pi * metrics.F1_DISTANCE**2)
    assert figures["recall"] == pytest.approx(expected, abs=0.004)
    assert figures["precision"] == pytest.approx(expected, abs=0.004)
    assert figures["f1"] == pytest.approx(expected, abs=0.004)
    assert figures["nc"] == figures["signed_nc"] == pytest.approx(1)


@pytest.mark.parametrize("gap", [0.002, 0.004, 0.25])
def test_parallel_planes(gap: float) -> None:
    low, high = square(), square(gap)
    drawn = metrics.sample_surface(low, (7, 0)), metrics.sample_surface(high, (7, 1))
    exact = distances(low, high, *drawn)
    for key in ("p2s", "p2s_there", "p2s_back", "p99", "max"):
        assert exact[key] == pytest.approx(gap)
    sampled = metrics.compare_samples(*drawn)
    assert sampled["cd"] == pytest.approx(2 * gap**2 + 2 / (np.pi * N), rel=0.02)
    # Within 0.003 are the points of a disc whose radius is what the gap leaves.
    disc = max(metrics.F1_DISTANCE**2 - gap**2, 0)
    assert sampled["f1"] == pytest.approx(1 - np.exp(-N * np.pi * disc), abs=0.005)


def test_an_empty_result_is_a_dot_at_the_origin() -> None:
    drawn = metrics.sample_surface(cube(), (7, 0))
    dot = metrics.sample_surface(EMPTY, (7, 1))
    assert dot.points.tolist() == [[0, 0, 0]]
    figures = metrics.compare_samples(drawn, dot)
    mean_square = np.mean(np.sum(drawn.points**2, axis=1))
    assert figures["cd"] == pytest.approx(mean_square + 0.25, rel=1e-3)
    assert (figures["f1"], figures["nc"], figures["signed_nc"]) == (0, 0.5, 0)
    exact = distances(cube(), EMPTY, drawn, dot)
    assert exact["p2s_back"] == pytest.approx(0.5)
    assert not EMPTY.is_closed() and EMPTY.volume() == 0


def in_voxels(reference: Mesh, result: Mesh) -> metrics.Numbers:
    """Return EFv and edge distance of a result, at a spacing of ``H``."""
    return edges.compare_in_voxels(EdgeCurves.of(reference, SEED), Solid(result), (7, 1), H)


def angles_of(reference: Mesh, result: Mesh) -> tuple[float | None, float | None]:
    """Return the mean angles near the edges of a reference and beyond."""
    curves, drawn = EdgeCurves.of(reference, SEED), metrics.sample_surface(result, (7, 1))
    nearest = Solid(reference).nearest(drawn.points)[1]
    figures = edges.compare_angles(reference, nearest, curves, drawn, H)
    return figures["angle_near"], figures["angle_beyond"]


def octagonal(cut: float) -> Mesh:
    """Return the cube of side 1 with the four edges along z cut off, ``cut`` from each of them."""
    a, b = 0.5, 0.5 - cut
    ring = np.array([[a, -b], [a, b], [b, a], [-b, a], [-a, b], [-a, -b], [-b, -a], [b, -a]])
    vertices = np.concatenate([np.column_stack([ring, np.full(8, z)]) for z in (-0.5, 0.5)])
    walls = [[[n, m, 8 + m], [n, 8 + m, 8 + n]] for n, m in zip(range(8), [*range(1, 8), 0])]
    lids = [[[0, n + 1, n], [8, 8 + n, 9 + n]] for n in range(1, 7)]
    return Mesh(vertices, np.concatenate([*walls, *lids]).astype(np.int32))


def test_the_sharp_edges_of_a_cube() -> None:
    box = Mesh(cube().vertices * 0.2, CUBE_FACES)
    sharp = EdgeCurves.of(box, SEED)
    assert len(sharp.edges) == 12  # not the 6 diagonals of its sides
    assert (np.isclose(np.abs(sharp.drawn), 0.1).sum(1) >= 2).all()
    near = edges.edge_points(metrics.sample_surface(box, (7, 1)))
    off_edge = np.linalg.norm(0.1 - np.sort(np.abs(near), axis=1)[:, 1:], axis=1)
    assert len(near) and off_edge.max() < edges.EDGE_RADIUS
    np.testing.assert_allclose(sharp.distance(near), off_edge, atol=1e-12)
    figures = edges.compare_edges(sharp, near)
    assert figures["ef1"] == pytest.approx(1, abs=0.02)
    assert 0 < figures["ecd"] < 2 * edges.EDGE_RADIUS**2
    assert edges.compare_edges(sharp, np.zeros((0, 3)))["ef1"] == 0


@pytest.mark.parametrize(("share", "efv"), [(0.09, 1.0), (0.2, 1 / 3)])
def test_a_shift_moves_the_edges_across_it(share: float, efv: float) -> None:
    """Those along the shift, a third, stay where they are, but for their ends."""
    moved = Mesh(cube().vertices + np.array([share * H, 0, 0]), CUBE_FACES)
    assert in_voxels(cube(), moved)["efv"] == pytest.approx(efv, abs=0.01)


@pytest.mark.parametrize("cut", [0.01, 0.1])
def test_a_chamfer_cuts_an_edge_off_by_its_width_over_root_2(cut: float) -> None:
    result = octagonal(cut)
    assert result.is_closed() and result.volume() == pytest.approx(1 - 2 * cut**2)
    # The 4 edges along z; then 16 ends of other edges, the distance falling to 0 over the cut.
    total = 4 * cut / 2**0.5 + 16 * cut / 2**0.5 * cut / 2
    figures = in_voxels(cube(), result)
    assert figures["edge_distance"] == pytest.approx(total / 12 / H, rel=0.02)
    # Within reach are the uncut edges across z and a little of both ends of the cut.
    matched = 8 * (1 - 2 * cut) + 16 * 2**0.5 * edges.VOXEL_SHARE * H
    recall, precision = matched / 12, matched / (16 - 16 * cut + 8 * 2**0.5 * cut)
    expected = metrics.harmonic_mean(recall, precision)
    assert figures["efv"] == pytest.approx(expected, abs=0.01)


def test_a_result_without_a_surface_is_the_worst() -> None:
    assert in_voxels(cube(), EMPTY)["efv"] == 0
    assert in_voxels(cube(), EMPTY)["edge_distance"] > 0.7 / H
    assert angles_of(cube(), EMPTY) == (90, 90)
    assert angles_of(sphere(), EMPTY) == (None, 90)
    assert angles_of(cube(), inverted(cube())) == (pytest.approx(180), pytest.approx(180))


def test_marching_cubes_cuts_a_cube_off_as_computed() -> None:
    """Its faces lie half-way between nodes f apart: the cut is f / sqrt(2) wide, half as deep."""
    cells = 33  # along an edge of the cube
    shape = Shape("box", cube())
    case = Case(shape, Setting(16, 4, scale=cells / 64))
    row = measure_method(shape, case, "bound", Task(Path(), case.setting, ()))
    assert row["error"] is None
    assert row["edge_distance"] == pytest.approx(8**-0.5 / 4, rel=0.02)
    assert row["efv"] < 0.02 and row["angle_beyond"] == pytest.approx(0, abs=0.02)
    cut = 12 * (cells - 1) / 2**0.5  # in cells, at 45 degrees
    flat = 6 * ((cells - 1) ** 2 - (cells - 8) ** 2)  # within a voxel, 4 cells, of an edge
    assert row["angle_near"] == pytest.approx(45 * cut / (cut + flat), rel=0.02)


@pytest.mark.parametrize(
    ("tip", "angle"),
    [([0.5, 3**0.5 / 2], 60), ([0, 1], 45), ([0.5, 0.5 * np.tan(np.radians(4))], 4), ([2, 0], 0)],
)
def test_the_smallest_angle_of_a_triangle(tip: list[float], angle: float) -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [*tip, 0]])
    mesh = Mesh(corners, np.array([[0, 1, 2]], np.int32))
    figures = metrics.compare_triangles(mesh)
    assert figures["min_angle"] == pytest.approx(angle) and figures["slivers"] == (angle < 5)
    assert metrics.compare_triangles(EMPTY) == {"min_angle": None, "slivers": None}
