"""One grid on the workers of a cluster: the same bytes as on one machine, or a clear refusal."""

import os
import pickle
import re
import signal
import warnings
from functools import partial
from pathlib import Path
from threading import Event

import numpy as np
import pytest
import zarr
from conftest import ball
from test_slabs import bad_samples, rod

from super_sdf import load_network
from super_sdf.cluster import bricks, stored
from super_sdf.cluster.bricks import BrickWork, check_can_brick, convert_on_cluster
from super_sdf.cluster.checking import Needs, check_workers
from super_sdf.cluster.connecting import connect
from super_sdf.cluster.crew import Crew
from super_sdf.cluster.stored import Source, StoredPlanes
from super_sdf.convert import ConvertOptions, convert
from super_sdf.errors import ClusterError, GridError, MeshError, OptionError
from super_sdf.files.volume import PLACE
from super_sdf.grid.planes import DerivedPlanes
from super_sdf.options import GRID, Values

NETWORK = Needs("fast", "auto", "cpu")
LAYOUTS = {"cubes": (8, 8, 8), "first axis whole": (15, 14, 3), "npy": None}


@pytest.fixture(scope="module")
def cluster():
    with connect("local", workers=2, threads=1) as connected:
        yield connected


@pytest.fixture(scope="module")
def network():
    return load_network("fast", device="cpu", threads=1)


@pytest.fixture(autouse=True)
def many_bricks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bricks, "MESH_BRICKS", 2)
    monkeypatch.setattr(bricks, "PASS_BRICKS", 1)


def store(values, chunks):
    """Write an array (x, y, z) as it is stored: .npy, or Zarr (z, y, x)."""
    np.save("a.npy", values)
    if chunks is None:
        return "a.npy"
    fitting = tuple(map(min, chunks, values.T.shape))
    made = zarr.create_array("a.zarr", shape=values.T.shape, chunks=fitting, dtype=values.dtype)
    made[:] = values.T
    return "a.zarr"


def both(cluster, network, values, chunks, **options):
    """Convert on one machine and on a cluster; return both results."""
    source = store(values, chunks)
    chosen = ConvertOptions(**{"spacing": (1.0,), "factor": 2, **options})
    here = convert("a.npy", "here.ply", network, chosen)
    return here, on_cluster(cluster, source, chosen)


def on_cluster(cluster, source, chosen, target="there.ply", **more):
    """Convert on a cluster."""
    return convert_on_cluster(source, target, cluster, NETWORK, chosen, force=True, **more)


def check_same(here, there):
    """Check that files, counts, notes and warnings are the same."""
    assert Path("there.ply").read_bytes() == Path("here.ply").read_bytes()
    assert there.report()["bricks"] > 2
    left_out = {"slabs", "planned_bytes", "bricks", "workers"}
    here, there = here.report(), there.report()
    for name in here.keys() - left_out:
        assert there[name] == here[name], name


@pytest.mark.parametrize(
    ("layout", "mesher"), [("cubes", "marching"), ("first axis whole", "sharp"), ("npy", "sharp")]
)
def test_the_mesh_is_that_of_one_machine(cluster, network, layout, mesher):
    check_same(*both(cluster, network, rod(), LAYOUTS[layout], mesher=mesher))


TURNED = (0, -1, 0, 1, 0, 0, 0, 0, 1)
FIELDS = {
    "leaves the grid, positive inside": (-rod()[4:52, :10], {"cap": False}),
    "bad samples, spacing inferred": (bad_samples(rod()) * 0.25, {"spacing": None}),
    "label": ((rod() < 0) * np.int16(6), {"label": 6.0}),
    "truncated": (np.clip(rod(), -1.2, 1.2), {}),
    "level": (100 - rod() * 10, {"level": 100.0, "scale": 0.1}),
    "integers, placed": (
        np.rint(rod() * 40).astype(np.int16),
        {"scale": 1 / 40, "origin": (3.0, 4.0, 5.0), "direction": TURNED, "offset": 1.3},
    ),
}


@pytest.mark.parametrize("field", FIELDS)
def test_other_fields_and_options(cluster, network, field):
    values, options = FIELDS[field]
    check_same(*both(cluster, network, values, LAYOUTS["cubes"], **options))


