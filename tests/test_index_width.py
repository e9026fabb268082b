"""What is numbered fits in 32 bits: more slabs, or a refusal with the figure."""

import numpy as np
import pytest
from conftest import ball, trilinear

from super_sdf import SdfGrid, load_network, reconstruct, upsample
from super_sdf.errors import OptionError
from super_sdf.machine import index_width
from super_sdf.slabs.cutting import check_vertices, most_nodes, plan_slabs
from super_sdf.steps.marching import _lattice_edges, extract_mesh
from super_sdf.steps.nodes import number_shared_nodes
from super_sdf.steps.survey import Band, survey


def wall(side):
    """One plane of voxels that holds a whole surface: a band that takes hardly any memory."""
    ijk = np.zeros((side * side, 3), np.int32)
    ijk[:, 1:] = np.indices((side, side), np.int32).reshape(2, -1).T
    yes = np.ones(len(ijk), bool)
    patches = np.broadcast_to(np.linspace(-1, 1, 27, dtype=np.float32), (len(ijk), 27))
    return Band((2, side, side), ijk, patches, yes, yes, yes)


def test_a_wall_of_more_nodes_than_can_be_numbered_is_refused_before_the_work():
    """At factor 16 its 17 * 11,665^2 nodes were counted as -1,981,739,471."""
    nodes = 729**2 * 17**3
    assert nodes > 17 * (16 * 729 + 1) ** 2 > index_width.LARGEST
    for field in (7, None):
        with pytest.raises(OptionError, match=rf"^factor 16 makes {nodes:,} nodes .*2,147,483,647"):
            plan_slabs(wall(729), 16, field, None)
    assert len(plan_slabs(wall(729), 8, 7, None)) == 1


def test_more_nodes_than_can_be_numbered_at_once_make_slabs_and_the_same_mesh(monkeypatch):
    grid, network = ball(40, 16.0), load_network("fast")
    one = reconstruct(grid, network, 2)
    band = survey(grid)
    whole = most_nodes(band, plan_slabs(band, 2, 7, None), 2)
    monkeypatch.setattr(index_width, "LARGEST", int(0.8 * whole))
    slabs = plan_slabs(band, 2, 7, None)
    assert len(slabs) > 1 and most_nodes(band, slabs, 2) <= index_width.LARGEST
    many = reconstruct(grid, network, 2)
    np.testing.assert_array_equal(many.faces, one.faces)
    np.testing.assert_array_equal(many.vertices, one.vertices)
    with pytest.raises(OptionError, match="nodes at once"):
        plan_slabs(band, 2, None, None)


@pytest.mark.parametrize("compiled", "01")
def test_nodes_are_counted_beyond_32_bits(monkeypatch, compiled):
    """Of a stand-in for a large table: voxels that share nothing, with parts of many nodes."""
    monkeypatch.setenv("SUPER_SDF_COMPILED", compiled)
    reconstruct(ball(), trilinear, 2)  # so that the compiled functions are loaded
    table = np.full((5, 27), -1, np.int32)
    table[:, 13] = np.arange(5)
    monkeypatch.setattr("super_sdf.steps.nodes.nodes_of_part", lambda factor: [range(10**8)] * 27)
    with pytest.raises(OptionError, match=r"^factor 16 makes 13,500,000,000 nodes in a slab, and "):
        number_shared_nodes(table, 16)


def test_vertices_are_refused_before_they_would_wrap():
    """Those of earlier slabs among them, up to the last number that there is."""
    field = upsample(ball(), trilinear, 2)
    room = index_width.LARGEST - len(extract_mesh(field, ball()).vertices)
    assert extract_mesh(field, ball(), first_vertex=room).faces.min() == room
    with pytest.raises(OptionError, match=r"^factor 2 makes 2,147,483,648 vertices, and 2,147,483"):
        extract_mesh(field, ball(), first_vertex=room + 1)


def test_far_too_many_vertices_are_refused_before_the_network_runs(monkeypatch):
    band = survey(ball(30, 11.0))
    vertices = len(reconstruct(ball(30, 11.0), trilinear, 4).vertices)
    estimate = band.count_crossings() * 4**2
    assert 0.8 < estimate / vertices < 1.25
    monkeypatch.setattr(index_width, "LARGEST", estimate // 2)
    check_vertices(band, 4)
    monkeypatch.setattr(index_width, "LARGEST", estimate // 2 - 1)
    with pytest.raises(OptionError, match=rf"makes {estimate // 2:,} vertices, at the least, and"):
        check_vertices(band, 4)


def test_the_edges_of_the_last_node_that_can_be_numbered_are_found():
    node = np.array([index_width.LARGEST], np.int32)
    assert _lattice_edges(node, 7).tolist() == [3 * (2**31 - 1 - 7)]


@pytest.mark.parametrize("compiled", "01")
@pytest.mark.parametrize("factor", [2, 4])
def test_a_plane_that_holds_everything_is_meshed_in_chunks_to_the_same_mesh(
    monkeypatch, compiled, factor
):
    monkeypatch.setenv("SUPER_SDF_COMPILED", compiled)
    i, j, k = np.indices((8, 20, 20)).astype(np.float64)
    grid = SdfGrid(np.abs(i - 3.6) - 1.3 + 0.01 * np.sin(j + k), 1.0)
    meshes = []
    for chunk in (1 << 19, 2000):
        monkeypatch.setattr("super_sdf.machine.threads.CHUNK", chunk)
        meshes.append(reconstruct(grid, trilinear, factor, cap=True))
    np.testing.assert_array_equal(meshes[0].faces, meshes[1].faces)
    np.testing.assert_array_equal(meshes[0].vertices, meshes[1].vertices)
    assert meshes[0].is_closed()
