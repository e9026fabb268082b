"""Progress reports of a run, and how a run is stopped."""

import sys

import numpy as np
import pytest
from conftest import ball, trilinear
from test_tiles import Close

from super_sdf import load_network, reconstruct, upsample
from super_sdf.options import Options
from super_sdf.pipeline import mesh_grid


def reported(work, *arguments):
    """Return the progress that some work reports, in thousandths."""
    reports = []
    work(*arguments, progress=lambda done, total: reports.append((done, total)))
    assert {total for _, total in reports} == {1000}
    return [done for done, _ in reports]


def test_steps_are_reported_in_thousandths_of_their_usual_time():
    assert reported(reconstruct, ball(), trilinear) == [30, 480, 630, 1000]
    assert reported(upsample, ball(), trilinear) == [48, 762, 1000]


def test_tiles_are_reported_as_they_are_made():
    done = []
    mesh_grid(ball(), Close(), Options(2), progress=lambda n, _: done.append(n), least_tiles=3)
    assert done == sorted(done) and (done[0], done[-1]) == (30, 1000) and len(set(done)) == 4


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_exception_in_the_callback_ends_the_run_and_the_next_is_right(error):
    grid, fast = ball(), load_network("fast", device="cpu")
    plain = reconstruct(grid, fast, 2)

    def stop(done, total):
        if done > 20:  # after the band
            raise error

    with pytest.raises(error):
        reconstruct(grid, fast, 2, progress=stop)
    np.testing.assert_array_equal(reconstruct(grid, fast, 2).vertices, plain.vertices)


def test_the_progress_bar_says_that_it_reads_and_runs_to_100_percent(
    tmp_path, monkeypatch, command
):
    np.save(tmp_path / "in.npy", ball().values)
    monkeypatch.setattr(type(sys.stderr), "isatty", lambda self: True, raising=False)
    code, _, err = command("upsample", tmp_path / "in.npy", tmp_path / "out.ply", "--spacing", "1")
    assert code == 0 and err.index("reading") < err.index("upsampling") < err.index("100%")
