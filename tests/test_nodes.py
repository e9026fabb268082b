"""The fine lattice: numbering of nodes, averaging (Eq. 7), pinned signs."""

import numpy as np
import pytest

from super_sdf.refine.band import neighbour_table
from super_sdf.refine.field import FineField
from super_sdf.refine.nodes import (
    average_shared,
    block_ijk,
    block_offsets,
    pin_to_skipped,
    share_parts,
)


def some_voxels(seed, density=0.4, shape=(6, 5, 7)):
    voxels = np.argwhere(np.random.default_rng(seed).random(shape) < density).astype(np.int32)
    return voxels, neighbour_table(voxels, shape)


@pytest.mark.parametrize("factor", [2, 16])
def test_offsets_are_equation_5_on_the_lattice(factor):
    offsets = block_offsets(factor)
    assert offsets.shape == ((factor + 1) ** 3, 3)
    assert offsets.min() == -1 and offsets.max() == 1
    np.testing.assert_array_equal(offsets[len(offsets) // 2], 0)
    steps = (offsets + 1) * factor / 2
    np.testing.assert_array_equal(steps, np.round(steps))


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
    field = FineField((6, 5, 7), factor, voxels, blocks[:, :-1], parts)
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


def test_a_pinned_node_of_two_voxels_is_pinned_in_both_and_counted_once():
    voxels = np.array([[1, 1, 1], [1, 1, 2]], np.int32)
    parts = share_parts(neighbour_table(voxels, (3, 3, 4)))
    patches = -np.ones((2, 27), np.float32)
    blocks = np.ones((27, 2), np.float32)
    changed = pin_to_skipped(blocks, parts, 2, voxels, patches, (3, 3, 4))
    middle = (block_ijk(2) == 1).all(1)  # all other nodes touch a skipped voxel ...
    between = (block_ijk(2) == [1, 1, 2]).all(1)  # ... except the middle of the common face
    assert (blocks[~middle & ~between, 0] < 0).all() and (blocks[middle | between, 0] > 0).all()
    np.testing.assert_array_equal(changed, [25, 17])
