"""From shapes to a file that the runtime loads, in small, by the commands of the README."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch

from export import dataset, measure, smaller, store, to_onnx, train
from export.augment import CLEAN, DISTANCES, USUAL, change, masked, turned
from export.dataset import Sample
from export.losses import RECIPE, batch_of, errors_of, predict, window_losses
from export.network import SIZES, SuperSdfNet, interpolation_weights
from export.store import Sampler, Store, chances
from export.tests.conftest import SMALL
from export.to_onnx import read_network
from super_sdf import load_network
from super_sdf.arrays import CENTRE, NEIGHBOURHOOD
from super_sdf.grid.derived import BLURRED
from super_sdf.network import contract
from super_sdf.network.network import MODELS
from super_sdf.refine import nodes


def test_a_network_is_trained_resumed_exported_and_measured(tmp_path, capsys):
    folder, run, file = tmp_path / "store", tmp_path / "run", tmp_path / "small.onnx"
    for seed in range(3):
        words = f"--out {folder} --count 1 --seed {seed} --families prism --slices 3 --sizes 9 20"
        dataset.main(words.split())
    dataset.main(f"--out {folder} --count 2 --smooth --slices 6".split())
    dataset.main(f"--out {folder} --count 2 --smooth --slices 6 --seed 1".split())
    words = f"--store {folder} --run {run} --size mask --inputs masks --batch 1 --minutes"
    train.main([*words.split(), "0.05"])
    log = (run / "log.csv").read_text().splitlines()
    assert len(log) == 1 and (run / "loss.png").exists()
    taken = float(log[0].split(",")[1])  # seconds, more than it was given on a slow machine
    train.main([*words.split(), str(taken / 60 + 0.05)])
    lines = [line.split(",") for line in (run / "log.csv").read_text().splitlines()]
    assert len(lines) == 2 and int(lines[1][0]) > int(lines[0][0])
    assert len(lines[1]) == len(train.COLUMNS) and np.isfinite(float(lines[1][-1]))
    to_onnx.main(["--run", str(run), "--out", str(file)])
    card = load_network(file).card
    assert card["inputs"] == contract.MASKS and card["wide"] == 2
    assert card["receptive_field"] == SIZES["mask"].blocks + 1 + BLURRED
    example = str(Path(__file__).parents[2] / "examples" / "part.npz")
    shipped = MODELS / "mask.onnx"
    words = ["--store", str(folder), str(file), str(run), str(shipped), "--time", example]
    measure.main(words)
    tables = capsys.readouterr().out
    assert "| small.onnx | 0." in tables and "| bias | reach | us a voxel |" in tables
    *times, last = (line.split("|")[-2] for line in tables.splitlines()[-3:])
    assert times == [" - ", " - "] and float(last) > 0  # the others have no int8 variant
    with pytest.raises(SystemExit):
        measure.main(["--store", str(folder), str(file), str(shipped.with_name("fast.onnx"))])
    assert "measure them apart" in capsys.readouterr().err
    less = tmp_path / "smaller.onnx"
    words = f"{file} --store {folder} --without 0 3 --seen 60 --minutes 0.01 --out {less}"
    for each in (words, f"{less} --store {folder}"):
        smaller.main(each.split())
    tables = capsys.readouterr().out
    assert "| small.onnx | 0." in tables and "| without 4 | 0." in tables
    words = f"--store {folder} --run {tmp_path / 'more'} --inputs masks --batch 1 --minutes 0.001"
    train.main([*words.split(), "--start", str(less)])
    assert to_onnx.load_run(tmp_path / "more").config == read_network(less).config


@pytest.mark.parametrize(
    ("name", "words", "code", "message"),
    [
        ("dataset", "--out out --meshes none", 1, "--meshes none is not a folder: give one with"),
        ("train", "--run out --store none", 1, "--store none is not a folder: fill one with"),
        ("train", "--run out --store s --rate 0", 2, "argument --rate: 0: give a number greater"),
        ("to_onnx", "--from {}/fast.onnx --out o --threshold 1", 1, "--threshold is of a gate"),
        ("to_onnx", "--from {}/mask.onnx --out o --exact", 1, "--exact is for distances"),
        ("smaller", "{}/fast.onnx --store s --seen 4", 1, "--out is for a network that --without"),
        ("smaller", "{}/fast.onnx --store s --minutes 1", 1, "--minutes are for blocks that see"),
    ],
)
def test_what_cannot_be_worked_with_is_refused_in_a_line(
    capsys, tmp_path, monkeypatch, name, words, code, message
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        import_module(f"export.{name}").main(words.format(MODELS).split())
    err = capsys.readouterr().err
    assert ended.value.code == code and err.startswith(f"Error: {message}")
    assert err.count("\n") == 1 and not list(tmp_path.iterdir())


def test_targets_are_the_distance_at_the_query_points(prepared):
    """They differ from the sample by no more than they are away from it."""
    for sample in prepared:
        sampled = sample.patches[sample.voxels, CENTRE][:, None]
        assert ((sample.targets - sampled).abs() <= sample.offsets.norm(dim=1) + 4e-3).all()


def test_a_turned_sample_of_a_plane_is_one_of_the_turned_plane(prepared):
    normal, sample = torch.tensor([0.5, -0.3, 0.8]), prepared[0]
    places = torch.from_numpy(NEIGHBOURHOOD).float()
    plane = replace(
        sample,
        patches=(2 * places @ normal).repeat(len(sample.patches), 1),
        targets=(sample.offsets @ normal).repeat(len(sample.voxels), 1),
    )
    for number in range(48):
        now = turned(plane, number)
        values = now.patches[now.voxels] @ interpolation_weights(now.offsets).T
        torch.testing.assert_close(values, now.targets, atol=1e-5, rtol=0)


def test_masks_have_the_sides_of_a_level_and_its_targets():
    """And the wide distances, to a third of the error of those half-way between samples."""
    away = np.linalg.norm(np.indices((44, 44, 44)).T - 21.3, axis=-1).T - 9.2
    inner = away[(slice(BLURRED, -BLURRED),) * 3]
    ijk = np.argwhere(np.abs(inner) < 1)
    targets = 2 * inner[tuple(ijk.T)][:, None]
    ball = Sample(2 * away, np.zeros((1, 3), np.float32), ijk, targets, BLURRED)
    mask = masked(np.random.default_rng(0), ball)
    found, level = mask.patches[mask.voxels].numpy(), float((targets - mask.targets.numpy())[0, 0])
    assert len(found) == len(ijk) and np.abs(found[:, CENTRE]).min() == 1  # half a voxel
    np.testing.assert_array_equal(found[:, CENTRE] < 0, targets[:, 0] < level)
    near = np.abs(targets[:, 0] - level) < 1
    off = np.abs(found - mask.targets.numpy())[near].mean(0)
    assert off[28] < off[CENTRE] / 3
    rough = change(np.random.default_rng(0), ball, DISTANCES, replace(CLEAN, noisy=1))
    assert torch.isfinite(rough.patches).all()


def test_shared_nodes_have_the_mean_that_the_runtime_gives_them(net, prepared):
    sample = prepared[0]
    offsets = torch.from_numpy(nodes.block_offsets(4))
    sample = replace(sample, offsets=offsets, targets=torch.zeros(len(sample.voxels), len(offsets)))
    batch = batch_of([sample])
    with torch.no_grad():
        near = batch.near.numpy().astype(np.int32)
        encoded = net.encode_all(batch.patches, batch.table)
        got = predict(net, batch, encoded).numpy()
        singly = net.decode(encoded.some(sample.voxels), [len(near)], offsets[None]).numpy()
    blocks = np.append(singly.T, np.zeros((len(offsets), 1), np.float32), axis=1)
    nodes.average_shared(blocks, nodes.share_parts(np.where(near == len(near), -1, near)), 4)
    np.testing.assert_allclose(got, blocks[:, :-1].T, atol=1e-5)
    assert np.abs(got - singly).max() > 1e-3


def test_a_batch_has_the_losses_of_its_samples_and_the_truth_has_no_error(net, prepared):
    if not net.config.gated:  # which is open for a share of the voxels of a batch
        together = window_losses(net, batch_of(prepared), RECIPE)
        alone = [window_losses(net, batch_of([sample]), RECIPE) for sample in prepared]
        torch.testing.assert_close(together, torch.cat(alone))
    batch = batch_of(prepared[:1])
    np.testing.assert_allclose(errors_of(batch.targets, batch), 0, atol=1e-6)
    off = errors_of(batch.targets + 0.2, batch)
    np.testing.assert_allclose(np.abs(off), [0.1, 0.1, 0, 0.1], atol=1e-6)  # in voxels


def test_a_run_learns(tmp_path, samples):
    for number in range(3):
        path = tmp_path / f"shard-0-{number}.npz"
        dataset.write_shard(path, samples[number : number + 1])
        np.testing.assert_array_equal(
            next(dataset.read_shard(path)).targets, samples[number].targets
        )
    torch.manual_seed(0)
    recipe = replace(RECIPE, batch_voxels=1, shares=CLEAN)
    for gated in (0, 2):
        run = train.Run(tmp_path, SuperSdfNet(replace(SMALL, gated=gated)), recipe)
        windows, rng = Store(tmp_path, shares=CLEAN), np.random.default_rng(0)
        losses = []
        for _ in range(60):
            _, batch = windows.draw_batch(rng, recipe)
            losses.append(run.advance(batch, 0.1)[0])
        assert np.mean(losses[-4:]) < 0.95 * np.mean(losses[:4])


def test_a_network_starts_from_one_with_fewer_blocks_and_has_its_values(tmp_path, net, prepared):
    places = net.config.places and (27, 19, 7, 19, 27, 27, 7)
    gated = net.config.gated and 4
    larger = SuperSdfNet(replace(net.config, blocks=6, gated=gated, places=places))
    run = train.Run(tmp_path, larger)
    run.start_from(net.state_dict())
    batch = batch_of(prepared[:1])
    if not net.config.gated:
        with torch.no_grad():
            values = [predict(each, batch) for each in (net, run.average)]
        torch.testing.assert_close(*values)
    with pytest.raises(train.OptionError, match=r"^start has a network of another size: "):
        run.start_from(SuperSdfNet(replace(SMALL, hidden=64)).state_dict())


def test_a_network_without_a_dead_block_has_its_values_and_one_that_sees_less_nearly(prepared):
    torch.manual_seed(0)
    net, batch = SuperSdfNet(replace(SMALL, gated=1)).eval(), batch_of(prepared[:1])
    for number, block in enumerate(net.blocks):
        torch.nn.init.normal_(block.reduce.weight, std=0.1 * (number != 1))
        torch.nn.init.normal_(block.reduce.bias)
    changes = smaller.mean_changes(net, prepared)
    places, count = (19, 7), SMALL.channels
    with torch.no_grad():
        fewer = smaller.without(net, [1], changes)
        same, less, least = (
            smaller.seeing_less(smaller.decisive_first(fewer, prepared), kept, seen, prepared)
            for kept, seen in (((27,) * 2, count), (places, count - 4), (places, 1))
        )
        want = predict(net, batch)
        apart = [float((predict(n, batch) - want).abs().mean()) for n in (fewer, same, less, least)]
    assert less.config == replace(fewer.config, places=(*places, 27, 27), seen=count - 4)
    for given, numbers, seen, message in (
        (less, places, 4, "its blocks see 12 channels: give a network that sees all"),
        (fewer, (19,), 4, "places=19: give 2 numbers"),
        (fewer, places, count + 1, f"seen={count + 1}: give at most {count}, all channels"),
    ):
        with pytest.raises(train.OptionError, match=f"^{message}$"):
            smaller.seeing_less(given, numbers, seen, prepared)
    assert max(apart[:2]) < 1e-4 < apart[2] < apart[3]
    with pytest.raises(train.OptionError, match=r"^without \[3\]: the first 3 blocks can go"):
        smaller.without(net, [3], changes)


def test_a_size_is_changed_by_options_and_by_the_inputs():
    base = SIZES["base"]
    assert train.resized(base, None, None, DISTANCES) == base
    more = train.resized(base, 13, None, DISTANCES)
    assert more.places == (*base.places[:11], 7, 7, 7) and more.blocks == 13
    assert train.resized(SIZES["noisy"], 6, 1, DISTANCES).places == (19,) * 7
    masks = train.resized(SIZES["fast"], None, None, contract.MASKS)
    assert masks.wide == 2 and not masks.keeps_samples
    assert train.resized(SIZES["mask"], None, None, DISTANCES).wide == 0
    with pytest.raises(train.OptionError, match=r"^6 of 4 blocks cannot be gated: give fewer$"):
        train.resized(base, 4, None, DISTANCES)


@pytest.mark.parametrize("gated", [0, 2])
def test_of_masks_the_mean_error_of_a_window_is_lost_too(gated, prepared):
    net = SuperSdfNet(replace(SMALL, gated=gated, keeps_samples=False))
    losses = []
    for weight in (0, 1, 3):
        torch.manual_seed(0)  # the share of voxels where the gate opens is drawn
        with torch.no_grad():
            recipe = replace(RECIPE, bias_weight=weight)
            losses.append(window_losses(net, batch_of(prepared[:2]), recipe))
    assert (losses[1] > losses[0]).all()
    torch.testing.assert_close(losses[2] - losses[0], 3 * (losses[1] - losses[0]))


def test_the_reach_is_what_a_step_in_a_plane_moves_the_surface_beside_it():
    net = SuperSdfNet(replace(SMALL, keeps_samples=False, wide=2))
    torch.nn.init.zeros_(net.correction.weight)
    torch.nn.init.constant_(net.correction.bias, 0.4)  # half voxels, so a fifth of a voxel
    assert measure.reach_of(net) == pytest.approx(0.2 * measure.STEPPED, abs=1e-6)


def test_every_new_window_comes_once_then_those_with_much_loss_more_often():
    sampler, rng = Sampler(), np.random.default_rng(0)
    sampler.add(50)
    assert sorted(sampler.draw(rng, 3) for _ in range(50)) == list(range(50))
    sampler.losses[:] = np.where(np.arange(50) < 25, 1.0, 3.0)
    counts = np.bincount([sampler.draw(rng, 3) for _ in range(5000)], minlength=50)
    assert counts[25:].sum() / counts[:25].sum() == pytest.approx(3, rel=0.15)
    bounded = np.array([2, 3, 2, 18, 2]) / 27
    np.testing.assert_allclose(chances(np.array([0, 1, 0, 9.0, 0]), 3), bounded)


def test_samples_that_stay_on_a_device_are_changed_once_by_other_processes(tmp_path, samples):
    for number in range(3):
        dataset.write_shard(tmp_path / f"shard-0-{number}.npz", samples)
    one, other = (store.read_changed(tmp_path / "shard-0-2.npz", DISTANCES, USUAL) for _ in "ab")
    for first, second in zip(one, other, strict=True):
        torch.testing.assert_close(first.patches, second.patches)
    resident = Store(tmp_path, device="meta")
    assert len(resident) == len(one) and resident.samples["shard"][0].patches.is_meta
    resident.pool.shutdown()
