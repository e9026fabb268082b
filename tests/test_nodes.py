"""The fine lattice: numbering of nodes, averaging (Eq. 7)."""

import numpy as np
import pytest

from super_sdf import SdfGrid
from super_sdf.refine.band import neighbour_table
from super_sdf.refine.field import FineField
from super_sdf.refine.nodes import average_shared, block_ijk, share_parts


def some_voxels(seed, density=0.4, shape=(6, 5, 7)):
    voxels = np.argwhere(np.random.default_rng(seed).random(shape) < density).astype(np.int32)
    return voxels, neighbour_table(voxels, shape)


@pytest.mark.parametrize(("factor", "threads"), [(2, 3), (4, 1)])
def test_nodes_have_a_number_for_each_position_and_are_plain_means_of_all_blocks(
    monkeypatch, factor, threads
):
    monkeypatch.setattr("super_sdf.threads.MIN_PER_THREAD", 1)
    voxels, table = some_voxels(7)
    blocks = np.random.default_rng(0).normal(size=((factor + 1) ** 3, len(voxels) + 1))
    blocks = blocks.astype(np.float32)
    blocks[:, -1] = 0
    parts = share_parts(table)
    grid = SdfGrid.trusted(np.zeros((6, 5, 7), np.float32), 1.0)
    field = FineField(grid.shape, factor, voxels, blocks[:, :-1], parts, grid)
    numbers = field.numbers.ravel()
    position = (voxels[:, None] * factor + block_ijk(factor)).reshape(-1, 3)
    different, inverse = np.unique(position, axis=0, return_inverse=True)
    pairs = np.unique(np.stack([inverse.ravel(), numbers]), axis=1)
    assert parts.count_nodes(factor) == len(different) == pairs.shape[1]
    total = np.bincount(numbers, blocks[:, :-1].T.ravel())
    average_shared(blocks, parts, factor, threads)
    want = (total / np.bincount(numbers)).astype(np.float32)
    np.testing.assert_array_equal(blocks[:, :-1].T, want[field.numbers])
    np.testing.assert_array_equal(field.values, want)
    assert not blocks[:, -1].any()
