"""The fine lattice: numbering, averaging (Eq. 7), kept samples, pinned signs."""

import numpy as np
import pytest

from super_sdf.band import neighbour_table
from super_sdf.errors import OptionError
from super_sdf.nodes import (
    average_shared,
    block_ijk,
    block_offsets,
    check_factor,
    number_shared_nodes,
    pin_to_skipped,
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
    numbers, count = number_shared_nodes(table, factor)
    position = (voxels[:, None] * factor + block_ijk(factor)).reshape(-1, 3)
    different, inverse = np.unique(position, axis=0, return_inverse=True)
    assert count == len(different)
    pairs = np.unique(np.stack([inverse.ravel(), numbers.ravel()]), axis=1)
    assert pairs.shape[1] == count


def test_shared_nodes_are_plain_means():
    voxels, table = some_voxels(7)
    numbers, count = number_shared_nodes(table, 4)
    blocks = np.random.default_rng(0).normal(size=numbers.shape).astype(np.float32)
    values = average_shared(blocks, numbers, count)
    position = (voxels[:, None] * 4 + block_ijk(4)).reshape(-1, 3)
    node = position[123]
    same = (position == node).all(1)
    assert values[numbers.ravel()[123]] == pytest.approx(blocks.ravel()[same].mean(), rel=1e-6)


def test_pinned_nodes_take_the_sign_of_the_skipped_voxel():
    numbers = np.arange(27, dtype=np.int32)[None]
    values = np.ones(27, np.float32)
    skipped = np.zeros((1, 27), np.int32)
    skipped[0, 22] = -1  # the neighbour at +x, +0, +0 is inside
    assert pin_to_skipped(values, numbers, skipped, 2) == 9
    on_face = block_ijk(2)[:, 0] == 2
    assert (values[on_face] < 0).all() and (values[~on_face] == 1).all()