def test_a_killed_worker_costs_its_bricks(cluster, network):
    source, chosen = store(rod(), (8, 8, 8)), ConvertOptions(spacing=(1.0,), factor=2)
    convert("a.npy", "here.ply", network, chosen)
    killed = []

    def kill(done, total):
        if done > 300 and not killed:
            killed.append(next(iter(cluster.client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

    on_cluster(cluster, source, chosen, progress=kill)
    assert killed and Path("there.ply").read_bytes() == Path("here.ply").read_bytes()


class Off:
    """A network as a processor that rounds differently might compute it, only more so."""

    def __init__(self, network):
        self.network, self.receptive_field = network, network.receptive_field

    def __call__(self, *given):
        return self.network(*given) + np.float32(0.05)


class TwoProcessors(BrickWork):
    """Makes the bricks from plane 29 on as another processor."""

    def mesh(self, task, check):
        network, vars(self)["network"] = self.network, None
        vars(self)["network"] = network if task.planes[0] < 29 else Off(network)
        made = super().mesh(task, check)
        vars(self)["network"] = network
        return made


def test_bricks_of_processors_that_round_differently_are_an_error(cluster, network, monkeypatch):
    cluster.client.wait_for_workers(2)  # one that was killed comes back; bricks depend on it
    monkeypatch.setattr(bricks, "BrickWork", TwoProcessors)
    monkeypatch.setattr(bricks, "MESH_BRICKS", 5)
    said = refusal(cluster, network, rod(), factor=2)
    assert re.fullmatch(
        r"the mesh is torn, with 110 open edges at plane 29, between planes 24 to 28 \(\S+:\d+\) "
        r"and planes 29 to 33 \(\S+:\d+\): use workers with the same processor, NumPy and "
        "onnxruntime",
        said,
    )


def refusal(cluster, network, values, **options):
    """Return the error for a grid that cannot be converted on a cluster."""
    store(values, None)
    chosen = ConvertOptions(**{"spacing": (1.0,), **options})
    with pytest.raises((OptionError, GridError, ClusterError, MeshError)) as caught:
        on_cluster(cluster, "a.npy", chosen, "o.ply")
    assert not Path("o.ply").exists()
    return str(caught.value)


def test_fields_that_need_the_whole_grid_are_refused(cluster, network, tmp_path):
    assert refusal(cluster, network, rod() ** 3 / 9) == (
        "the values are taken as scaled, and their spline goes through the whole grid at once: "
        "convert it on one machine (without --cluster); or give --field exact, if they are "
        "distances"
    )
    assert refusal(cluster, network, rod() * [1.0], spacing=(1.0, 1.0, 0.99)).startswith(
        "the spacing 1, 1, 0.99 differs between axes, and the whole grid is resampled for that: "
        "convert it on one machine (without --cluster)"
    )
    unknown, stands, labels = rod(), rod(), np.zeros(rod().shape, np.uint8)
    unknown[0, 0, 0] = np.nan
    stands[:4] = -1000
    labels[4:-4, 4:-4, 4:-4] = 7
    labels[4:9, 4:-4, 4:-4] = 200
    for values in (unknown, stands, labels, np.abs(rod())):
        assert refusal(cluster, network, values) == (
            f"{tmp_path}/a.npy has unknown samples (NaN, or numbers that may stand for them), "
            "labels, none inside, or not the label that is asked for: to look into that takes the "
            "whole grid, so convert it on one machine (without --cluster)"
        )


def test_errors_are_those_of_one_machine(cluster, network):
    for options in ({"offset": 40.0}, {"spacing": (0.1,)}):
        store(rod(), None)
        chosen = ConvertOptions(**{"spacing": (1.0,), **options})
        with pytest.raises(GridError) as here:
            convert("a.npy", "o.ply", network, chosen)
        assert refusal(cluster, network, rod(), **options) == str(here.value)
    cut_off = np.where(rod() > 2.4, 2.4, rod())
    with pytest.raises(GridError) as here:
        np.save("a.npy", cut_off)
        convert("a.npy", "o.ply", network, ConvertOptions(spacing=(1.0,), offset=1.5))
    assert refusal(cluster, network, cut_off, offset=1.5) == str(here.value)


def test_workers_that_cannot_run_the_network_say_why(cluster):
    Path("bad.onnx").write_bytes(b"no network")
    bad = Path("bad.onnx").absolute()
    want = rf"^worker tcp://\S+( and 1 other)? cannot run the network: {re.escape(str(bad))} "
    with pytest.raises(ClusterError, match=want):
        check_workers(cluster, Needs(str(bad)))


def prepare_to_count(limits):
    """Return work that only returns its task."""
    return lambda task, check_wanted: task


def test_results_that_nobody_takes_may_be_collected_by_the_thread_of_dask(cluster):
    with Crew(cluster, NETWORK, prepare_to_count, pytest.fail) as crew:
        results = crew.in_order(range(9))
        assert next(results) == 0 and (given := list(crew.given))
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            closed = Event()
            close = lambda: (results.close(), closed.set())  # noqa: E731
            cluster.client.loop.asyncio_loop.call_soon_threadsafe(close)
            assert closed.wait(60)
        assert not [str(one.message) for one in said if "never awaited" in str(one.message)]
    assert all(future.cancelled() for future in given)


def test_workers_know_each_option_of_reading():
    # refuse others, or hand them on
    assert set(GRID) == {*PLACE, "axes", "space", *Values.__annotations__}
    with pytest.raises(OptionError, match="states neither RAS nor LPS"):
        check_can_brick("a.npy", ConvertOptions(space="RAS"))


def test_a_grid_that_the_workers_do_not_see(cluster, network):
    """Below /proc/self, each process sees its own working folder."""
    store(rod(), None)
    path = Path("/proc/self/cwd/a.npy")
    with pytest.raises(ClusterError) as caught:
        on_cluster(cluster, path, ConvertOptions(), "o.ply")
    assert re.fullmatch(
        r"worker tcp://127.0.0.1:\d+( and 1 other)? does not see /proc/self/cwd/a.npy: put the "
        r"inputs where all machines see them by this path",
        str(caught.value),
    )


REFUSED = {
    ("a.npz",): "a.npz cannot be read by several workers at once: --cluster takes .zarr and .npy; "
    "convert it on one machine (without --cluster), or save it as .zarr",
    ("a.npy", "--axes", "zyx"): "--axes is zyx, but workers read planes of x of a.npy: "
    "convert it on one machine (without --cluster), or save it as .zarr",
    ("a.npy", "--save-field", "f.npz"): "--save-field writes one file from the first plane on: "
    "convert it on one machine (without --cluster)",
}


@pytest.mark.parametrize("words", REFUSED)
def test_options_that_are_refused_before_a_worker_is_started(command, words, monkeypatch):
    monkeypatch.setattr("super_sdf.cluster.connecting.connect", lambda *_, **__: 1 / 0)
    source, *options = words
    code, _, said = command("upsample", source, "o.ply", *options, "--cluster", "local")
    assert code == 2
    assert said == f"Error: {REFUSED[words]}\n"


def test_jobs_without_a_cluster(command):
    code, _, said = command("upsample", "a.npy", "o.ply", "--jobs", 2)
    want = "Error: --jobs 2 is for --cluster local: give that, too, or leave it out\n"
    assert (code, said) == (2, want)


def test_the_command(command):
    store(rod().astype(np.float32), (8, 8, 8))
    options = ("--quality", "fast", "--factor", 2, "--spacing", 1, "--quiet")
    assert command("upsample", "a.npy", "here.ply", *options) == (0, "", "")
    here = ("--cluster", "local", "--jobs", 1, "--json")
    code, out, said = command("upsample", "a.zarr", "there.ply", *options, *here)
    assert (code, said) == (0, "")
    assert Path("there.ply").read_bytes() == Path("here.ply").read_bytes()
    assert '"bricks": ' in out and '"peak_bytes": ' in out


def test_layers_are_unpacked_once_and_samples_travel_by_their_path(monkeypatch):
    values = ball(shape=(20, 18, 16)).values
    store(values, (4, 4, 4))
    made = []
    original = stored.unpacked
    monkeypatch.setattr(stored, "PIECE", 1)
    monkeypatch.setattr(stored, "unpacked", lambda *a: made.append(a[-1]) or original(*a))
    samples = StoredPlanes(Source(str(Path("a.zarr").absolute()), None), values.shape, values.dtype)
    for first in range(0, 20, 3):
        np.testing.assert_array_equal(samples[first : first + 5], values[first : first + 5])
    assert made == [(first, first + 4) for first in range(0, 20, 4)]
    derived = DerivedPlanes(samples, partial(np.multiply, 2.0))
    packed = pickle.dumps(derived)
    assert len(packed) < 1000
    np.testing.assert_array_equal(pickle.loads(packed)[7:9], 2.0 * values[7:9])
    assert len(made) == 5
    stored.close_stores()


def test_a_file_that_changed_since_the_last_conversion(cluster, network):
    """Workers stay, but what they have unpacked of the file does not.

    The array's own axes run backwards, so planes of x begin at its end.
    """
    chosen = ConvertOptions(factor=2, scale=0.5)
    for values in (rod(), rod() - 0.2):
        made = zarr.create_array(
            "b.zarr", shape=values.T.shape, chunks=(8, 8, 8), dtype="f8", overwrite=True
        )
        made[:] = values.T
        made.attrs.update(spacing=0.5, origin=[1, 2, 3], direction=[-1, 0, 0, 0, -1, 0, 0, 0, 1])
        there = on_cluster(cluster, "b.zarr", chosen)
    check_same(convert("b.zarr", "here.ply", network, chosen), there)
