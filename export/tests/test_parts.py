"""The parts for measuring edges: closed solids with edges, the same for the same seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from manifold3d import CrossSection

from export import parts
from export.shapes.edges import CHAMFER
from export.shapes.solid import FAMILIES
from export.tests.test_shapes import check_closed, check_size
from lab.edges import EdgeCurves
from lab.metrics import face_vectors
from super_sdf import Mesh
from super_sdf.truth.solid import load_solid


def check_edges(mesh: Mesh, least: float, share: float) -> None:
    """The sharp edges are long: ``share`` is least square over the area, of a cube it is 24."""
    check_closed(mesh)
    check_size(mesh)
    assert 0.1 < mesh.volume() / np.prod(np.ptp(mesh.vertices, axis=0)) < 0.95
    curves = EdgeCurves.of(mesh, (0, 0))
    ends = curves.vertices[curves.edges]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()
    area = np.linalg.norm(face_vectors(mesh), axis=1).sum() / 2
    assert length > least and length**2 > share * area


@pytest.mark.parametrize("number", range(parts.COUNT))
def test_every_part_is_a_solid_with_edges(number: int) -> None:
    name, mesh = parts.draw_part(number)
    assert name.startswith(f"part-{number:02d}-")
    check_edges(mesh, 3, 8)


@pytest.mark.parametrize("number", range(6))
def test_fine_parts_have_many_edges(number: int) -> None:
    check_edges(parts.draw_part(number, detail="fine")[1], 6, 60)


def test_a_drill_removes_a_cylinder() -> None:
    disc = parts.disc(1).area() / np.pi  # of a polygon of as many corners
    tool = parts.through(0.1, 1).trim_by_plane([0, 0, 1], 0)
    assert tool.volume() == pytest.approx(np.pi * disc * 0.01 * 0.51)


def test_fillets_fill_inner_corners_only() -> None:
    corner = CrossSection.square([2, 1]) + CrossSection.square([1, 2])
    filled = parts.filled(corner, 0.1)
    assert filled.area() - 3 == pytest.approx(0.01 * (1 - np.pi / 4), rel=0.02)
    outer = np.array([[2, 1], [1, 2], [0, 0]])
    corners = np.concatenate(filled.to_polygons())
    assert np.isclose(corners[:, None], outer).all(-1).any(0).all()


def test_no_kind_trains_the_network_and_parts_of_a_kind_differ() -> None:
    kinds = {kind.__name__ for kind in parts.KINDS}
    assert len(kinds) == 6 and not kinds & set(FAMILIES)
    drawn = [parts.draw_part(number) for number in range(12)]
    assert {name.split("-")[2] for name, _ in drawn} == kinds
    assert len({round(mesh.volume(), 6) for _, mesh in drawn}) == 12


def test_files_are_the_same_for_the_same_seed(tmp_path: Path) -> None:
    parts.main([str(tmp_path / "one"), "--count", "6"])
    parts.main([str(tmp_path / "fine"), "--count", "1", "--detail", "fine"])
    again = parts.write_parts(tmp_path / "two", 6)
    other = parts.write_parts(tmp_path / "three", 6, seed=1)
    assert len(again) == 6
    for path, moved in zip(again, other):
        assert path.read_bytes() == (tmp_path / "one" / path.name).read_bytes()
        assert path.read_bytes() != moved.read_bytes()
        assert load_solid(path)[0].is_closed
    assert (tmp_path / "fine" / again[0].name).read_bytes() != again[0].read_bytes()


def test_an_edge_that_does_not_fit_its_outline_is_refused() -> None:
    outline = CrossSection.square([1.0, 4.0], True)
    with pytest.raises(ValueError, match=r"^an edge of 0\.6 does not fit the outline$"):
        parts.fine_slab(outline, 2.0, CHAMFER, 0.6, 0)
