"""The loss is that of the values that the runtime makes: those of shared nodes are averaged."""

from dataclasses import replace

import numpy as np
import torch

from export.augment import prepare
from export.batches import Batch, batch_of, copies_of_queries, encode, predict
from export.dataset import Sample
from export.tests.small_net import small_net
from super_sdf.network.neighbourhood import CENTRE, NEIGHBOURHOOD
from super_sdf.network.decoder import to_blocks
from super_sdf.refine.nodes import average_shared, block_offsets, rows_among, share_parts


def ball_sample(factor=4):
    """A ball on a window of 9^3, queried at all nodes; some voxels of the band have no targets."""
    ijk = np.indices((9, 9, 9)).reshape(3, -1).T
    distance = 2 * (np.linalg.norm(ijk - [4.2, 3.9, 4.1], axis=1) - 2.3)
    near = ijk[np.abs(distance) <= 2]
    offsets = block_offsets(factor)
    points = near[:, None] + offsets / 2
    targets = 2 * (np.linalg.norm(points - [4.2, 3.9, 4.1], axis=2) - 2.3)
    window = distance.reshape(9, 9, 9).astype(np.float32)
    return Sample(window, offsets, near.astype(np.uint8), targets.astype(np.float16))


def predicted(net, sample):
    batch = batch_of([sample])
    return predict(net, batch, encode(net, batch))


def alone(net, sample, offsets):
    """The values of the voxels with targets, each for itself."""
    voxels = encode(net, batch_of([sample])).some(torch.from_numpy(sample.voxels))
    return net.decode(voxels, torch.from_numpy(offsets))


def test_the_copies_of_a_query_are_the_same_point_in_other_voxels():
    offsets = np.array([[0, 0.5, -0.5], [1, 0, 0.5], [-1, 1, 0], [1, -1, 1]], np.float32)
    copies = copies_of_queries(offsets)
    query, place, moved = copies.query, copies.place, copies.moved
    assert np.bincount(query).tolist() == [1, 2, 4, 8]
    assert len({(int(q), int(p)) for q, p in zip(query, place)}) == len(query)
    assert query[:4].tolist() == [0, 1, 2, 3] and (place[:4] == CENTRE).all()
    np.testing.assert_array_equal(moved + 2 * NEIGHBOURHOOD[place], offsets[query])
    assert np.abs(moved).max() <= 1


def test_shared_nodes_have_the_mean_that_the_runtime_gives_them():
    sample, net = prepare(ball_sample()), small_net()
    with torch.no_grad():
        got = predicted(net, sample).numpy()
        singly = alone(net, sample, sample.offsets).numpy()
    blocks = to_blocks(singly)
    near = rows_among(sample.voxels, len(sample.table))[sample.table[sample.voxels]]
    average_shared(blocks, share_parts(near), 4)
    np.testing.assert_allclose(got, blocks[:, :-1].T, atol=1e-5)
    assert np.abs(got - singly).max() > 1e-3


def test_the_gradient_reaches_the_voxels_that_share_a_node():
    sample, net = prepare(ball_sample()), small_net()
    corner = np.array([[1, 1, 1]], np.float32)
    batch: Batch = batch_of([replace(sample, offsets=corner, targets=sample.targets[:, :1])])
    encoded = encode(net, batch)
    features = encoded.features.detach().requires_grad_()
    predict(net, batch, replace(encoded, features=features))[0, 0].backward()
    reached = np.flatnonzero(features.grad.abs().sum(1).numpy())
    near = batch.near[0, [13, 14, 16, 17, 22, 23, 25, 26]].tolist()
    shares = [int(batch.voxels[row]) for row in near if row < len(batch.near)]
    assert reached.tolist() == sorted(shares) and len(shares) > 1
