"""The symmetries of the cube, and networks averaged over them."""

import numpy as np
from conftest import ball

from super_sdf import load_network
from super_sdf.neighbourhood import NEIGHBOURHOOD
from super_sdf.network.symmetry import cube_symmetries, turn
from super_sdf.steps.band import find_band, gather_patches, neighbour_table, rescale
from super_sdf.steps.nodes import block_offsets


def test_the_symmetries_are_a_group_of_48_with_the_reflections_first():
    group = cube_symmetries()
    assert len({symmetry.tobytes() for symmetry in group}) == 48
    np.testing.assert_array_equal(group[0], np.eye(3))
    for symmetry in group:
        np.testing.assert_array_equal(symmetry @ symmetry.T, np.eye(3))
        assert {(symmetry @ other).tobytes() for other in group} == {g.tobytes() for g in group}
    assert (np.abs(group[:8]) == np.eye(3)).all()


def test_a_turned_plane_is_a_plane():
    normal = np.array([0.5, -0.3, 0.8])
    patches = (NEIGHBOURHOOD @ normal).astype(np.float32)[None]
    table = np.arange(27, dtype=np.int32)[None]
    for symmetry in cube_symmetries():
        turned, places, offsets = turn(symmetry, patches, table, block_offsets(2))
        np.testing.assert_allclose(turned[0], NEIGHBOURHOOD @ symmetry @ normal, atol=1e-6)
        np.testing.assert_array_equal(turned[0], patches[0, places[0]])
        np.testing.assert_allclose(offsets @ symmetry, block_offsets(2), atol=1e-6)


def test_best_maps_a_mirrored_field_to_the_mirrored_surface():
    """The plain network does so only approximately; otherwise the mean would have no effect."""
    grid = ball()
    mirrored = rescale(grid)[::-1].copy()
    answers = {}
    for quality in ("base", "best"):
        network = load_network(quality)
        for name, field in (("as it is", rescale(grid)), ("mirrored", mirrored)):
            voxels = find_band(field)
            rows = np.arange(len(voxels), dtype=np.int32)
            table = neighbour_table(voxels, field.shape)
            values = network(gather_patches(field, voxels), table, rows, block_offsets(4))
            dense = np.full((*field.shape, 5, 5, 5), np.nan, np.float32)
            dense[tuple(voxels.T)] = values.reshape(-1, 5, 5, 5)
            answers[quality, name] = dense[::-1, :, :, ::-1] if name == "mirrored" else dense
    apart = {
        quality: np.nanmax(np.abs(answers[quality, "as it is"] - answers[quality, "mirrored"]))
        for quality in ("base", "best")
    }
    assert apart["best"] < 1e-5 < 1e-3 < apart["base"]
