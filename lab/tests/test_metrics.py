"""The metrics of surfaces, edges, angles and triangles against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from solids import CUBE_FACES, cube, inverted, sphere, square

from lab.measuring import Task, measure_method
from lab.metrics import METRICS, Comparison
from lab.shapes import Case, Setting, Shape, normalise
from lab.surfaces import EMPTY
from super_sdf import Mesh, evaluation as samples
from super_sdf.evaluation import EDGE_DISTANCE, F1_DISTANCE, VOXEL_SHARE

N = samples.SAMPLE_COUNT
H = 0.05  # spacing of a coarse grid


def figures(reference: Mesh, result: Mesh, *keys: str) -> list[float | None]:
    """Return some figures of a result, at a spacing of ``H``."""
    compared = Comparison(Shape("reference", reference), result, H)
    return [METRICS[key].of(compared) for key in keys]


def test_two_samplings_of_a_square_show_the_floor() -> None:
    cd, *shares = figures(square(), square(), "cd", "recall", "precision", "f1")
    assert cd == pytest.approx(2 / (np.pi * N), rel=0.02)
    assert shares == pytest.approx([1 - np.exp(-N * np.pi * F1_DISTANCE**2)] * 3, abs=0.004)
    assert figures(square(), square(), "nc", "signed_nc") == pytest.approx([1, 1])


@pytest.mark.parametrize("gap", [0.002, 0.004, 0.25])
def test_parallel_planes(gap: float) -> None:
    cd, f1, *exact = figures(
        square(), square(gap), "cd", "f1", "p2s", "p2s_there", "p2s_back", "p99", "max"
    )
    assert exact == pytest.approx([gap] * 5)
    assert cd == pytest.approx(2 * gap**2 + 2 / (np.pi * N), rel=0.02)
    # Within 0.003 are the points of a disc whose radius is what the gap leaves.
    disc = max(F1_DISTANCE**2 - gap**2, 0)
    assert f1 == pytest.approx(1 - np.exp(-N * np.pi * disc), abs=0.005)


def test_an_empty_result_is_a_dot_at_the_origin() -> None:
    assert samples.Sampled(EMPTY).drawn[0].tolist() == [[0, 0, 0]]
    cd, *others = figures(cube(), EMPTY, "cd", "f1", "nc", "signed_nc", "closed", "min_angle")
    assert cd == pytest.approx(0.25 + 1 / 6 + 0.25, rel=0.01)  # of points on the sides; of the dot
    assert others == [0, 0.5, 0, False, None]
    assert figures(cube(), EMPTY, "p2s_back", "efv", "slivers") == [0.5, 0, None]
    assert figures(cube(), EMPTY, "edge_distance")[0] > 0.7 / H


def test_normals_of_a_result_inside_out_or_without_a_surface() -> None:
    angles = "angle_near", "angle_beyond"
    assert figures(cube(), EMPTY, *angles) == [90, 90]
    assert figures(sphere(), EMPTY, *angles) == [None, 90]
    assert figures(cube(), inverted(cube()), *angles) == pytest.approx([180, 180])


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
    sharp = samples.Sampled(box, (7,))
    assert len(sharp.edges) == 12  # not the 6 diagonals of its sides
    assert (np.isclose(np.abs(sharp.drawn_from_edges), 0.1).sum(1) >= 2).all()
    near = sharp.near_edges
    off_edge = np.linalg.norm(0.1 - np.sort(np.abs(near), axis=1)[:, 1:], axis=1)
    assert len(near) and off_edge.max() < samples.EDGE_RADIUS < EDGE_DISTANCE
    np.testing.assert_allclose(sharp.to_edges(near), off_edge, atol=1e-12)
    ecd, ef1 = figures(box, box, "ecd", "ef1")
    assert ef1 == pytest.approx(1, abs=0.02) and 0 < ecd < 2 * samples.EDGE_RADIUS**2
    assert figures(box, EMPTY, "ef1") == [0]


@pytest.mark.parametrize(("share", "efv"), [(0.09, 1.0), (0.2, 1 / 3)])
def test_a_shift_moves_the_edges_across_it(share: float, efv: float) -> None:
    """Those along the shift, a third, stay where they are, but for their ends."""
    moved = Mesh(cube().vertices + np.array([share * H, 0, 0]), CUBE_FACES)
    assert figures(cube(), moved, "efv") == pytest.approx([efv], abs=0.01)


@pytest.mark.parametrize("cut", [0.01, 0.1])
def test_a_chamfer_cuts_an_edge_off_by_its_width_over_root_2(cut: float) -> None:
    result = octagonal(cut)
    assert result.is_closed() and result.volume() == pytest.approx(1 - 2 * cut**2)
    distance, efv = figures(cube(), result, "edge_distance", "efv")
    # The 4 edges along z; then 16 ends of other edges, the distance falling to 0 over the cut.
    total = 4 * cut / 2**0.5 + 16 * cut / 2**0.5 * cut / 2
    assert distance == pytest.approx(total / 12 / H, rel=0.02)
    # Within reach are the uncut edges across z and a little of both ends of the cut.
    matched = 8 * (1 - 2 * cut) + 16 * 2**0.5 * VOXEL_SHARE * H
    lengths = 12, 16 - 16 * cut + 8 * 2**0.5 * cut
    assert efv == pytest.approx(2 * matched / sum(lengths), abs=0.01)


def test_marching_cubes_cuts_a_cube_off_as_computed() -> None:
    """Its faces lie half-way between nodes f apart: the cut is f / sqrt(2) wide, half as deep."""
    cells = 33  # along an edge of the cube
    shape = Shape("box", normalise(cube()))
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
    assert figures(cube(), mesh, "min_angle", "slivers") == [pytest.approx(angle), angle < 5]
