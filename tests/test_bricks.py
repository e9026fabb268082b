"""One grid on the workers of a cluster: the same bytes as on one machine, or a clear refusal."""

import os
import pickle
import re
import signal
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import zarr
from conftest import ball
from test_slabs import bad_samples, rod

from super_sdf import load_network
from super_sdf.bricks import engine, passes, stored
from super_sdf.bricks.engine import BricksEngine
from super_sdf.bricks.meshing import Loading, prepare_meshing
from super_sdf.bricks.passes import Brick, Queue, ordered
from super_sdf.bricks.stored import Source, StoredPlanes
from super_sdf.cluster.connecting import connect
from super_sdf.convert import ConvertOptions, convert
from super_sdf.errors import ClusterError, GridError, MeshError, OptionError
from super_sdf.grid.planes import DerivedPlanes

LOADING = Loading("fast", "auto", "cpu")
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
    monkeypatch.setattr(engine, "LEAST_PER_WORKER", 5)


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
    """Convert on one machine and on a cluster; return both results and the engine."""
    source = store(values, chunks)
    chosen = ConvertOptions(**{"spacing": (1.0,), "factor": 2, **options})
    bricks = BricksEngine(cluster, LOADING)
    here = convert("a.npy", "here.ply", network, chosen)
    there = convert(source, "there.ply", network, chosen, engine=bricks)
    return here, there, bricks


def check_same(here, there, bricks):
    """Check that files, counts, notes and warnings are the same."""
    assert Path("there.ply").read_bytes() == Path("here.ply").read_bytes()
    assert bricks.bricks > 2
    left_out = {"slabs", "planned_bytes", "bricks", "workers"}
    here, there = here.report(), there.report()
    for name in here.keys() - left_out:
        assert there[name] == here[name], name


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("mesher", ["marching", "sharp"])
def test_the_mesh_is_that_of_one_machine(cluster, network, layout, mesher):
    check_same(*both(cluster, network, rod(), LAYOUTS[layout], mesher=mesher))


FIELDS = {
    "leaves the grid": (rod()[4:52, :10], {}),
    "left open": (rod()[4:52, :10], {"cap": False}),
    "positive inside": (-rod(), {}),
    "offset": (rod(), {"offset": 1.3}),
    "bad samples": (bad_samples(rod()), {}),
    "spacing inferred": (rod() * 0.25, {"spacing": None}),
    "scale": (rod() * 10, {"scale": 0.1}),
    "mask": (rod() < 0, {}),
    "label": ((rod() < 0) * np.int16(6), {"label": 6.0}),
    "truncated": (np.clip(rod(), -1.2, 1.2), {}),
    "level": (100 - rod() * 10, {"level": 100.0, "scale": 0.1}),
    "simplified": (rod(), {"simplify": 0.05}),
    "placed": (rod(), {"origin": (3.0, 4.0, 5.0), "direction": (0, -1, 0, 1, 0, 0, 0, 0, 1)}),
    "integers": (np.rint(rod() * 40).astype(np.int16), {"scale": 1 / 40}),
}


@pytest.mark.parametrize("field", FIELDS)
def test_other_fields_and_options(cluster, network, field):
    values, options = FIELDS[field]
    check_same(*both(cluster, network, values, LAYOUTS["cubes"], **options))


def test_a_killed_worker_costs_its_bricks(cluster, network, monkeypatch):
    source, chosen = store(rod(), (8, 8, 8)), ConvertOptions(spacing=(1.0,), factor=2)
    convert("a.npy", "here.ply", network, chosen)
    bricks, killed, lost = BricksEngine(cluster, LOADING), [], []
    monkeypatch.setattr(
        Queue,
        "take_back",
        lambda own, brick, cause, to=Queue.take_back: lost.append(brick) or to(own, brick, cause),
    )

    def kill(done, total):
        if done > 300 and not killed:
            killed.append(bricks.team.checked.members[0].report.pid)
            os.kill(killed[0], signal.SIGKILL)

    convert(source, "there.ply", network, chosen, engine=bricks, progress=kill)
    assert killed and len(lost) <= 2
    assert Path("there.ply").read_bytes() == Path("here.ply").read_bytes()


class Off:
    """A network as a processor that rounds differently might compute it, only more so."""

    def __init__(self, network):
        self.network, self.receptive_field = network, network.receptive_field

    def __call__(self, *given):
        return self.network(*given) + np.float32(0.05)


class OtherProcessor(Loading):
    """Loads such a network."""

    def load(self, threads):
        return Off(super().load(threads))


def prepare_as_two(source, loading, limits):
    """Prepare a worker that makes the bricks from the fifth on as another processor."""
    one, other = (
        prepare_meshing(source, some, limits) for some in (loading, OtherProcessor(*loading))
    )
    return lambda brick, check: (one if brick.number < 5 else other)(brick, check)


