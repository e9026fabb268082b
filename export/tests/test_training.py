"""From a mesh to an ONNX file in small: distances, samples, gradients, resuming, parity."""

import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from export import augment, dataset, network, to_onnx
from export.augment import CLEAN, Prepared, Shares, prepare
from export.batches import batch_of, encode
from export.dormant import dormant_share, moments, rectified_layers, revive
from export.network import SIZES, GatherMatMul, SuperSdfNet
from export.recipe import RECIPE, differences, make_optimisers, sample_errors
from export.run_log import read_log
from export.store import Store
from export.tests.small_net import SMALL, small_net
from export.train import Run, autocast, take_step, train
from super_sdf import Mesh, load_network
from super_sdf.errors import FileError, OptionError
from super_sdf.network.neighbourhood import CENTRE, NEIGHBOURHOOD
from super_sdf.network.contract import EXACT_DISTANCES, INPUTS
from super_sdf.network.network import shipped_models
from super_sdf.network.onnx import CHUNK_INPUT
from super_sdf.refine.band import is_lipschitz, neighbour_table
from super_sdf.refine.nodes import block_offsets
from super_sdf.truth.solid import Solid

LOW = np.array([[-0.3, -0.2, -0.1], [-0.1, -0.1, -0.05]])
HIGH = np.array([[0.4, 0.3, 0.2], [0.6, 0.2, 0.1]])


def test_signs_are_right_where_a_mesh_intersects_itself():
    """Of two boxes that overlap."""
    boxes = [trimesh.creation.box(bounds=bounds) for bounds in zip(LOW, HIGH)]
    both = trimesh.util.concatenate(boxes)
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.7, (4000, 3))
    inside = ((points[:, None] > LOW) & (points[:, None] < HIGH)).all(2).any(1)
    mesh = Mesh(np.array(both.vertices), np.array(both.faces, np.int32))
    np.testing.assert_array_equal(dataset.signed_distance(rng, Solid(mesh), points) < 0, inside)


def test_thin_solids_have_hardly_a_sample_inside():
    samples = dataset.fill_shard(np.random.default_rng(0), [], 1.0, thin=1.0, count=2)
    assert all(-0.2 < sample.window.min() / 2 < 0.6 for sample in samples)
    assert all((sample.targets < 0).any() for sample in samples)


def test_shards_come_back_the_same(tmp_path, samples):
    dataset.write_shard(tmp_path / "shard.npz", samples)
    for before, after in zip(samples, dataset.read_shard(tmp_path / "shard.npz"), strict=True):
        for field in ("window", "offsets", "voxel_ijk", "targets"):
            np.testing.assert_array_equal(getattr(before, field), getattr(after, field))


def test_augmentation_is_a_symmetry():
    """A linear field stays linear: patches, table and offsets are turned together."""
    normal = np.array([0.5, -0.3, 0.8])
    ijk = np.argwhere(np.ones((5, 5, 5))).astype(np.int32)
    offsets = block_offsets(2)
    sample = Prepared(
        ijk,
        patches=np.tile(NEIGHBOURHOOD @ normal, (125, 1)).astype(np.float32),
        table=neighbour_table(ijk, (5, 5, 5)),
        voxels=np.arange(125),
        offsets=offsets,
        targets=np.tile(offsets / 2 @ normal, (125, 1)).astype(np.float32),
    )
    for seed in range(20):
        now = augment.turned(np.random.default_rng(seed), sample)
        weights = network.interpolation_weights(torch.from_numpy(now.offsets)).numpy()
        np.testing.assert_allclose(now.patches @ weights.T, now.targets, atol=1e-5)
        present = now.table >= 0
        moves = (now.ijk[now.table] - now.ijk[:, None])[present]
        places = np.broadcast_to(np.arange(27), present.shape)[present]
        np.testing.assert_array_equal(moves, NEIGHBOURHOOD[places])


def test_targets_follow_the_level_and_the_side_but_not_the_noise(samples):
    rng, sample = np.random.default_rng(0), samples[0]
    inside_out = augment.inverted(rng, sample, Shares(inverted=1))
    np.testing.assert_array_equal(inside_out.window, -sample.window)
    np.testing.assert_array_equal(inside_out.targets, -sample.targets)
    moved = augment.shifted(rng, sample, Shares(shifted=1))
    level = (sample.window - moved.window).mean()
    assert 0 < abs(level) <= 1
    np.testing.assert_allclose(sample.targets - moved.targets, level, atol=1e-3)
    rough = augment.noisy(rng, sample, Shares(noisy=1))
    assert 0 < np.abs(rough.window - sample.window).max() <= 1
    np.testing.assert_array_equal(rough.targets, sample.targets)
    mask = augment.masked(rng, sample)
    level = float(np.median(sample.targets.astype(np.float32) - mask.targets))
    assert abs(level) <= 1 == np.abs(mask.window).min()  # half a voxel
    np.testing.assert_array_equal(mask.window < 0, sample.window < np.float32(level))
    np.testing.assert_allclose(sample.targets - mask.targets, level, atol=1e-3)
    assert not np.array_equal(augment.masked(rng, sample).window, mask.window)


