"""How far a run is told to be, and how it is stopped."""

import os
import signal
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ball, trilinear
from hypothesis import given
from hypothesis import strategies as st
from test_network import network_inputs

from super_sdf import load_network, reconstruct, upsample
from super_sdf.network import network, running
from super_sdf.network.pace import LINEAR_UP_TO, Pace, share_of_time, work_of
from super_sdf.progress import StepCounter
from super_sdf.steps.nodes import block_offsets


@pytest.fixture
def told():
    """What a progress callback was told."""
    return []


@pytest.fixture
def tell(told):
    """A progress callback."""
    return lambda done, total: told.append((done, total))


@pytest.fixture
def watched(monkeypatch):
    """Watch every run, and poll often."""
    monkeypatch.setattr(network, "LONG_RUN", 0)
    monkeypatch.setattr(running, "POLL_INTERVAL", 1e-4)


def test_steps_are_told_in_thousandths_of_the_usual_time(told, tell):
    reconstruct(ball(), trilinear, progress=tell)
    assert told == [(20, 1000), (800, 1000), (900, 1000), (1000, 1000)]
    told.clear()
    upsample(ball(), trilinear, progress=tell)
    assert told == [(22, 1000), (889, 1000), (1000, 1000)]


@given(st.integers(1, 3000))
def test_any_number_of_slabs_ends_with_all_done(slabs):
    told = []
    steps = StepCounter(lambda done, total: told.append(done))
    steps.divide(slabs)
    steps.finish("band")
    for _ in range(slabs):
        for name in ("network", "nodes", "isosurface"):
            steps.within(name)(0.5)
            steps.finish(name)
    assert told[-1] == 1000 and told == sorted(told)


def test_the_network_tells_how_far_it_is(watched, told, tell):
    reconstruct(ball(), load_network("fast", device="cpu"), progress=tell)
    done = [done for done, total in told]
    assert done == sorted(done) and (done[0], done[-1]) == (20, 1000)
    within = done[1 : done.index(800)] if 800 in done else done
    assert len(within) >= 1 and set(done[-3:]) == {800, 900, 1000}


def test_runs_over_symmetries_are_parts_of_one(watched):
    shares = []
    asked = *network_inputs(ball()), block_offsets(2)
    load_network("best", device="cpu")(*asked, progress=shares.append)
    assert shares == sorted(shares) and 0 < shares[0] < shares[-1] < 1
    assert {int(8 * share) for share in shares} == set(range(8))


def test_watched_runs_give_the_same_bits(monkeypatch):
    asked = *network_inputs(ball()), block_offsets(4)
    fast = load_network("fast", device="cpu")
    plain = fast(*asked)
    monkeypatch.setattr(network, "LONG_RUN", 0)
    np.testing.assert_array_equal(fast(*asked), plain)
    np.testing.assert_array_equal(fast(*asked, progress=lambda share: None), plain)


def test_a_bound_run_is_watched_and_stopped_as_well(monkeypatch):
    monkeypatch.setattr(running, "POLL_INTERVAL", 1e-4)
    feeds = dict(zip(network.INPUTS, (*network_inputs(ball()), block_offsets(4))))
    session, looks = load_network("fast", device="cpu").session, []
    watched = running.run_bound(session, feeds, "cpu", poll=lambda: looks.append(1))
    np.testing.assert_array_equal(watched, running.run_bound(session, feeds, "cpu"))
    assert looks
    with pytest.raises(ZeroDivisionError):
        running.run_bound(session, feeds, "cpu", poll=lambda: 1 / 0)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError("enough")])
def test_what_the_callback_raises_ends_the_run_and_the_next_is_right(watched, error):
    grid, fast = ball(), load_network("fast", device="cpu")
    plain = reconstruct(grid, fast)

    def stop(done, total):
        if done > 20:  # after the band
            raise error

    with pytest.raises(type(error) if isinstance(error, Exception) else error):
        reconstruct(grid, fast, progress=stop)
    np.testing.assert_array_equal(reconstruct(grid, fast).vertices, plain.vertices)


