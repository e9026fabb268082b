"""The parts for measuring edges: closed solids with edges, the same for the same seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from manifold3d import CrossSection, Manifold

from export import part_tools, parts, usual_parts
from export.shapes.edges import CHAMFER
from export.shapes.families import FAMILIES
from export.tests.test_shapes import check_closed, check_size
from lab.edges import EdgeCurves
from lab.metrics import face_vectors, sample_surface
from super_sdf import Mesh
from super_sdf.truth.solid import load_solid

# Least length of the sharp edges, and least square of it over the area: a cube's is 24.
EDGES = {"usual": (3, 8), "fine": (6, 60)}


@pytest.mark.parametrize("detail", parts.DETAILS)
@pytest.mark.parametrize("number", range(parts.COUNT))
def test_every_part_is_a_solid_with_edges(number: int, detail: str) -> None:
    name, mesh = parts.draw_part(number, detail=detail)
    assert name.startswith(f"part-{number:02d}-")
    check_closed(mesh)
    check_size(mesh)
    box = float(np.prod(np.ptp(mesh.vertices, axis=0)))
    assert 0.1 * box < mesh.volume() < 0.95 * box
    curves = EdgeCurves.of(mesh, (0, 0))
    ends = curves.vertices[curves.edges]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()
    area = np.linalg.norm(face_vectors(mesh), axis=1).sum() / 2
    least, share = EDGES[detail]
    assert length > least and length**2 > share * area


def thin(mesh: Mesh) -> float:
    """Return how thick a part is below all but a twentieth of its surface."""
    drawn = sample_surface(mesh, (0, 0))
    below, inward = drawn.points[:1000] - 1e-4 * drawn.normals[:1000], -drawn.normals[:1000]
    way = [first_hit(mesh, *ray) for ray in zip(below, inward)]
    return float(np.quantile([far for far in way if np.isfinite(far)], 0.05))


def first_hit(mesh: Mesh, start: np.ndarray, ray: np.ndarray) -> float:
    """Return how far a ray of unit length goes to the first triangle (Moeller and Trumbore)."""
    a, b, c = mesh.vertices[mesh.faces.T]
    across = np.cross(ray, c - a)
    det = np.einsum("ij,ij->i", b - a, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("ij,ij->i", start - a, across) / det
        beside = np.cross(start - a, b - a)
        v, far = beside @ ray / det, np.einsum("ij,ij->i", c - a, beside) / det
        hit = (np.abs(det) > 1e-14) & (u >= 0) & (v >= 0) & (u + v <= 1) & (far > 0)
    return float(far[hit].min(initial=np.inf))


def test_features_are_thicker_than_two_voxels_but_for_the_fine_ones() -> None:
    """In a grid of 32^3 a voxel is about 0.037 of a turned part's diagonal."""
    usual, fine = (
        np.median([thin(parts.draw_part(n, detail=detail)[1]) for n in range(12)])
        for detail in ("usual", "fine")
    )
    assert usual > 2 * 0.037 and fine < 1.5 * 0.037


def test_a_drill_removes_a_cylinder_and_two_cones() -> None:
    tool = part_tools.through(0.1, 1, 0.03)
    disc = part_tools.disc(1).area() / np.pi  # of a polygon of as many corners
    cone = np.pi * disc * 0.03 * (0.1**2 + 0.1 * 0.13 + 0.13**2) / 3
    inside = tool ^ Manifold.cube([1, 1, 1], True)
    assert inside.volume() == pytest.approx(np.pi * disc * 0.01 * (1 - 0.06) + 2 * cone, rel=1e-6)


def test_fillets_fill_inner_corners_only() -> None:
    corner = CrossSection.square([2, 1]) + CrossSection.square([1, 2])
    assert part_tools.filled(corner, 0.1).area() - 3 == pytest.approx(
        0.01 * (1 - np.pi / 4), rel=0.02
    )
    square = CrossSection.square([1, 1])
    assert part_tools.filled(square, 0.1).area() == pytest.approx(1, abs=1e-3)


def test_no_kind_trains_the_network() -> None:
    kinds = {kind.__name__ for kinds in parts.DETAILS.values() for kind in kinds}
    assert len(kinds) == 6 and not kinds & set(FAMILIES)
    assert len({parts.draw_part(number)[0].split("-")[2] for number in range(6)}) == 6


def test_files_are_the_same_for_the_same_seed(tmp_path: Path) -> None:
    parts.main([str(tmp_path / "one"), "--count", "6"])
    again = parts.write_parts(tmp_path / "two", 6)
    other = parts.write_parts(tmp_path / "three", 6, seed=1)
    assert len(again) == 6
    for path, moved in zip(again, other):
        assert path.read_bytes() == (tmp_path / "one" / path.name).read_bytes()
        assert path.read_bytes() != moved.read_bytes()
        solid, _ = load_solid(path)
        assert solid.is_closed


def test_the_command_writes_fine_parts_when_asked(tmp_path: Path) -> None:
    parts.main([str(tmp_path / "fine"), "--count", "1", "--detail", "fine"])
    (usual,) = parts.write_parts(tmp_path / "usual", 1)
    assert (tmp_path / "fine" / usual.name).read_bytes() != usual.read_bytes()


def test_parts_of_a_kind_differ() -> None:
    volumes = {round(parts.draw_part(number)[1].volume(), 6) for number in range(parts.COUNT)}
    assert len(volumes) == parts.COUNT


def test_an_edge_that_does_not_fit_its_outline_is_refused() -> None:
    outline = CrossSection.square([1.0, 4.0], True)
    with pytest.raises(ValueError, match=r"^an edge of 0\.6 does not fit the outline$"):
        usual_parts.fine_slab(outline, 2.0, CHAMFER, 0.6, 0)


def test_fillets_leave_outer_corners_as_they_are() -> None:
    outline = CrossSection.square([4.0, 1.0], True) + CrossSection.square([1.0, 4.0], True)
    corners = np.concatenate(part_tools.filled(outline, 0.5).to_polygons())
    outer = np.array([[2, 0.5], [0.5, 2]])
    assert np.isclose(corners[:, None], outer).all(-1).any(0).all()