def test_a_network_for_masks_corrects_every_sample_also_as_a_file(tmp_path, samples):
    net = SuperSdfNet(replace(SMALL, keeps_samples=False))
    torch.nn.init.constant_(net.correction.bias, 0.5)
    batch = batch_of([augment.prepare_mask(sample) for sample in samples[:2]])
    with torch.no_grad():
        encoded = encode(net, batch)
        at_sample = net.decode(encoded, torch.zeros(1, 3))[:, 0]
        want = encoded.patches[:, CENTRE] + net.correction(encoded.features)[:, 0]
    torch.testing.assert_close(at_sample, want, atol=1e-5, rtol=0)
    path = tmp_path / "mask.onnx"
    to_onnx.write_model(net, path, to_onnx.make_card(net, "mask", "nothing", "none"))
    assert to_onnx.parity(net, path) < 2e-4 and load_network(path).card["inputs"] == "masks"
    assert not to_onnx.read_network(path).config.keeps_samples


def test_differences_are_the_gradient_and_the_errors_of_the_truth_are_zero(samples):
    offsets = dataset.draw_offsets(np.random.default_rng(0))
    normal = np.array([0.5, -0.3, 0.8], np.float32)
    slopes = differences(torch.from_numpy(offsets @ normal)[None])
    np.testing.assert_allclose(slopes[0], np.tile(normal, (dataset.CORNERS, 1)), atol=1e-6)
    target = torch.from_numpy(samples[0].targets.astype(np.float32))
    np.testing.assert_allclose(sample_errors(target, target), 0, atol=1e-6)
    off = sample_errors(target + 0.2, target)
    np.testing.assert_allclose(off, [0.1, 0.1, 0], atol=1e-6)  # in voxels


def test_meshes_come_once_each_with_a_sixth_of_prisms():
    prisms, others = [Path(f"p{n}") for n in range(900)], [Path(f"o{n}") for n in range(500)]
    order = dataset.mesh_order(0, prisms, others, 600)
    assert len(order) == len(set(order)) == 600
    assert set(others) < set(order)
    assert len(set(dataset.mesh_order(0, prisms, others, 1200)[600:]) & set(prisms)) == 100


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_convolution_gathers_some_voxels_after_others(dtype, monkeypatch):
    table = torch.randint(0, 101, (100, 27))  # 100: no voxel
    features, weight = torch.randn(100, 4).to(dtype), torch.randn(108, 3).to(dtype)
    whole = network.columns_of(network.pad(features), table) @ weight
    monkeypatch.setattr("export.network.CHUNK", 7)
    torch.testing.assert_close(GatherMatMul.apply(features, weight, table, features[:0]), whole)


def test_an_untrained_network_keeps_samples_and_planes():
    weights = network.interpolation_weights(torch.from_numpy(block_offsets(4))).double().numpy()
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    np.testing.assert_allclose(weights @ NEIGHBOURHOOD, block_offsets(4) / 2, atol=1e-6)
    net = SuperSdfNet(SMALL)
    patches, table = torch.rand(1, 27), torch.full((1, 27), -1)
    at_sample = net(patches, table, torch.tensor([0]), torch.zeros(1, 3))
    assert at_sample.item() == pytest.approx(patches[0, 13].item(), abs=1e-6)


def test_a_run_learns_and_goes_on_where_it_stopped(tmp_path, samples):
    dataset.write_shard(tmp_path / "shard-0-0000.npz", samples[:1])
    dataset.write_shard(tmp_path / "shard-0-0001.npz", samples[1:])
    torch.manual_seed(0)
    recipe = replace(RECIPE, batch_voxels=1, shares=CLEAN)
    run, rng = Run(tmp_path, SuperSdfNet(SMALL), recipe), np.random.default_rng(0)
    store = Store(tmp_path, 1)
    losses = [take_step(run, store, rng, 0.1) for _ in range(80)]
    assert np.mean(losses[-4:]) < 0.95 * np.mean(losses[:4])
    assert not np.isnan(store.sampler.losses).any()
    run.save()
    again = Run(tmp_path, SuperSdfNet(SMALL))
    again.resume()
    assert again.step == 80
    for one, other in zip(run.net.parameters(), again.net.parameters()):
        torch.testing.assert_close(one, other)
    train(again, store, again.seconds / 60 + 0.01, seed=0)
    assert again.step > 80
    assert read_log(tmp_path / "log.csv")["step"][-1] == again.step  # the end is measured
    train(again, store, 0.01, seed=0)  # spent
    step = again.step
    train(again, store, 0.01, seed=0, began=time.monotonic())
    assert again.step > step and step == read_log(tmp_path / "log.csv")["step"][-2]


