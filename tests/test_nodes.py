"""The fine lattice: numbering, averaging (Eq. 7), kept samples, pinned signs."""

import numpy as np
import pytest

from super_sdf.errors import OptionError
from super_sdf.steps.band import neighbour_table
from super_sdf.steps.nodes import (
    average_shared,
    block_ijk,
    block_offsets,
    check_factor,
    number_shared_nodes,
    pin_to_skipped,
    signs_of_skipped,
)


def some_voxels(seed, density=0.4, shape=(6, 5, 7)):
    voxels = np.argwhere(np.random.default_rng(seed).random(shape) < density).astype(np.int32)
    return voxels, neighbour_table(voxels, shape)


@pytest.mark.parametrize("factor", [2, 4, 8, 16])
def test_offsets_are_equation_5_on_the_lattice(factor):
    offsets = block_offsets(factor)
    assert offsets.shape == ((factor + 1) ** 3, 3)
    assert offsets.min() == -1 and offsets.max() == 1
    np.testing.assert_array_equal(offsets[len(offsets) // 2], 0)
    steps = (offsets + 1) * factor / 2
    np.testing.assert_array_equal(steps, np.round(steps))


@pytest.mark.parametrize("factor", [-2, 0, 1, 3, 5, 15, 18, 1000])
def test_odd_and_absurd_factors_are_refused(factor):
    message = (
        f"factor is {factor}: give an even number from 2 to 16 "
        r"\(an odd one has no node on the samples\)"
    )
    with pytest.raises(OptionError, match=message):
        check_factor(factor)


@pytest.mark.parametrize("factor", [2, 4])
@pytest.mark.parametrize("seed", range(4))
def test_nodes_have_one_number_for_each_position(seed, factor):
    voxels, table = some_voxels(seed)
    nodes = number_shared_nodes(table, factor)
    position = (voxels[:, None] * factor + block_ijk(factor)).reshape(-1, 3)
    different, inverse = np.unique(position, axis=0, return_inverse=True)
    assert nodes.count == len(different)
    pairs = np.unique(np.stack([inverse.ravel(), nodes.numbers().ravel()]), axis=1)
    assert pairs.shape[1] == nodes.count


def test_nodes_belong_to_the_first_voxel_that_has_them_and_come_in_its_order():
    voxels, table = some_voxels(3)
    nodes = number_shared_nodes(table, 4)
    owner = np.full(nodes.count, len(voxels))
    np.minimum.at(owner, nodes.numbers(), np.arange(len(voxels))[:, None])
    assert (np.diff(owner) >= 0).all()
    for row in range(len(voxels) + 1):
        assert nodes.owned_before(row) == (owner < row).sum()


def test_shared_nodes_are_plain_means():
    _, table = some_voxels(7)
    nodes = number_shared_nodes(table, 4)
    numbers = nodes.numbers()
    blocks = np.random.default_rng(0).normal(size=numbers.shape).astype(np.float32)
    values = average_shared(blocks, nodes)
    total = np.bincount(numbers.ravel(), blocks.ravel())
    np.testing.assert_array_equal(values, (total / np.bincount(numbers.ravel())).astype(np.float32))


def test_pinned_nodes_take_the_sign_of_the_skipped_voxel():
    nodes = number_shared_nodes(np.where(np.arange(27) == 13, 0, -1)[None].astype(np.int32), 2)
    values = np.ones(27, np.float32)
    patches = np.ones((1, 27), np.float32)
    patches[0, 22] = -1  # the neighbour at +x is inside; others are beyond the grid, but that at -x
    ijk, voxels = np.array([[1, 0, 0]], np.int32), np.zeros(1, np.int32)
    changed = pin_to_skipped(
        values, nodes, signs_of_skipped(nodes.table, ijk, patches, voxels, (3, 1, 1))
    )
    on_face = nodes.numbers()[0, block_ijk(2)[:, 0] == 2]
    assert changed.sum() == 9 and changed[on_face].all()
    np.testing.assert_array_equal(values < 0, changed)
