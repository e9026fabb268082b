"""Grids from meshes, exact to closed forms and right in sign; meshes in the figures of papers."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import trimesh
from conftest import refusal
from solids import (
    CUBE_FACES,
    TORUS,
    box_distance,
    cube,
    inverted,
    joined,
    saved,
    sphere,
    square,
    torus,
)

from super_sdf import Mesh, SdfGrid, SuperSdfError, evaluate, load_network, reconstruct, write_mesh
from super_sdf.errors import MeshError, OptionError, OptionTypeError
from super_sdf.truth import Solid, fitted_layout, load_solid, sample_solid

CENTRES = (24, 24, 24), 1 / 24, np.full(3, 0.5 / 24 - 0.5)


def positions(grid: SdfGrid) -> np.ndarray:
    return grid.to_world(np.argwhere(np.ones(grid.shape)))


def torus_distance(points: np.ndarray) -> np.ndarray:
    ring = np.linalg.norm(points[:, :2], axis=1) - TORUS[0]
    return np.hypot(ring, points[:, 2]) - TORUS[1]


SOLIDS = {
    "cube": (cube(), partial(box_distance, half=0.5), 1e-12),
    # Chords lie under the surface: by an eighth of edge^2 over radius, or twice that.
    "sphere": (sphere(size=64), lambda points: np.linalg.norm(points, axis=1) - 0.4, 2.5e-4),
    "torus": (torus(128, 64), torus_distance, 4.5e-4),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_a_sampled_solid_is_exact_everywhere(name):
    mesh, closed_form, chord = SOLIDS[name]
    layout, seen = ((21, 18, 13), 0.071, np.array([-0.71, -0.62, -0.43])), []
    found = sample_solid(Solid(mesh), layout, progress=lambda *step: seen.append(step))
    wanted = closed_form(positions(found))
    np.testing.assert_allclose(found.values.ravel(), wanted, atol=chord + 1e-6)
    assert seen[-1] == (18, 18)  # cubes


def test_big_grids_are_cut_off_and_make_the_same_mesh(monkeypatch):
    solid, layout, limit = Solid(torus()), CENTRES, 2.0 / 24
    exact = sample_solid(solid, layout)
    expected = np.clip(exact.values, -limit, limit)
    np.testing.assert_allclose(sample_solid(solid, layout, band=2).values, expected, atol=1e-7)
    monkeypatch.setattr("super_sdf.truth.EXACT_SAMPLES", 1000)
    cut = sample_solid(solid, layout)
    assert not exact.notes and "clamped" in cut.notes[0]
    assert cut.values.max() == pytest.approx(4 / 24)
    network = load_network("fast")
    one, other = reconstruct(exact, network), reconstruct(cut, network)
    np.testing.assert_array_equal(one.faces, other.faces)
    np.testing.assert_array_equal(one.vertices, other.vertices)


def test_overlapping_pieces_are_one_solid_and_a_cavity_is_no_overlap():
    apart = Mesh(cube().vertices + np.array([0.4, 0, 0]), cube().faces)
    both = Solid(joined(cube(), apart))
    points = np.random.default_rng(2).uniform(-1, 1.2, (1000, 3))
    expected = (box_distance(points, 0.5) < 0) | (box_distance(points - [0.4, 0, 0], 0.5) < 0)
    for far in (0.0, 5.4e6):
        moved = Solid(Mesh(both.mesh.vertices + far, both.mesh.faces))
        assert (moved.is_inside(points + far) == expected).all()
    hollow = Solid(joined(cube(), inverted(Mesh(cube().vertices * 0.5, cube().faces))))
    assert hollow.unbalanced_edges == 0
    assert not hollow.is_inside(np.zeros((1, 3)))[0]


def test_an_inverted_mesh_is_turned_round_and_named(tmp_path):
    solid, notes = load_solid(saved(inverted(cube()), tmp_path / "in.ply"))
    assert notes == ["inverted: its faces point inward; they were reversed"]
    assert solid.signed_distance(np.zeros((1, 3)))[0] == -0.5


@pytest.mark.parametrize("band", [2.0, np.inf])
def test_an_open_mesh_is_refused_or_guessed_at_every_sample(tmp_path, band):
    """Across a hole the sign changes where there is no surface near."""
    lidless = saved(Mesh(cube().vertices, cube().faces[2:]), tmp_path / "open.ply")
    with pytest.raises(SuperSdfError, match=r"open\.ply is open: 4 edges have no partner"):
        load_solid(lidless)
    solid, notes = load_solid(lidless, allow_open=True)
    assert notes == ["open at 4 edges: inside is guessed across the holes"]
    layout = (20, 20, 20), 0.1, np.full(3, -0.97)
    grid = sample_solid(solid, layout, band=band)
    inside = solid.is_inside(positions(grid))
    assert inside.any() and ((grid.values < 0).ravel() == inside).all()


@pytest.mark.parametrize("padding", [0.0, 2.0, 3.5])
def test_the_layout_fits_round_the_box(padding):
    mesh = Mesh(cube().vertices * [3, 1, 2] + 10, cube().faces)
    shape, spacing, origin = fitted_layout(mesh, n=40, padding=padding)
    last = origin + spacing * (np.array(shape) - 1)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    room = np.minimum(low - origin, last - high) / spacing
    assert shape[0] == 40
    assert (room > padding - 1e-4).all() and (room < padding + 1).all()
    np.testing.assert_allclose(low - origin, last - high)  # centred
    assert fitted_layout(mesh, spacing=0.25)[1] == 0.25


@pytest.mark.parametrize("goal", [{"n": 33}, {"spacing": 0.25}, {"spacing": 0.5}], ids=str)
def test_no_face_of_a_box_lies_on_a_plane_of_samples(goal):
    for size in ([3, 1, 2], [2, 2, 2], [4, 3.5, 0.25]):
        mesh = Mesh(cube().vertices * size, cube().faces)
        _, spacing, origin = fitted_layout(mesh, **goal)
        places = (np.stack([mesh.vertices.min(0), mesh.vertices.max(0)]) - origin) / spacing
        assert np.abs(places - np.rint(places)).min() > 0.09


def test_numbers_that_make_no_sense_are_refused():
    with pytest.raises(SuperSdfError, match=r"5 samples leave no room within a padding of 2\.37"):
        fitted_layout(cube(), n=5)
    with pytest.raises(SuperSdfError, match="spacing is nan: it makes nan samples an axis"):
        fitted_layout(cube(), spacing=np.nan)


# Meshes beside references: closed forms, in the figures of papers


NOTHING = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
FLOOR = 1 - np.exp(-1e5 * np.pi * 0.003**2 * 2)  # of 1e5 points on a square with a diagonal of 1


@pytest.mark.parametrize("size", [1, 250.0])
def test_a_shift_in_units_of_the_diagonal_whatever_the_unit(folder, size):
    shift = np.array([0, 0, 0.005 * 2**0.5 * size])
    flat = square().transformed(size * np.eye(3), np.array([3.0, 0, 5]))
    write_mesh(Mesh(flat.vertices + shift, flat.faces), "off.ply")
    library = trimesh.Trimesh(flat.vertices, flat.faces, process=False)
    found = evaluate(["off.ply", library, NOTHING], [flat] * 3)
    assert all(figures.shape == (3,) for figures in found.values())
    assert found["p2s"][:2] == pytest.approx([0.005, 0], abs=1e-6)
    assert found["cd"][0] == pytest.approx(2 * 0.005**2 + 1 / (np.pi * 1e5), rel=0.02)
    assert found["f1"] == pytest.approx([0, FLOOR, 0], abs=0.01)
    assert found["nc"] == pytest.approx([1, 1, 0.5]) and np.isnan(found["ef1"]).all()


def test_edges_are_within_a_tenth_of_the_spacing():
    """A shift leaves the third of the edges along it where they are, but for their ends."""
    shifts = [np.array([share * 0.05, 0, 0]) for share in (0.09, 0.2)]
    moved = [Mesh(cube().vertices + shift, CUBE_FACES) for shift in shifts]
    found = evaluate(moved, [cube()] * 2, spacing=0.05)
    assert found["efv"] == pytest.approx([1, 1 / 3], abs=0.01) and (found["ef1"] > 0.3).all()


@pytest.mark.parametrize(("given", "kind", "said"), [
    (([cube()], [cube()] * 2), OptionError, "there are 1 meshes and 2 references: "
     "give as many of Mesh(vertices, faces) or paths"),
    (([cube()], [NOTHING]), MeshError, "a reference has no area: give a surface"),
    ((None, cube()), OptionTypeError, "mesh is None: give Mesh(vertices, faces) or a path"),
    (([Mesh(cube().vertices * np.inf, CUBE_FACES)], [cube()]), MeshError,
     "a vertex of the mesh is not finite: repair it"),
])  # fmt: skip
def test_what_cannot_be_compared_is_said(given, kind, said):
    assert refusal(kind, evaluate, *given) == said
