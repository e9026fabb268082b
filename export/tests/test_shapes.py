"""Shapes: closed, outward, of the promised size, the same for the same seed; exact distances."""

import numpy as np
import pytest
import trimesh

from export import dataset, edges, parts
from export.shapes.smooth import draw_smooth, ellipsoid, foot_points, settle, torus
from export.shapes.solid import FAMILIES, MAX_FACES, draw_family, random_solid
from super_sdf import Mesh
from super_sdf.check import examine_surface
from super_sdf.truth import Solid


def check_solid(mesh: Mesh) -> None:
    """It is closed, and its box is centred at the origin and has a diagonal of 1."""
    found = examine_surface(mesh)
    assert (found.open_edges, found.flipped_edges, found.crowded_edges) == (0, 0, 0)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    assert np.linalg.norm(high - low) == pytest.approx(1, abs=1e-12)
    assert low == pytest.approx(-high, abs=1e-12)


@pytest.mark.parametrize("name", FAMILIES)
def test_random_solids_keep_every_promise_and_are_the_same_for_the_same_seed(name):
    mesh, again = (random_solid(np.random.default_rng(0), [name]) for _ in range(2))
    assert mesh.vertices.dtype == np.float64 and 4 <= len(mesh.faces) <= MAX_FACES
    check_solid(mesh)
    assert mesh.volume() > 5e-5
    assert np.array_equal(mesh.vertices, again.vertices)
    assert draw_family(np.random.default_rng(1), [name]) is FAMILIES[name]


@pytest.mark.parametrize("number", range(6))
def test_every_part_is_a_solid_of_a_kind_that_trains_no_network(tmp_path, number):
    name, mesh = parts.draw_part(number)
    assert np.array_equal(mesh.vertices, parts.draw_part(number)[1].vertices)
    assert name.startswith(f"part-{number:02d}-") and name.split("-")[2] not in FAMILIES
    check_solid(mesh)
    assert 0.1 < mesh.volume() / np.prod(np.ptp(mesh.vertices, axis=0)) < 0.95


def test_distances_to_smooth_bodies_are_exact():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)) * 11
    found, off = settle(ellipsoid(np.full(3, 20.0)), points)
    np.testing.assert_allclose(found, np.linalg.norm(points, axis=1) - 20, atol=1e-9)
    assert off.max() < 1e-9
    ring = np.hypot(np.hypot(*points.T[:2]) - 30, points[:, 2]) - 6
    near = np.abs(ring) < 5
    np.testing.assert_allclose(settle(torus(30, 6), points[near])[0], ring[near], atol=1e-9)
    for _ in range(20):  # no point of the surface is nearer than the foot point
        field = draw_smooth(rng, 1)
        middle = foot_points(field, rng.normal(size=(1, 3)) * 40)
        points = middle + rng.uniform(-1.5, 1.5, (200, 3))
        distance, off = settle(field, points)
        others = foot_points(field, middle + rng.uniform(-3, 3, (400, 3)))
        least = np.linalg.norm(points[:, None] - others, axis=2).min(1)
        assert off.max() > 1e-3 or (np.abs(distance) <= least + 1e-6).all()


def test_smooth_samples_are_inverted_half_of_the_time_and_end_before_the_border():
    drawn = [dataset.make_smooth_sample(np.random.default_rng(seed), 6) for seed in range(12)]
    ijk = np.concatenate([sample.voxel_ijk for sample in drawn])
    assert ijk.min() == dataset.EDGE and ijk.max() == dataset.WINDOW - 1 - dataset.EDGE
    assert all((sample.targets < 0).any() and (sample.targets > 0).any() for sample in drawn)


def test_signs_are_right_where_a_mesh_intersects_itself():
    """Of two boxes that overlap."""
    low = np.array([[-0.3, -0.2, -0.1], [-0.1, -0.1, -0.05]])
    high = np.array([[0.4, 0.3, 0.2], [0.6, 0.2, 0.1]])
    boxes = [trimesh.creation.box(bounds=bounds) for bounds in zip(low, high)]
    both, rng = trimesh.util.concatenate(boxes), np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.7, (4000, 3))
    inside = ((points[:, None] > low) & (points[:, None] < high)).all(2).any(1)
    truth = Solid(Mesh(np.array(both.vertices), np.array(both.faces, np.int32)))
    np.testing.assert_array_equal(dataset.signed_distance(rng, truth, points) < 0, inside)


def test_thin_solids_have_hardly_a_sample_inside():
    options = dataset.parser_of_options().parse_args(["--out", "none", "--thin", "1"])
    samples = dataset.fill_shard(np.random.default_rng(0), [], 2, options)
    assert all(-0.2 < sample.window.min() / 2 < 0.6 for sample in samples)
    assert all((sample.targets < 0).any() for sample in samples)


def test_the_rule_for_edges_is_fitted_to_what_is_lost(tmp_path, capsys):
    edges.main(f"--count 1 --out {tmp_path / 'rows.npz'}".split())
    losses = [float(line.split()[1]) for line in capsys.readouterr().out.splitlines()[1:]]
    assert losses[1] <= min(losses[0], losses[2])  # the rule's, not that of the middle or the edge
