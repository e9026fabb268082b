"""Meshes beside references: closed forms, in the figures of papers."""

import numpy as np
import pytest
from conftest import refusal
from solids import CUBE_FACES, cube, square

from super_sdf import Mesh, evaluate, write_mesh
from super_sdf.errors import MeshError, OptionError

NOTHING = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
FLOOR = 1 - np.exp(-1e5 * np.pi * 0.003**2 * 2)  # of 1e5 points on a square with a diagonal of 1


@pytest.mark.parametrize("size", [1, 250.0])
def test_a_shift_in_units_of_the_diagonal_whatever_the_unit(folder, size):
    shift = np.array([0, 0, 0.005 * 2**0.5 * size])
    flat = square().transformed(size * np.eye(3), np.array([3.0, 0, 5]))
    write_mesh(Mesh(flat.vertices + shift, flat.faces), "off.ply")
    found = evaluate(["off.ply", flat, NOTHING], [flat] * 3)
    assert all(figures.shape == (3,) for figures in found.values())
    assert found["p2s"][:2] == pytest.approx([0.005, 0], abs=1e-6)
    assert found["cd"][0] == pytest.approx(2 * 0.005**2 + 1 / (np.pi * 1e5), rel=0.02)
    assert found["f1"] == pytest.approx([0, FLOOR, 0], abs=0.01)
    assert found["nc"] == pytest.approx([1, 1, 0.5]) and np.isnan(found["ef1"]).all()


@pytest.mark.parametrize(("share", "efv"), [(0.09, 1.0), (0.2, 1 / 3)])
def test_edges_are_within_a_tenth_of_the_spacing(share, efv):
    """A shift leaves the third of the edges along it where they are, but for their ends."""
    moved = Mesh(cube().vertices + np.array([share * 0.05, 0, 0]), CUBE_FACES)
    found = evaluate(moved, cube(), spacing=0.05)
    assert found["efv"] == pytest.approx([efv], abs=0.01) and found["ef1"] > 0.3
    assert np.isnan(evaluate(moved, cube())["efv"]).all()


@pytest.mark.parametrize(("given", "kind", "said"), [
    (([cube()], [cube()] * 2), OptionError, "there are 1 meshes and 2 references: give as many"),
    (([cube()], [NOTHING]), MeshError, "a reference has no area: give a surface"),
    (([Mesh(cube().vertices * np.inf, CUBE_FACES)], [cube()]), MeshError,
     "a vertex of the mesh is not finite: repair it"),
])  # fmt: skip
def test_what_cannot_be_compared_is_said(given, kind, said):
    assert refusal(kind, evaluate, *given) == said
