"""Progress reports of a run, and how a run is stopped."""

import os
import signal
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ball, trilinear
from hypothesis import given, settings
from hypothesis import strategies as st
from test_network import network_inputs

from super_sdf import load_network, reconstruct, upsample
from super_sdf.network import network, onnx
from super_sdf.network.onnx import LINEAR_UP_TO, share_of_time
from super_sdf.progress import StepCounter
from super_sdf.refine.nodes import block_offsets


@pytest.fixture
def polled(monkeypatch):
    """Poll during every run, however short, and often."""
    monkeypatch.setattr(network, "LONG_RUN", 0)
    monkeypatch.setattr(onnx, "POLL_INTERVAL", 1e-4)


def reported(work, *arguments):
    """Return the progress that some work reports, in thousandths."""
    reports = []
    work(*arguments, progress=lambda done, total: reports.append((done, total)))
    assert {total for _, total in reports} == {1000}
    return [done for done, _ in reports]


def test_steps_are_reported_in_thousandths_of_their_usual_time():
    assert reported(reconstruct, ball(), trilinear) == [30, 480, 630, 1000]
    assert reported(upsample, ball(), trilinear) == [48, 762, 1000]


@settings(max_examples=20)
@given(st.integers(1, 3000))
def test_any_number_of_slabs_ends_with_all_done(slabs):
    reports = []
    steps = StepCounter(lambda done, total: reports.append(done))
    steps.divide(slabs)
    steps.finish("band")
    for _ in range(slabs):
        for name in ("network", "nodes", "isosurface"):
            steps.within(name)(0.5)
            steps.finish(name)
    assert reports[-1] == 1000 and reports == sorted(reports)


def test_the_network_reports_progress_during_a_run(polled):
    done = reported(reconstruct, ball(), load_network("fast", device="cpu"))
    assert done == sorted(done) and (done[0], done[-1]) == (30, 1000)
    within = done[1 : done.index(480)] if 480 in done else done
    assert len(within) >= 1 and set(done[-3:]) == {480, 630, 1000}


def test_runs_over_symmetries_are_reported_as_parts_of_one(polled):
    shares = []
    inputs = *network_inputs(ball()), block_offsets(2)
    load_network("best", device="cpu")(*inputs, progress=shares.append)
    assert shares == sorted(shares) and 0 < shares[0] < shares[-1] < 1
    assert {int(4 * share) for share in shares} == set(range(4))


def test_polled_runs_give_the_same_bits_and_bound_ones_are_polled_and_stopped(polled):
    inputs = *network_inputs(ball()), block_offsets(4)
    fast, polls = load_network("fast", device="cpu"), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(network, "LONG_RUN", 10**9)
        plain = fast(*inputs)
    np.testing.assert_array_equal(fast(*inputs), plain)
    np.testing.assert_array_equal(fast(*inputs, progress=lambda share: None), plain)
    session, feeds = fast.session, dict(zip(network.INPUTS, inputs))
    bound = onnx.run_bound(session, feeds, "cpu", poll=lambda: polls.append(1))
    np.testing.assert_array_equal(bound, onnx.run_bound(session, feeds, "cpu"))
    np.testing.assert_allclose(bound, session.run(None, feeds)[0], atol=1e-5)
    assert polls
    with pytest.raises(ZeroDivisionError):
        onnx.run_bound(session, feeds, "cpu", poll=lambda: 1 / 0)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_exception_in_the_callback_ends_the_run_and_the_next_is_right(polled, error):
    grid, fast = ball(), load_network("fast", device="cpu")
    plain = reconstruct(grid, fast, 2)

    def stop(done, total):
        if done > 20:  # after the band
            raise error

    with pytest.raises(error):
        reconstruct(grid, fast, 2, progress=stop)
    np.testing.assert_array_equal(reconstruct(grid, fast, 2).vertices, plain.vertices)


