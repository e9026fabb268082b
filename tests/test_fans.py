"""Fans round the vertices of features, on two squares in a plane."""

import numpy as np
import pytest

from super_sdf.steps.sharp.patches import Patches, Placed, triangles_of, unfolded

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
