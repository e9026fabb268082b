"""Windows are drawn by their last loss, within bounds; new ones come first."""

import numpy as np

from export.sampler import Sampler, chances


def shown(sampler: Sampler, count: int, spread: float = 3.0) -> list[int]:
    rng = np.random.default_rng(0)
    return [sampler.draw(rng, spread) for _ in range(count)]


def sampler_with(losses: list[float]) -> Sampler:
    sampler = Sampler()
    sampler.add(len(losses))
    sampler.record(range(len(losses)), losses)
    return sampler


def test_every_new_window_comes_once_before_any_comes_again():
    sampler = Sampler()
    sampler.add(50)
    first = shown(sampler, 50)
    assert sorted(first) == list(range(50)) != first
    sampler.record(first, [1.0] * 50)
    sampler.add(5)
    assert sorted(shown(sampler, 5)) == [50, 51, 52, 53, 54]


def test_windows_come_in_proportion_to_their_loss_within_the_spread():
    np.testing.assert_allclose(chances(np.array([0.5, 1.0, 1.5]), 3), np.array([1, 2, 3]) / 6)
    bounded = np.array([2, 3, 2, 18, 2]) / 27
    np.testing.assert_allclose(chances(np.array([0, 1, 0, 9.0, 0]), 3), bounded)
    counts = np.bincount(shown(sampler_with([0.5, 1.0, 1.5]), 6000), minlength=3)
    np.testing.assert_allclose(counts, [1000, 2000, 3000], rtol=0.1)


def test_the_last_loss_counts():
    sampler = sampler_with([9.0, 1.0])
    sampler.record([0], [1.0])
    np.testing.assert_array_equal(chances(sampler.losses, 3), 0.5)


def test_with_a_spread_of_one_all_come_equally_often():
    sampler = sampler_with([1.0, 2.0, 3.0, 100.0])
    np.testing.assert_array_equal(np.bincount(shown(sampler, 40, spread=1.0)), 10)


def test_a_restarted_sampler_shows_every_window_again():
    sampler = sampler_with([1.0, 2.0, 100.0])
    shown(sampler, 1)
    sampler.restart()
    assert sorted(shown(sampler, 3)) == [0, 1, 2]
