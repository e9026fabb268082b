"""Samples on a device make the batches that samples turned one by one make."""

from dataclasses import replace

import pytest
import torch

from export.augment import prepare
from export.batches import batch_of, copies_of_queries, encode, predict
from export.recipe import RECIPE, window_losses
from export.resident import MOST_COPIES, Residents, gather_samples
from export.tests.small_net import small_net
from export.tests.test_batches import ball_sample
from super_sdf.network.neighbourhood import cube_symmetries, turn

DRAWN, TURNS = [2, 0, 1, 2], [0, 5, 17, 40]


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


def test_the_copies_of_all_queries_of_a_sample_have_room_or_are_refused(samples):
    assert all(len(copies_of_queries(one.offsets).query) <= MOST_COPIES for one in samples)
    with pytest.raises(ValueError, match=r"125 queries have \d+ copies, more than 136"):
        gather_samples([prepare(ball_sample())])
