"""Procedural solids: closed, outward, of the promised size, the same for the same seed."""

from __future__ import annotations

import numpy as np
import pytest
from manifold3d import Manifold
from scipy.ndimage import label

from export.shapes import solid as shapes
from export.shapes.draws import unit_sized
from export.shapes.organic import STEP, bumps, grid, put_spikes, relief, skin_waves, wrinkles
from export.shapes.solid import FAMILIES, MAX_FACES, draw_family, random_solid, without_crumbs
from super_sdf import Mesh

SEEDS = range(20)


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


@pytest.mark.parametrize("seed", SEEDS)
def test_random_solid(seed: int) -> None:
    """Solids of many seeds keep every promise."""
    mesh = random_solid(np.random.default_rng(seed))
    assert mesh.vertices.dtype == np.float64 and mesh.faces.dtype == np.int32
    assert np.isfinite(mesh.vertices).all()
    assert 4 <= len(mesh.faces) <= MAX_FACES
    check_closed(mesh)
    check_size(mesh)
    assert mesh.volume() > 5e-5


@pytest.mark.parametrize("name", FAMILIES)
def test_each_family_through_random_solid(name: str) -> None:
    """So do those of each family, with features and bends."""
    for seed in range(3):
        mesh = random_solid(np.random.default_rng(seed), [name])
        check_closed(mesh)
        check_size(mesh)
        assert mesh.volume() > 0


@pytest.mark.parametrize("name", FAMILIES)
def test_family_alone_is_usually_usable(name: str) -> None:
    """A family seldom draws what has to be drawn again."""
    solids = [unit_sized(FAMILIES[name](np.random.default_rng(seed))) for seed in range(8)]
    assert sum(shapes.is_usable(solid) for solid in solids) >= 6


def test_same_seed_same_solid() -> None:
    """Vertices and faces are equal to the last bit."""
    for seed in range(8):
        first, second = (random_solid(np.random.default_rng(seed)) for _ in range(2))
        assert np.array_equal(first.vertices, second.vertices)
        assert np.array_equal(first.faces, second.faces)


def test_only_named_families_are_drawn_each_as_often_as_it_is_named() -> None:
    """Names are drawn from alone, and a repeated one more often."""
    rng = np.random.default_rng(0)
    drawn = [draw_family(rng, ["creature", "sculpture", "sculpture"]) for _ in range(300)]
    assert {family.__name__ for family in drawn} == {"creature", "sculpture"}
    assert drawn.count(FAMILIES["sculpture"]) == pytest.approx(200, abs=30)


@pytest.mark.parametrize("draw", [bumps, skin_waves, wrinkles, relief])
def test_reliefs_are_heights_at_every_point(draw) -> None:
    """One height for each point, none beyond 1 but for the sums of waves, and not all the same."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (4000, 3)).astype(np.float32)
    for seed in range(8):
        heights = draw(np.random.default_rng(seed), points)
        assert heights.shape == (4000,) and np.isfinite(heights).all()
        assert np.abs(heights - 0.5).mean() < 1 and np.ptp(heights) > 0.1


def test_spikes_stick_out_of_a_ball() -> None:
    """Nothing is taken away, and what is added touches the ball."""
    points = grid(0.58, STEP)
    ball = np.linalg.norm(points, axis=-1) - np.float32(0.2)
    spiked = ball.copy()
    put_spikes(np.random.default_rng(3), points, spiked)
    assert (spiked <= ball).all() and ((spiked < 0) & (ball > 0.02)).any()
    assert label(spiked < STEP)[1] == 1  # thorns may be thinner than a step


def test_gives_up_on_unusable_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search is bounded and ends in an error."""
    monkeypatch.setattr(shapes, "draw_family", lambda rng, names: lambda rng: Manifold())
    with pytest.raises(RuntimeError, match="none of 20"):
        random_solid(np.random.default_rng(0))


def test_crumbs_go_and_cavities_stay() -> None:
    """A small loose piece goes; a cavity, a piece of its own to the faces, stays."""
    box = Manifold.cube([1, 1, 1], True)
    hollow = box - box.scale([0.8, 0.8, 0.8])
    crumb = Manifold.cube([0.1, 0.1, 0.1]).translate([2, 0, 0])
    mesh = without_crumbs(shapes.mesh_of(hollow + crumb))
    check_closed(mesh)
    assert mesh.volume() == pytest.approx(1 - 0.8**3)
    assert mesh.vertices.max() == 0.5
