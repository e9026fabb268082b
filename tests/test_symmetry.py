"""The symmetries of the cube, and networks averaged over them."""

import numpy as np
import pytest
from conftest import ball

from super_sdf import load_network
from super_sdf.neighbourhood import NEIGHBOURHOOD, cube_symmetries, turn
from super_sdf.steps.band import find_band, gather_patches, neighbour_table, rescale
from super_sdf.steps.nodes import block_offsets


def test_the_symmetries_are_a_group_of_48_with_half_turns_first_then_reflections():
    group = cube_symmetries()
    assert len({symmetry.tobytes() for symmetry in group}) == 48
    np.testing.assert_array_equal(group[0], np.eye(3))
    for symmetry in group:
        np.testing.assert_array_equal(symmetry @ symmetry.T, np.eye(3))
        assert {(symmetry @ other).tobytes() for other in group} == {g.tobytes() for g in group}
    assert (np.abs(group[:8]) == np.eye(3)).all()
    assert np.linalg.det(group[:4]).tolist() == [1, 1, 1, 1]


def test_a_turned_plane_is_a_plane():
    normal = np.array([0.5, -0.3, 0.8])
    patches = (NEIGHBOURHOOD @ normal).astype(np.float32)[None]
    table = np.arange(27, dtype=np.int32)[None]
    for symmetry in cube_symmetries():
        turned, places, offsets = turn(symmetry, patches, table, block_offsets(2))
        np.testing.assert_allclose(turned[0], NEIGHBOURHOOD @ symmetry @ normal, atol=1e-6)
        np.testing.assert_array_equal(turned[0], patches[0, places[0]])
        np.testing.assert_allclose(offsets @ symmetry, block_offsets(2), atol=1e-6)


@pytest.mark.parametrize(
    ("symmetries", "flipped"),
    [(4, (0, 1)), (4, (1, 2)), (8, (0, 1, 2))],
    ids=["half turn about z", "about x", "inverted"],
)
def test_a_mean_maps_a_turned_field_to_the_turned_surface(symmetries, flipped):
    """The plain network does so only approximately; otherwise the mean would have no effect."""
    field, nodes = rescale(ball(16, 5.0)), tuple(axis + 3 for axis in flipped)
    plain, apart = load_network("fast"), {}

    def dense_values(network, field):
        """Return the values at the nodes of every voxel of the band, NaN elsewhere."""
        voxels = find_band(field)
        rows = np.arange(len(voxels), dtype=np.int32)
        table = neighbour_table(voxels, field.shape)
        values = network(gather_patches(field, voxels), table, rows, block_offsets(2))
        dense = np.full((*field.shape, 3, 3, 3), np.nan, np.float32)
        dense[tuple(voxels.T)] = values.reshape(-1, 3, 3, 3)
        return dense

    for network in (plain, plain.averaged(symmetries)):
        turned = dense_values(network, np.ascontiguousarray(np.flip(field, flipped)))
        off = np.abs(np.flip(turned, flipped + nodes) - dense_values(network, field))
        apart[network.symmetries] = np.nanmax(off)
    assert apart[symmetries] < 1e-5 < 1e-3 < apart[1]
    assert load_network("best").symmetries == 4