def test_steps_that_a_resumed_run_takes_again_count_once(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("100,10,5,.3\n200,20,5,.2\n300,30,5,.1\n200,21,5,.25\n300,31,5,.15\n")
    columns = read_log(path)
    assert columns["step"].tolist() == [100, 200, 300]
    assert columns["loss"].tolist() == [0.3, 0.25, 0.15]
    path.write_text("")
    with pytest.raises(FileError, match=f"^{path} is empty: give the log.csv of a run$"):
        read_log(path)


def test_noisy_are_the_voxels_whose_neighbours_are_no_distance(samples):
    sample = samples[0]
    window = sample.window.copy()
    some = tuple(sample.voxel_ijk[len(sample.voxel_ijk) // 2])
    window[some] += 2.5
    prepared = prepare(replace(sample, window=window))
    patches, table = torch.from_numpy(prepared.patches), augment.batch_table([prepared.table])
    noisy = network.is_noisy(patches, torch.from_numpy(table))[:, 0].numpy() > 0
    broken = ~is_lipschitz(prepared.patches)
    near = np.append(broken, False)[prepared.table].any(1)
    assert broken.any() and not near.all()
    np.testing.assert_array_equal(noisy, near)


def test_a_file_is_written_anew_with_the_same_values_and_card(tmp_path):
    shipped = shipped_models()["fast"]
    to_onnx.rewrite(shipped, tmp_path / "fast.onnx")
    one, other = load_network(shipped, device="cpu"), load_network(tmp_path / "fast.onnx")
    assert one.card == other.card and [path.name for path in tmp_path.iterdir()] == ["fast.onnx"]
    np.testing.assert_allclose(
        one(*to_onnx.noisy_ball()), other(*to_onnx.noisy_ball()), rtol=0, atol=2e-6
    )


def put_to_sleep(net, units=3):
    """Let some units of every rectified layer react to nothing."""
    with torch.no_grad():
        for entry in rectified_layers(net):
            entry.bias[:units] = -1e4


def test_targets_are_the_distance_at_the_query_points(samples):
    """They differ from the sample by no more than they are away from it."""
    for prepared in map(prepare, samples):
        sampled = prepared.patches[prepared.voxels, CENTRE][:, None]
        away = np.linalg.norm(prepared.offsets, axis=1)
        assert (np.abs(prepared.targets - sampled) <= away + 4e-3).all()  # float16


def test_dormant_units_start_again_without_a_change_and_forget_what_moved_them(samples):
    net, batch = small_net(), batch_of([prepare(samples[0])])
    offsets = torch.from_numpy(samples[0].offsets)
    layers, optimisers = rectified_layers(net), make_optimisers(net, RECIPE)
    net.decode(encode(net, batch), offsets).square().mean().backward()
    for optimiser in optimisers:
        optimiser.step()
    put_to_sleep(net)
    assert dormant_share(net, [batch]) >= 3 * len(layers) / sum(len(one.bias) for one in layers)
    with torch.no_grad():
        values = net.decode(encode(net, batch), offsets)
        assert revive(net, optimisers, [batch]) >= 3 * len(layers)
        torch.testing.assert_close(net.decode(encode(net, batch), offsets), values)
    assert dormant_share(net, [batch]) == 0
    for one in layers:
        kept = [m for optimiser in optimisers for m in moments(optimiser, one.weight)]
        assert kept and all((one.incoming(array)[:3] == 0).all() for array in kept)


def test_a_run_starts_dormant_units_again_until_its_last_fifth(tmp_path, samples):
    recipe = replace(RECIPE, batch_voxels=1, shares=CLEAN, revive_steps=10)
    run, batch = Run(tmp_path, SuperSdfNet(SMALL), recipe), batch_of([prepare(samples[0])])
    for spent, asleep in ((0.5, False), (0.9, True)):
        put_to_sleep(run.net)
        for _ in range(10):
            run.advance([batch], spent)
        assert (dormant_share(run.net, [batch]) > 0.05) == asleep


def test_threads_share_a_batch_and_find_the_same_gradients(tmp_path, samples, monkeypatch):
    monkeypatch.setattr("export.train.autocast", lambda _: nullcontext())
    shown = [prepare(sample) for sample in samples]
    found = []
    for batches in ([batch_of(shown)], [batch_of(shown[:1]), batch_of(shown[1:])]):
        run = Run(tmp_path, small_net(), RECIPE)
        losses = run.find_gradients(batches, torch.tensor([0.2, 0.3, 0.5]))
        found.append([losses, *(parameter.grad for parameter in run.net.parameters())])
    for one, two in zip(*found, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-4, atol=1e-6)


def test_a_network_with_dead_units_is_not_exported(samples, monkeypatch):
    net = small_net()
    monkeypatch.setattr("export.to_onnx.draw_samples", lambda **_: [prepare(samples[0])])
    revive(net, [], [batch_of([prepare(samples[0])])])
    to_onnx.check_awake(net)
    put_to_sleep(net)
    with pytest.raises(SystemExit, match=r"% of the rectified units react to nothing, 1 % may"):
        to_onnx.check_awake(net)


@pytest.mark.parametrize("name", SIZES)
def test_a_size_is_that_of_the_shipped_network(name):
    assert to_onnx.read_network(shipped_models()[name]).config == SIZES[name]


def test_the_onnx_file_agrees_with_torch_in_chunks_of_any_size(small_file):
    loaded, net = load_network(small_file, device="cpu"), small_net()
    assert to_onnx.parity(net, small_file) < 2e-4 and loaded.card["receptive_field"] == 3
    feeds = dict(zip(INPUTS, to_onnx.noisy_ball()))
    want = loaded.session.run(None, feeds)[0]
    for rows in (7, 512, 10**4):
        got = loaded.session.run(None, {**feeds, CHUNK_INPUT: np.array([rows])})[0]
        np.testing.assert_allclose(got, want, atol=1e-5)
    assert "inputs" not in to_onnx.make_card(net, "any", "nothing", "none")
    to_onnx.write_model(
        net, small_file, to_onnx.make_card(net, "exact", "nothing", "none", EXACT_DISTANCES)
    )
    assert load_network(small_file).card["inputs"] == "exact distances"


@pytest.mark.parametrize("channels", [SMALL.channels, 12])
def test_a_larger_network_starts_with_the_values_of_the_file(tmp_path, small_file, channels):
    """What reads new units begins to learn at once."""
    larger = replace(SMALL, channels=channels, hidden=20, blocks=SMALL.blocks + 1, functions=40)
    run, net = Run(tmp_path, SuperSdfNet(larger)), small_net()
    run.start_from(to_onnx.read_weights(small_file))
    arrays = [torch.from_numpy(array) for array in to_onnx.noisy_ball()]
    values = run.net(*arrays)
    with torch.no_grad():
        torch.testing.assert_close(values, net(*arrays))
        torch.testing.assert_close(run.average(*arrays), net(*arrays))
    values.square().mean().backward()
    conv = run.net.blocks[1].conv.weight.grad.view(27, channels, channels)
    assert run.net.blocks[0].expand.weight.grad[SMALL.hidden :].abs().max() == 0  # not yet read
    assert run.net.blocks[0].reduce.weight.grad[:, SMALL.hidden :].abs().max() > 0
    assert channels == SMALL.channels or conv[:, SMALL.channels :].abs().max() > 0
    assert run.net.trunk.layers[-1].weight.grad[SMALL.functions :].abs().max() > 0


def test_no_network_starts_from_a_larger_one(tmp_path, small_file):
    run = Run(tmp_path, SuperSdfNet(replace(SMALL, hidden=12)))
    with pytest.raises(OptionError, match=r"stem.0.weight is \(16, 27\), more than the \(12, 27\)"):
        run.start_from(to_onnx.read_weights(small_file))
    run = Run(tmp_path, SuperSdfNet(replace(SMALL, blocks=1)))
    with pytest.raises(OptionError, match=r"of 2 blocks, more than the 1 of this size: .* 2$"):
        run.start_from(to_onnx.read_weights(small_file))


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        ({"avx2": True, "avx512_bf16": False}, torch.float32),
        ({"avx2": True, "avx512_bf16": True}, torch.bfloat16),
        ({"architecture": "aarch64"}, torch.float32),
    ],
)
def test_a_step_is_computed_in_bfloat16_where_the_processor_has_it(monkeypatch, found, expected):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: found)
    layer = torch.nn.Linear(4, 4)
    with autocast("cpu"):
        assert layer(torch.ones(2, 4)).dtype == expected
