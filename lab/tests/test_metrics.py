"""The measures against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from solids import cube, inverted, sphere, square

from lab import metrics
from lab.surfaces import EMPTY
from super_sdf import Mesh
from super_sdf.truth.solid import Solid

N = metrics.SAMPLE_COUNT


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


def test_samples_are_uniform_in_area_and_lie_on_the_surface() -> None:
    stretched = Mesh(cube().vertices * [1, 2, 3], cube().faces)  # faces of 2, 3 and 6
    drawn = metrics.sample_surface(stretched, (7, 0))
    shares = np.abs(drawn.normals).mean(0)
    np.testing.assert_allclose(shares, np.array([6, 3, 2]) / 11, atol=0.01)
    assert metrics.distance_or_dot(Solid(stretched), drawn.points).max() < 1e-12
    np.testing.assert_allclose(drawn.points.mean(0), 0, atol=0.01)


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


def test_a_shape_inside_out_has_opposite_normals() -> None:
    outside = metrics.sample_surface(sphere(), (7, 0))
    inside = metrics.sample_surface(inverted(sphere()), (7, 0))
    figures = metrics.compare_samples(outside, inside)
    assert figures["nc"] == pytest.approx(1, abs=0.001)
    assert figures["signed_nc"] == pytest.approx(-1, abs=0.001)


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
