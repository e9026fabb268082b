"""Fans round the vertices of features, on two squares in a plane."""

from __future__ import annotations

import numpy as np
import pytest

from super_sdf.steps.sharp.patches import Patches, Placed, triangles_of, unfolded

SQUARES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0]], float)


def patches(*loops: list[int]) -> Patches:
    """Return patches with four crossings each; fans do not need more."""
    count = len(loops)
    zeros, four = np.zeros(count, np.int64), np.full(count, 4, np.int64)
    return Patches(zeros.astype(np.int32), np.zeros((count, 3)), zeros, four, np.array(loops))


def placed(*peaks: list[float]) -> Placed:
    """Return vertices on the squares, whose planes face upwards, and on as many patches."""
    upwards = np.tile([0.0, 0.0, 1.0], (len(SQUARES), 1))
    return Placed(SQUARES, upwards, np.arange(len(peaks)), np.array(peaks, float))


ONE = patches([0, 1, 2, 3])
TWO = patches([0, 1, 2, 3], [1, 4, 5, 2])


def edges_of(triangles: np.ndarray) -> set[tuple[int, int]]:
    """Return the directed edges of triangles."""
    return {(int(t[k]), int(t[k - 2])) for t in triangles for k in range(3)}


@pytest.mark.parametrize("height", [0, 5])
def test_a_vertex_over_its_patch_stays(height: float) -> None:
    peak = [0.9, 0.2, height]
    np.testing.assert_array_equal(unfolded(ONE, placed(peak)).peak, [peak])


def test_a_vertex_beyond_a_side_of_its_fan_goes_half_way_to_the_middle() -> None:
    np.testing.assert_allclose(unfolded(ONE, placed([2.5, 0.5, 0])).peak, [[1.5, 0.5, 0]])


def test_the_side_of_two_fans_is_turned_to_join_their_vertices() -> None:
    _, triangles = triangles_of(TWO, placed([0.5, 0.5, 0], [1.5, 0.5, 0]))
    edges = edges_of(triangles)
    assert {(6, 7), (7, 6)} <= edges
    assert not {(1, 2), (2, 1)} & edges


def test_the_side_of_two_fans_is_kept_where_turning_would_fold_the_surface() -> None:
    _, triangles = triangles_of(TWO, placed([0.5, 0.5, 0], [1.5, 2, 0]))
    edges = edges_of(triangles)
    assert {(1, 2), (2, 1)} <= edges
    assert not {(6, 7), (7, 6)} & edges