def test_bricks_of_processors_that_round_differently_are_an_error(cluster, network, monkeypatch):
    cluster.client.wait_for_workers(2)  # one that was killed comes back; bricks depend on it
    monkeypatch.setattr(engine, "prepare_meshing", prepare_as_two)
    said = refusal(cluster, network, rod(), factor=2)
    assert re.fullmatch(
        r"the mesh is torn, with 110 open edges at plane 29, between planes 24 to 28 \(\S+:\d+\) "
        r"and planes 29 to 33 \(\S+:\d+\): use workers with the same processor, NumPy and "
        "onnxruntime",
        said,
    )


def test_a_brick_that_was_tampered_with_is_an_error(cluster, network, monkeypatch):
    add, bricks = engine.Joining.add, []

    def spoil(self, made):
        bricks.append(made)
        if len(bricks) == 3:
            faces = made.pieces[0].meshes[0].faces
            faces[np.flatnonzero((faces < 0).sum(1) == 2)[0]] = 0  # no triangle any more
        return add(self, made)

    monkeypatch.setattr(engine.Joining, "add", spoil)
    said = refusal(cluster, network, rod(), factor=2)
    plane = bricks[2].pieces[0].planes[0]
    assert said.startswith(f"the mesh is torn, with 1 open edge at plane {plane}, between planes ")


def refusal(cluster, network, values, **options):
    """Return the error for a grid that cannot be converted on a cluster."""
    store(values, None)
    chosen = ConvertOptions(**{"spacing": (1.0,), **options})
    with pytest.raises((OptionError, GridError, ClusterError, MeshError)) as caught:
        convert("a.npy", "o.ply", network, chosen, engine=BricksEngine(cluster, LOADING))
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


def test_a_grid_that_the_workers_do_not_see(cluster, network):
    """Below /proc/self, each process sees its own working folder."""
    store(rod(), None)
    path = Path("/proc/self/cwd/a.npy")
    with pytest.raises(ClusterError) as caught:
        convert(path, "o.ply", network, ConvertOptions(), engine=BricksEngine(cluster, LOADING))
    assert re.fullmatch(
        r"worker tcp://127.0.0.1:\d+( and 1 other)? does not see /proc/self/cwd/a.npy: put the "
        r"inputs where all machines see them by this path",
        str(caught.value),
    )


REFUSED = {
    ("a.npz",): "a.npz cannot be read by several workers at once: --cluster takes .zarr and .npy; "
    "convert it on one machine (without --cluster), or save it as .zarr",
    ("a.npy", "--axes", "zyx"): "axes is 'zyx', but workers read planes of x of a.npy: "
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


def test_results_come_in_order_also_through_files(monkeypatch):
    monkeypatch.setattr(passes, "SPOOLED", 10)
    found = [(2, "c" * 20), (0, "a"), (3, "d"), (1, np.arange(9)), (4, "e")]
    got = list(ordered(found))
    np.testing.assert_array_equal(got[1], np.arange(9))
    assert [*got[:1], *got[2:]] == ["a", "c" * 20, "d", "e"]


def test_workers_get_bricks_that_lie_beside_each_other():
    bricks = [Brick(number, number, number + 1, None) for number in range(7)]
    queue = Queue.of(bricks, ["one", "two"])
    assert [queue.pop_for("one").number for _ in range(2)] == [0, 1]
    assert [queue.pop_for("two").number for _ in range(2)] == [4, 5]
    assert [queue.pop_for("one").number for _ in range(3)] == [2, 3, 6]
    queue.take_back(bricks[3], "was lost")
    assert len(queue) == 1 and queue.pop_for("a worker that came later") == bricks[3]
    with pytest.raises(ClusterError) as caught:
        queue.take_back(bricks[3], "was lost")
    assert str(caught.value) == (
        "the worker that had planes 3 to 3 was lost, and so did the next one: see their logs, or "
        "give less memory (--max-memory)"
    )


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


def test_spacing_origin_and_direction_of_the_store(cluster, network):
    """The array's own axes run backwards, so planes of x begin at its end."""
    made = zarr.create_array("b.zarr", shape=rod().T.shape, chunks=(8, 8, 8), dtype="f8")
    made[:] = rod().T
    made.attrs.update(spacing=0.5, origin=[1, 2, 3], direction=[-1, 0, 0, 0, -1, 0, 0, 0, 1])
    chosen = ConvertOptions(factor=2, scale=0.5)
    here = convert("b.zarr", "here.ply", network, chosen)
    bricks = BricksEngine(cluster, LOADING)
    check_same(here, convert("b.zarr", "there.ply", network, chosen, engine=bricks), bricks)


def test_a_file_that_changed_since_the_last_conversion(cluster, network):
    """Workers stay, but what they have unpacked of the file does not."""
    for values in (rod(), rod() - 0.2):
        made = zarr.create_array(
            "b.zarr", shape=values.T.shape, chunks=(8, 8, 8), dtype="f8", overwrite=True
        )
        made[:] = values.T
        chosen = ConvertOptions(factor=2, spacing=(1.0,))
        here = convert("b.zarr", "here.ply", network, chosen, force=True)
        bricks = BricksEngine(cluster, LOADING)
        there = convert("b.zarr", "there.ply", network, chosen, engine=bricks, force=True)
        check_same(here, there, bricks)
