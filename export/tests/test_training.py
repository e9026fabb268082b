"""From a mesh to an ONNX file in small: distances, samples, gradients, resuming, parity."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from export.dataset import make_sample, read_shard, write_shard
from export.network import (
    GatherMatMul,
    NetworkConfig,
    SuperSdfNet,
    interpolation_weights,
)
from export.shapes import random_solid
from export.to_onnx import make_card, parity, write_model
from export.train import Run, Store, augment, learning_rate, prepare, train
from super_sdf import Mesh, load_network
from super_sdf.band import NEIGHBOURHOOD, find_band, neighbour_table
from super_sdf.evaluation.sampling import sample_grid
from super_sdf.evaluation.solid import Solid
from super_sdf.nodes import block_offsets

SMALL = NetworkConfig(channels=8, blocks=2, hidden=16, functions=24, trunk=16, frequencies=2)


def box(low=(-0.3, -0.2, -0.1), high=(0.4, 0.3, 0.2)) -> Mesh:
    import trimesh

    made = trimesh.creation.box(bounds=[low, high])
    return Mesh(np.array(made.vertices), np.array(made.faces, np.int32))


def box_distance(points, low=(-0.3, -0.2, -0.1), high=(0.4, 0.3, 0.2)):
    """The closed form, negative inside."""
    beyond = np.maximum(np.array(low) - points, points - np.array(high))
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return outside + np.minimum(beyond.max(1), 0)


def test_distances_of_a_box_are_exact():
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (5000, 3))
    found = Solid(box()).signed_distance(points)
    np.testing.assert_allclose(found, box_distance(points), atol=1e-12)


def test_a_grid_has_the_right_sign_near_and_far():
    turn = Rotation.from_euler("xyz", [0.3, 0.5, 0.7]).as_matrix()
    turned = box().transformed(turn, np.zeros(3))
    values = sample_grid(Solid(turned), ((24, 25, 26), 0.06, np.full(3, -0.7)))
    points = (np.indices((24, 25, 26)).reshape(3, -1).T * 0.06 - 0.7) @ turn
    np.testing.assert_allclose(values.ravel(), box_distance(points), atol=1e-7)


def some_samples(count=3):
    rng = np.random.default_rng(0)
    samples = []
    while len(samples) < count:
        sample = make_sample(rng, random_solid(rng))
        samples += [sample] if sample else []
    return samples


@pytest.fixture(scope="module")
def samples():
    return some_samples()


def test_targets_are_the_distance_at_the_query_points():
    rng = np.random.default_rng(1)
    sample = make_sample(rng, box())
    prepared = prepare(sample)
    middle = np.abs(sample.offsets).max(1) < 0.3
    got = prepared.targets[:, middle]
    sampled = prepared.patches[prepared.voxels, 13]
    assert np.abs(got - sampled[:, None]).max() <= 0.3 * 3**0.5 + 2e-3  # 1-Lipschitz, float16


def test_shards_come_back_the_same(tmp_path, samples):
    write_shard(tmp_path / "shard.npz", samples)
    for before, after in zip(samples, read_shard(tmp_path / "shard.npz"), strict=True):
        for field in ("window", "offsets", "voxel_ijk", "targets"):
            np.testing.assert_array_equal(getattr(before, field), getattr(after, field))


def test_augmentation_is_a_symmetry():
    """A linear field stays linear: patches, table and offsets are turned together."""
    normal = np.array([0.5, -0.3, 0.8])
    ijk = np.argwhere(np.ones((5, 5, 5))).astype(np.int32)
    sample = prepare(some_samples(1)[0])
    sample = type(sample)(
        patches=np.tile(NEIGHBOURHOOD @ normal, (125, 1)).astype(np.float32),
        table=neighbour_table(ijk, (5, 5, 5)),
        voxels=np.arange(125),
        offsets=sample.offsets,
        targets=np.tile(sample.offsets / 2 @ normal, (125, 1)).astype(np.float32),
    )
    for seed in range(20):
        turned = augment(np.random.default_rng(seed), sample)
        weights = interpolation_weights(torch.from_numpy(turned.offsets)).numpy()
        np.testing.assert_allclose(turned.patches @ weights.T, turned.targets, atol=1e-5)
        present = turned.table >= 0
        moves = (ijk[turned.table] - ijk[:, None])[present]
        places = np.broadcast_to(np.arange(27), present.shape)[present]
        one_place = moves[places == 14]
        assert (one_place == one_place[0]).all() and np.abs(one_place[0]).sum() == 1


def test_the_gradient_of_the_neighbour_convolution():
    field = np.random.default_rng(0).normal(0, 3, (4, 4, 4)).astype(np.float32)
    voxels = find_band(field)
    table = neighbour_table(voxels, (4, 4, 4))
    table = torch.from_numpy(np.where(table < 0, len(voxels), table))
    features = torch.randn(len(voxels), 3, dtype=torch.double, requires_grad=True)
    weight = torch.randn(81, 2, dtype=torch.double, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda f, w: GatherMatMul.apply(f, w, table), (features, weight)
    )


def test_an_untrained_network_keeps_samples_and_planes():
    weights = interpolation_weights(torch.from_numpy(block_offsets(4))).double().numpy()
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    np.testing.assert_allclose(weights @ NEIGHBOURHOOD, block_offsets(4) / 2, atol=1e-6)
    net = SuperSdfNet(SMALL)
    patches, table = torch.randn(1, 27), torch.full((1, 27), -1)
    at_sample = net(patches, table, torch.tensor([0]), torch.zeros(1, 3))
    assert at_sample.item() == pytest.approx(patches[0, 13].item(), abs=1e-6)


def test_a_run_learns_and_goes_on_where_it_stopped(tmp_path, samples):
    write_shard(tmp_path / "shard-0-0000.npz", samples[:1])
    write_shard(tmp_path / "shard-0-0001.npz", samples[1:])
    torch.manual_seed(0)
    run = Run(tmp_path, SMALL)
    rng = np.random.default_rng(0)
    batch = [prepare(sample) for sample in samples]
    first = run.advance(batch, 0.1)
    for _ in range(30):
        last = run.advance([augment(rng, sample) for sample in batch], 0.1)
    assert last < 0.9 * first
    run.save()
    again = Run(tmp_path, SMALL)
    again.resume()
    assert again.step == 31
    for one, other in zip(run.net.parameters(), again.net.parameters()):
        torch.testing.assert_close(one, other)
    train(again, Store(tmp_path, 1), again.seconds / 60 + 0.01, seed=0)
    assert again.step > 31


def test_the_rate_warms_up_and_anneals():
    rates = [learning_rate(spent) for spent in np.linspace(0, 1, 101)]
    assert rates[0] < 1e-5 and rates[-1] < 1e-5
    assert 1.8e-3 < max(rates) <= 2e-3 + 2e-6


def test_the_onnx_file_agrees_with_torch_and_carries_its_card(tmp_path):
    torch.manual_seed(0)
    net = SuperSdfNet(SMALL)
    for parameter in net.parameters():  # away from the start, where the blocks do nothing
        torch.nn.init.normal_(parameter, std=0.1)
    write_model(net, tmp_path / "small.onnx", make_card(net, "small", "nothing", "none"))
    assert parity(net, tmp_path / "small.onnx") < 2e-4
    assert load_network(tmp_path / "small.onnx").card["receptive_field"] == 3