class EndlessSession:
    """A session that runs until it is told to end, as onnxruntime does between two operators."""

    def __init__(self, at_begin=lambda: None):
        self.at_begin, self.ended = at_begin, False

    def io_binding(self):
        return SimpleNamespace(bind_cpu_input=lambda *a: None, bind_output=lambda *a: None)

    def get_outputs(self):
        return [SimpleNamespace(name="values")]

    def run_with_iobinding(self, binding, options):
        self.at_begin()
        while not options.terminate:
            time.sleep(0.01)
        time.sleep(0.1)  # as long as an operator takes
        self.ended = True
        raise RuntimeError("Exiting due to terminate flag being set to true.")


FEEDS = {"patches": np.zeros((1, 27)), "voxels": np.zeros(1), "offsets": np.zeros((1, 3))}


def test_an_interrupt_stops_a_run_in_the_middle():
    session = EndlessSession(lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        running.run_on_cpu(session, FEEDS, poll=lambda: None)
    assert session.ended


def test_a_look_that_raises_stops_a_run_in_the_middle():
    session = EndlessSession()
    with pytest.raises(ZeroDivisionError):
        running.run_on_cpu(session, FEEDS, poll=lambda: 1 / 0)
    assert session.ended


def test_onnxruntime_stops_between_two_chunks():
    """A run that was told to end before it began makes nothing at all."""
    session = load_network("fast", device="cpu").session
    options = running.ort.RunOptions()
    options.terminate = True
    with pytest.raises(Exception, match="terminate flag"):
        session.run(
            None, dict(zip(network.INPUTS, (*network_inputs(ball()), block_offsets(2)))), options
        )


def test_the_pace_is_learnt_from_a_part_only_if_somebody_listens(watched, monkeypatch):
    asked = *network_inputs(ball()), block_offsets(2)
    runs = []
    real = network.run_on_cpu

    def counted(session, feeds, poll=None):
        runs.append(len(feeds["patches"]))
        return real(session, feeds, poll=poll)

    fast = load_network("fast", device="cpu")
    monkeypatch.setattr(network, "run_on_cpu", counted)
    fast(*asked, progress=lambda share: None)
    fast(*asked, progress=lambda share: None)
    assert runs == [network.TRIAL_ROWS - 1, len(asked[0]), len(asked[0])]
    runs.clear()
    other = load_network("fast", device="cpu")
    other(*asked)
    assert runs == [len(asked[0])] and other.pace.seconds > 0


def test_a_part_is_cut_off_from_the_rest():
    table = np.array([[0, 1, 2], [2, 1, -1], [0, 0, 0]], np.int32)
    feeds = dict(zip(network.INPUTS, (np.zeros((3, 27)), table, np.array([2, 1]), "offsets")))
    part = network.crop_inputs(feeds, 2)
    np.testing.assert_array_equal(part["neighbours"], [[0, 1, -1], [-1, 1, -1]])
    assert len(part["patches"]) == 2 and part["voxels"].tolist() == [1]
    assert network.crop_inputs(feeds, 1)["voxels"].tolist() == [0]  # something must be decoded


@given(st.floats(0, 1e6), st.floats(0, 1e6))
def test_the_share_grows_with_time_and_is_never_all(one, two):
    low, high = (share_of_time(seconds, 10.0) for seconds in sorted((one, two)))
    assert 0 <= low <= high < 1
    assert low == min(one, two) / 10 or min(one, two) > 10 * LINEAR_UP_TO


def test_before_anything_is_known_no_time_is_foretold():
    shares = []
    Pace().watch(100, shares.append)()
    assert shares == [0]
    assert work_of(100, 10, 300) == 110


def test_the_bar_has_a_time_that_is_left(tmp_path, monkeypatch, command, watched):
    np.save(tmp_path / "in.npy", ball().values)
    monkeypatch.setattr(type(sys.stderr), "isatty", lambda self: True, raising=False)
    code, _, err = command("upsample", tmp_path / "in.npy", tmp_path / "out.ply", "--spacing", "1")
    assert code == 0 and "upsampling" in err and "100%" in err
