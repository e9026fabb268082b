"""Stores: windows by their last loss, new ones first; masks; samples that stay on a device."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import export.store
from export.augment import CLEAN, USUAL
from export.dataset import write_shard
from export.network import SuperSdfNet
from export.recipe import RECIPE
from export.store import ResidentStore, Sampler, Store, chances, divide, read_changed
from export.tests.small_net import SMALL
from export.train import Run, take_step
from super_sdf.network.neighbourhood import CENTRE


def shown(sampler: Sampler, count: int, spread: float = 3.0) -> list[int]:
    rng = np.random.default_rng(0)
    return [sampler.draw(rng, spread) for _ in range(count)]


def test_every_new_window_comes_once_before_any_comes_again():
    sampler = Sampler()
    sampler.add(50)
    first = shown(sampler, 50)
    assert sorted(first) == list(range(50)) != first
    sampler.record(first, [1.0] * 50)
    sampler.add(5)
    assert sorted(shown(sampler, 5)) == [50, 51, 52, 53, 54]
    assert divide([3, 9, 5, 2], 2) == [[1], [2, 0, 3]]  # each to one thread
    assert divide([7], 2) == [[0]]


def test_windows_come_in_proportion_to_their_last_loss_within_the_spread():
    np.testing.assert_allclose(chances(np.array([0.5, 1.0, 1.5]), 3), np.array([1, 2, 3]) / 6)
    bounded = np.array([2, 3, 2, 18, 2]) / 27
    np.testing.assert_allclose(chances(np.array([0, 1, 0, 9.0, 0]), 3), bounded)
    sampler = Sampler()
    sampler.add(3)
    sampler.record(range(3), [9.0, 1.0, 1.5])
    sampler.record([0], [0.5])
    counts = np.bincount(shown(sampler, 6000), minlength=3)
    np.testing.assert_allclose(counts, [1000, 2000, 3000], rtol=0.1)
    np.testing.assert_array_equal(np.bincount(shown(sampler, 30, spread=1.0)), 10)


@pytest.fixture
def folder(tmp_path, samples, monkeypatch):
    monkeypatch.setattr(export.store, "READERS", 1)
    for number in range(3):
        write_shard(tmp_path / f"shard-0-{number:04}.npz", samples)
    return tmp_path


def test_a_store_of_masks_has_masks_and_a_shard_is_changed_the_same_way_every_time(folder):
    store = Store(folder, inputs="masks")
    _, (batch,) = store.draw_batch(np.random.default_rng(0), replace(RECIPE, batch_voxels=1), 1)
    for patches in (*(sample.patches for sample in store.held_out), batch.patches.numpy()):
        assert abs(patches[:, CENTRE]).min() == 1
    path = folder / "shard-0-0000.npz"
    one, other = (read_changed(path, replace(USUAL, noisy=1.0)) for _ in range(2))
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])
    assert not np.array_equal(one["patches"], read_changed(path, CLEAN)["patches"])


def test_a_run_learns_from_samples_on_the_device(folder, samples):
    recipe = replace(RECIPE, batch_voxels=2000, shares=CLEAN, revive_steps=3)
    store = ResidentStore(folder, 2, recipe.shares, "cpu")
    assert len(store) == len(samples) and len(store.held_out) == 2 * len(samples)
    torch.manual_seed(0)
    run, rng = Run(folder, SuperSdfNet(SMALL), recipe, "cpu"), np.random.default_rng(0)
    losses = [take_step(run, store, rng, 0.1) for _ in range(25)]
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:5])
    write_shard(folder / "shard-1-0000.npz", samples)
    store.refresh()
    [reading] = store.reading
    reading.result()
    store.refresh()
    assert len(store) == len(store.sampler.losses) == 2 * len(samples)
    assert not store.reading
    store.readers.shutdown()
