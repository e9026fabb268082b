"""The parts for measuring edges: closed solids with edges, the same for the same seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export import parts
from export.shapes.families import FAMILIES
from export.tests.test_shapes import check_closed, check_size
from super_sdf.evaluation.edges import EdgeCurves
from super_sdf.evaluation.metrics import face_vectors
from super_sdf.truth.solid import load_solid


@pytest.mark.parametrize("number", range(parts.COUNT))
def test_every_part_is_a_solid_with_edges(number: int) -> None:
    name, mesh = parts.draw_part(number)
    assert name.startswith(f"part-{number:02d}-")
    check_closed(mesh)
    check_size(mesh)
    box = float(np.prod(np.ptp(mesh.vertices, axis=0)))
    assert 0.1 * box < mesh.volume() < 0.95 * box
    curves = EdgeCurves.of(mesh, (0, 0))
    ends = curves.vertices[curves.edges]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()
    area = np.linalg.norm(face_vectors(mesh), axis=1).sum() / 2
    assert length > 6 and length**2 > 60 * area  # a cube's is 24 times its area


def test_a_drill_removes_a_cylinder_and_two_cones() -> None:
    tool = parts.through(0.1, 1, 0.03)
    disc = parts.disc(1).area() / np.pi  # of a polygon of as many corners
    cone = np.pi * disc * 0.03 * (0.1**2 + 0.1 * 0.13 + 0.13**2) / 3
    inside = tool ^ parts.Manifold.cube([1, 1, 1], True)
    assert inside.volume() == pytest.approx(np.pi * disc * 0.01 * (1 - 0.06) + 2 * cone, rel=1e-6)


def test_fillets_fill_inner_corners_only() -> None:
    corner = parts.CrossSection.square([2, 1]) + parts.CrossSection.square([1, 2])
    assert parts.filled(corner, 0.1).area() - 3 == pytest.approx(0.01 * (1 - np.pi / 4), rel=0.02)
    square = parts.CrossSection.square([1, 1])
    assert parts.filled(square, 0.1).area() == pytest.approx(1, abs=1e-3)


def test_no_kind_trains_the_network() -> None:
    assert not set(parts.KINDS) & set(FAMILIES)
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


def test_parts_of_a_kind_differ() -> None:
    volumes = {round(parts.draw_part(number)[1].volume(), 6) for number in range(parts.COUNT)}
    assert len(volumes) == parts.COUNT
