"""Procedural solids: closed, outward, of the promised size, the same for the same seed."""

import numpy as np
import pytest
from manifold3d import Manifold
from scipy.ndimage import label

from export.shapes import solid as shapes
from export.shapes.draws import unit_sized
from export.shapes.organic import STEP, bumps, grid, put_spikes, relief, skin_waves, wrinkles
from export.shapes.solid import FAMILIES, MAX_FACES, draw_family, random_solid, without_crumbs
from super_sdf import Mesh


def check_closed(mesh: Mesh) -> None:
    """Each directed edge occurs once, and so does its opposite; every vertex is used."""
    edges = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    there = {tuple(edge) for edge in edges.tolist()}
    assert len(there) == len(edges)
    assert there == {(b, a) for a, b in there}
    assert np.array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)))


def check_size(mesh: Mesh) -> None:
    """The bounding box is centred at the origin and has a diagonal of 1."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    assert np.linalg.norm(high - low) == pytest.approx(1, abs=1e-12)
    assert low == pytest.approx(-high, abs=1e-12)


@pytest.mark.parametrize("names", [None, *([name] for name in FAMILIES)], ids=str)
def test_random_solids_keep_every_promise_and_are_the_same_for_the_same_seed(names):
    for seed in range(1 if names else 4):
        mesh, again = (random_solid(np.random.default_rng(seed), names) for _ in range(2))
        assert mesh.vertices.dtype == np.float64 and mesh.faces.dtype == np.int32
        assert np.isfinite(mesh.vertices).all() and 4 <= len(mesh.faces) <= MAX_FACES
        check_closed(mesh)
        check_size(mesh)
        assert mesh.volume() > 5e-5
        assert np.array_equal(mesh.vertices, again.vertices)
        assert np.array_equal(mesh.faces, again.faces)


@pytest.mark.parametrize("name", FAMILIES)
def test_a_family_seldom_draws_what_has_to_be_drawn_again(name):
    solids = [unit_sized(FAMILIES[name](np.random.default_rng(seed))) for seed in range(3)]
    assert sum(shapes.is_usable(solid) for solid in solids) >= 2


def test_only_named_families_are_drawn_each_as_often_as_it_is_named(monkeypatch):
    rng = np.random.default_rng(0)
    drawn = [draw_family(rng, ["creature", "sculpture", "sculpture"]) for _ in range(300)]
    assert {family.__name__ for family in drawn} == {"creature", "sculpture"}
    assert drawn.count(FAMILIES["sculpture"]) == pytest.approx(200, abs=30)
    monkeypatch.setattr(shapes, "draw_family", lambda rng, names: lambda rng: Manifold())
    with pytest.raises(RuntimeError, match="none of 20"):  # the search is bounded
        random_solid(np.random.default_rng(0))


@pytest.mark.parametrize("draw", [bumps, skin_waves, wrinkles, relief])
def test_reliefs_are_heights_at_every_point(draw):
    """One height for each point, none beyond 1 but for the sums of waves, and not all the same."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (4000, 3)).astype(np.float32)
    for seed in range(8):
        heights = draw(np.random.default_rng(seed), points)
        assert heights.shape == (4000,) and np.isfinite(heights).all()
        assert np.abs(heights - 0.5).mean() < 1 and np.ptp(heights) > 0.1


def test_spikes_stick_out_of_a_ball():
    """Nothing is taken away, and what is added touches the ball."""
    points = grid(0.58, STEP)
    ball = np.linalg.norm(points, axis=-1) - np.float32(0.2)
    spiked = ball.copy()
    put_spikes(np.random.default_rng(3), points, spiked)
    assert (spiked <= ball).all() and ((spiked < 0) & (ball > 0.02)).any()
    assert label(spiked < STEP)[1] == 1  # thorns may be thinner than a step


def test_crumbs_go_and_cavities_stay():
    """A small loose piece goes; a cavity, a piece of its own to the faces, stays."""
    box = Manifold.cube([1, 1, 1], True)
    crumb = Manifold.cube([0.1, 0.1, 0.1]).translate([2, 0, 0])
    mesh = without_crumbs(shapes.mesh_of(box - box.scale([0.8, 0.8, 0.8]) + crumb))
    check_closed(mesh)
    assert mesh.volume() == pytest.approx(1 - 0.8**3) and mesh.vertices.max() == 0.5