class EndlessSession:
    """A session that runs until ``terminate`` is set, as onnxruntime does between operators."""

    ended = False

    def io_binding(self):
        return SimpleNamespace(bind_cpu_input=lambda *a: None, bind_output=lambda *a: None)

    def get_outputs(self):
        return [SimpleNamespace(name="values")]

    def get_overridable_initializers(self):
        return []

    def get_session_options(self):
        return SimpleNamespace(intra_op_num_threads=1)

    def run_with_iobinding(self, binding, options):
        os.kill(os.getpid(), signal.SIGINT)
        while not options.terminate:
            time.sleep(0.01)
        time.sleep(0.1)  # as long as an operator takes
        self.ended = True
        raise RuntimeError("Exiting due to terminate flag being set to true.")


class DeafSession(EndlessSession):
    """A session with an operator that does not end, and a user who presses Ctrl-C twice."""

    def run_with_iobinding(self, binding, options):
        self.thread, self.released = threading.current_thread(), threading.Event()
        for is_wanted in (lambda: True, lambda: options.terminate):
            while not is_wanted():
                time.sleep(0.01)
            time.sleep(0.1)  # no user is faster: the first one waits by then
            os.kill(os.getpid(), signal.SIGINT)
        self.released.wait()


@pytest.mark.parametrize("kind", [EndlessSession, DeafSession])
def test_an_interrupt_stops_a_run_in_the_middle_and_a_second_one_does_not_wait(kind):
    # a shell has processes in the background ignore SIGINT
    before, session = signal.signal(signal.SIGINT, signal.default_int_handler), kind()
    feeds = {"patches": np.zeros((1, 27)), "voxels": np.zeros(1), "offsets": np.zeros((1, 3))}
    try:
        with pytest.raises(KeyboardInterrupt):
            onnx.run_on_cpu(session, feeds)
    finally:
        signal.signal(signal.SIGINT, before)
    if kind is EndlessSession:
        assert session.ended
    else:
        assert session.thread.is_alive() and session.thread.daemon  # so this process can end
        session.released.set()


def test_the_pace_is_measured_in_a_part_only_if_progress_is_reported(polled, monkeypatch):
    inputs = *network_inputs(ball()), block_offsets(2)
    runs = []
    real = network.run_on_cpu

    def counted(session, feeds, poll=None):
        runs.append(len(feeds["patches"]))
        return real(session, feeds, poll=poll)

    fast = load_network("fast", device="cpu")
    monkeypatch.setattr(network, "run_on_cpu", counted)
    fast(*inputs, progress=lambda share: None)
    fast(*inputs, progress=lambda share: None)
    assert runs == [network.TRIAL_ROWS - 1, len(inputs[0]), len(inputs[0])]
    runs.clear()
    other = load_network("fast", device="cpu")
    other(*inputs)
    assert runs == [len(inputs[0])] and other.pace.seconds > 0


@given(st.floats(0, 1e6), st.floats(0, 1e6))
def test_the_share_grows_with_time_and_is_never_all(one, two):
    low, high = (share_of_time(seconds, 10.0) for seconds in sorted((one, two)))
    assert 0 <= low <= high < 1
    assert low == min(one, two) / 10 or min(one, two) > 10 * LINEAR_UP_TO


def test_the_progress_bar_runs_to_100_percent(tmp_path, monkeypatch, command, polled):
    np.save(tmp_path / "in.npy", ball().values)
    monkeypatch.setattr(type(sys.stderr), "isatty", lambda self: True, raising=False)
    code, _, err = command("upsample", tmp_path / "in.npy", tmp_path / "out.ply", "--spacing", "1")
    assert code == 0 and "upsampling" in err and "100%" in err
    words = "--spacing", "1", "--triangles", "500"
    code, _, err = command("upsample", tmp_path / "in.npy", tmp_path / "few.ply", *words)
    assert code == 0 and err.index("upsampling") < err.index("simplifying") < err.index("100%")
