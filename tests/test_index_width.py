"""Counts of nodes and vertices beyond 32-bit indices are refused, with the count."""

import numpy as np
import pytest
from conftest import ball, trilinear

from super_sdf import SdfGrid, extract_mesh, reconstruct, upsample
from super_sdf.errors import OptionError
from super_sdf.machine import resources
from super_sdf.slabs.cutting import check_vertices
from super_sdf.steps.nodes import number_parts, share_parts
from super_sdf.steps.survey import count_crossings, survey


def test_nodes_are_counted_beyond_32_bits():
    """A few voxels that share nothing, with very many nodes per part, stand in for a large grid."""
    table = np.full((5, 27), -1, np.int32)
    table[:, 13] = np.arange(5)
    parts = share_parts(table)
    with pytest.raises(OptionError, match=r"^there are 13,500,000,000 nodes, but 32-bit indices "):
        number_parts(parts, np.full(27, 10**8))
    starts, count = number_parts(parts, np.full(27, 10**7))
    assert count == 135 * 10**7 and starts.max() == 134 * 10**7


def test_too_many_vertices_are_refused_before_an_index_overflows():
    """The vertices of earlier slabs count, and the last valid index is used."""
    field = upsample(ball(), trilinear, 2)
    room = resources.MAX_INDEX - len(extract_mesh(field, ball()).vertices)
    assert extract_mesh(field, ball(), first_vertex=room).faces.min() == room
    message = r"^there are 2,147,483,648 vertices, but 32-bit indices allow only 2,147,483,647: use"
    with pytest.raises(OptionError, match=message):
        extract_mesh(field, ball(), first_vertex=room + 1)


def test_far_too_many_vertices_are_refused_before_the_network_runs(monkeypatch):
    band = survey(ball(24, 9.0))
    vertices = len(reconstruct(ball(24, 9.0), trilinear, 4).vertices)
    estimate = count_crossings(band.patches) * 4**2
    assert 0.8 < estimate / vertices < 1.25
    monkeypatch.setattr(resources, "MAX_INDEX", estimate // 2)
    check_vertices(band, 4)
    monkeypatch.setattr(resources, "MAX_INDEX", estimate // 2 - 1)
    with pytest.raises(OptionError, match=rf"there are {estimate // 2:,} vertices or more, but"):
        check_vertices(band, 4)


def test_a_plane_that_holds_everything_is_meshed_in_chunks_to_the_same_mesh(monkeypatch):
    i, j, k = np.indices((8, 16, 16)).astype(np.float64)
    grid = SdfGrid(np.abs(i - 3.6) - 1.3 + 0.01 * np.sin(j + k), 1.0)
    meshes = []
    for chunk in (1 << 19, 2000):
        monkeypatch.setattr(resources, "CHUNK", chunk)
        meshes.append(reconstruct(grid, trilinear, 2, cap=True))
    np.testing.assert_array_equal(meshes[0].faces, meshes[1].faces)
    np.testing.assert_array_equal(meshes[0].vertices, meshes[1].vertices)
    assert meshes[0].is_closed()
