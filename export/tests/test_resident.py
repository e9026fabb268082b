"""Samples on a device make the batches that samples turned one by one make."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import export.train
from export.augment import CLEAN, prepare, turn
from export.batches import batch_of, copies_of_queries, encode, means, predict
from export.dataset import write_shard
from export.recipe import RECIPE
from export.resident import MOST_COPIES, Residents, Rows, gather_samples
from export.tests.small_net import SMALL, small_net
from export.tests.test_batches import ball_sample
from export.tests.test_training import some_samples
from export.train import ResidentStore, Run, read_changed, window_losses
from super_sdf.network.symmetry import cube_symmetries

DRAWN, TURNS = [2, 0, 1, 2], [0, 5, 17, 40]


@pytest.fixture(scope="module")
def samples():
    return some_samples()


@pytest.fixture(scope="module")
def prepared(samples):
    return [prepare(sample) for sample in samples]


@pytest.fixture
def residents(prepared):
    made = Residents("cpu")
    made.add(gather_samples(prepared[:1]))
    made.add(gather_samples(prepared[1:]))
    return made


def turned_one_by_one(prepared):
    for index, number in zip(DRAWN, TURNS):
        sample = prepared[index]
        parts = turn(cube_symmetries()[number], sample.patches, sample.table, sample.offsets)
        patches, table, offsets = parts
        yield replace(sample, patches=patches, table=table, offsets=offsets)


def test_a_batch_is_that_of_samples_turned_one_by_one(prepared, residents):
    net, batch = small_net(), residents.batch(DRAWN, TURNS)
    want = batch_of(list(turned_one_by_one(prepared)))
    torch.testing.assert_close(batch.targets, want.targets)
    assert batch.counts == want.counts
    values = [predict(net, each, encode(net, each)) for each in (batch, want)]
    torch.testing.assert_close(*values, atol=1e-5, rtol=0)
    torch.testing.assert_close(*(window_losses(net, each, RECIPE) for each in (batch, want)))


def test_a_mean_is_that_of_the_sample(residents):
    batch = residents.batch([1, 0], [3, 4])
    values = torch.arange(sum(batch.counts), dtype=torch.float32)
    want = [part.mean() for part in values.split(batch.counts)]
    torch.testing.assert_close(means(values, batch), torch.stack(want))


def test_the_copies_of_all_queries_of_a_sample_have_room(samples):
    for sample in samples:
        assert len(copies_of_queries(sample.offsets).query) <= MOST_COPIES


def test_a_sample_with_more_copies_is_refused():
    with pytest.raises(ValueError, match=r"125 queries have \d+ copies, more than 136"):
        gather_samples([prepare(ball_sample())])


def test_appended_rows_stay_in_their_order():
    rows, given = Rows("cpu"), np.random.default_rng(0).normal(size=(40, 3))
    for begin, end in [(0, 1), (1, 2), (2, 20), (20, 21), (21, 40)]:
        rows.append(given[begin:end])
    np.testing.assert_array_equal(rows[torch.arange(40)].numpy(), given)


@pytest.fixture
def folder(tmp_path, samples, monkeypatch):
    monkeypatch.setattr(export.train, "READERS", 1)
    for number in range(3):
        write_shard(tmp_path / f"shard-0-{number:04}.npz", samples)
    return tmp_path


def test_a_run_learns_from_samples_on_the_device(folder, samples):
    recipe = replace(RECIPE, batch_voxels=2000, shares=CLEAN, revive_steps=3)
    store = ResidentStore(folder, 2, recipe.shares, "cpu")
    assert len(store) == len(samples) and len(store.held_out) == 2 * len(samples)
    torch.manual_seed(0)
    run = Run(folder, export.train.SuperSdfNet(SMALL), recipe, "cpu")
    rng = np.random.default_rng(0)
    losses = [export.train.take_step(run, store, rng, 0.1) for _ in range(40)]
    assert np.mean(losses[-5:]) < 0.7 * np.mean(losses[:5])
    store.readers.shutdown()


def test_new_shards_are_taken_in_once_they_are_read(folder, samples):
    store = ResidentStore(folder, 2, CLEAN, "cpu")
    write_shard(folder / "shard-1-0000.npz", samples)
    store.refresh()
    [reading] = store.reading
    reading.result()
    store.refresh()
    assert len(store) == len(store.sampler.losses) == 2 * len(samples)
    assert not store.reading
    store.readers.shutdown()


def test_a_shard_is_changed_in_the_same_way_every_time(folder):
    path = folder / "shard-0-0000.npz"
    shares = replace(export.train.USUAL, noisy=1.0)
    one, other = read_changed(path, shares).arrays, read_changed(path, shares).arrays
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])
    assert not np.array_equal(one["patches"], read_changed(path, CLEAN).arrays["patches"])
