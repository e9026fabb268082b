"""The parts for measuring edges: closed solids with edges, the same for the same seed."""

import numpy as np
import pytest
from manifold3d import CrossSection

from export import parts
from export.shapes.edges import CHAMFER
from export.shapes.solid import FAMILIES
from export.tests.test_shapes import check_closed, check_size
from lab.edges import EdgeCurves
from lab.metrics import face_vectors
from super_sdf.truth.solid import load_solid


@pytest.mark.parametrize(
    "number, detail, least, share",
    [*((number, "usual", 3, 8) for number in range(6)), (0, "fine", 6, 60), (4, "fine", 6, 60)],
)
def test_every_part_is_a_solid_with_long_edges(number, detail, least, share):
    """``share`` is their least length squared over the area, of a cube it is 24."""
    name, mesh = parts.draw_part(number, detail=detail)
    assert name.startswith(f"part-{number:02d}-")
    check_closed(mesh)
    check_size(mesh)
    assert 0.1 < mesh.volume() / np.prod(np.ptp(mesh.vertices, axis=0)) < 0.95
    curves = EdgeCurves.of(mesh, (0, 0))
    ends = curves.vertices[curves.edges]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()
    area = np.linalg.norm(face_vectors(mesh), axis=1).sum() / 2
    assert length > least and length**2 > share * area


def test_drills_remove_cylinders_and_fillets_fill_inner_corners_only():
    disc = parts.disc(1).area() / np.pi  # of a polygon of as many corners
    tool = parts.through(0.1, 1).trim_by_plane([0, 0, 1], 0)
    assert tool.volume() == pytest.approx(np.pi * disc * 0.01 * 0.51)
    filled = parts.filled(CrossSection.square([2, 1]) + CrossSection.square([1, 2]), 0.1)
    assert filled.area() - 3 == pytest.approx(0.01 * (1 - np.pi / 4), rel=0.02)
    corners = np.concatenate(filled.to_polygons())
    outer = np.array([[2, 1], [1, 2], [0, 0]])
    assert np.isclose(corners[:, None], outer).all(-1).any(0).all()
    outline = CrossSection.square([1.0, 4.0], True)
    with pytest.raises(ValueError, match=r"^an edge of 0\.6 does not fit the outline$"):
        parts.fine_slab(outline, 2.0, CHAMFER, 0.6, 0)


def test_files_are_the_same_for_the_same_seed_and_no_kind_trains_the_network(tmp_path):
    kinds = {kind.__name__ for kind in parts.KINDS}
    assert len(kinds) == 6 and not kinds & set(FAMILIES)
    parts.main([str(tmp_path / "one"), "--count", "2"])
    again = parts.write_parts(tmp_path / "two", 6)
    other = parts.write_parts(tmp_path / "three", 2, seed=1)
    assert {path.stem.split("-")[2] for path in again} == kinds
    assert all(load_solid(path)[0].is_closed for path in again)
    for path, moved in zip(again, other):
        assert path.read_bytes() == (tmp_path / "one" / path.name).read_bytes()
        assert path.read_bytes() != moved.read_bytes()
