"""Memory that is short: what was freed goes back to the system, and little is taken."""

import re
import subprocess
import sys
import tracemalloc
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ball, trilinear

from super_sdf import SdfGrid
from super_sdf.errors import OutOfMemoryError
from super_sdf.files import unpacking
from super_sdf.files.grids import read_grid
from super_sdf.grid import census
from super_sdf.grid.census import Census
from super_sdf.grid.field import weigh
from super_sdf.grid.planes import Few, changed, ranks_of
from super_sdf.machine import memory
from super_sdf.threads import Resources
from super_sdf.pipeline import reconstruct_slabs
from super_sdf.refine import band as band_step
from super_sdf.refine import spline
from super_sdf.refine import survey as survey_step
from super_sdf.refine.survey import look_at_band, survey

# Arrays of 4 MB in a row, of which the last stays: the C library keeps what is freed before it.
# Arrays of 4 MB in a row, of which the last stays: the C library keeps what is freed before it.
FREED = """
import sys
import numpy as np
from super_sdf.machine import memory

def free_all_but_one():
    np.ones(3_900_000)  # 31 MB: from now on the library keeps pieces of this size
    return [np.ones(500_000) for _ in range(20)][-1]

start = memory.held_memory()
last = free_all_but_one()
kept = memory.held_memory() - start
memory.give_back()
print(kept, memory.held_memory() - start)
memory.free_memory(), memory.held_memory(peak=True), memory.forget_peak()
assert 'psutil' not in sys.modules
"""


def test_what_is_freed_is_given_back_and_where_proc_is_psutil_is_not_imported():
    run = subprocess.run([sys.executable, "-c", FREED], capture_output=True, text=True, check=True)
    kept, left = map(int, run.stdout.split())
    assert kept > 70e6 and left < 10e6


@pytest.mark.parametrize("error", [OSError, TypeError, AttributeError])
def test_a_c_library_that_has_no_such_calls_is_left_alone(monkeypatch, error):
    def missing(name):
        raise error

    monkeypatch.setattr(memory.ctypes, "CDLL", missing)
    memory.give_back()


def test_sizes_are_said_as_they_are_given():
    assert (memory.in_words(999), memory.in_words(10**13)) == ("0 MB", "10,000.00 GB")


@pytest.fixture
def elsewhere(monkeypatch):
    """Return how to be on a system without /proc, where psutil tells these figures."""

    def go(platform, peak, **figures):
        process = SimpleNamespace(memory_info=lambda: SimpleNamespace(rss=3_000_000, **figures))
        told = SimpleNamespace(
            Process=lambda: process,
            virtual_memory=lambda: SimpleNamespace(available=7_000_000),
            Error=ProcessLookupError,
        )
        usage = SimpleNamespace(
            RUSAGE_SELF=0, getrusage=lambda who: SimpleNamespace(ru_maxrss=peak)
        )
        monkeypatch.setitem(sys.modules, "psutil", told)
        monkeypatch.setitem(sys.modules, "resource", usage if peak else None)
        monkeypatch.setattr(sys, "platform", platform)
        for name in ("SYSTEM", "PROCESS"):
            monkeypatch.setattr(memory, name, Path("/no/proc"))

    return go


@pytest.mark.parametrize(
    "platform, peak, figures, want",
    [
        ("win32", None, {"peak_wset": 5_000_000}, 5_000_000),  # Windows has no getrusage
        ("darwin", 6_000_000, {}, 6_000_000),
        ("freebsd14", 6_000, {}, 6_144_000),  # in kB there
    ],
)
def test_without_proc_psutil_tells_or_nobody(elsewhere, monkeypatch, platform, peak, figures, want):
    elsewhere(platform, peak, **figures)
    assert memory.free_memory() == 7_000_000
    assert memory.held_memory() == 3_000_000 and memory.held_memory(peak=True) == want
    assert memory.memory_bound() == 3_000_000 + 4_200_000
    for module in ("psutil", "resource"):
        monkeypatch.setitem(sys.modules, module, None)
    assert memory.free_memory() is memory.held_memory() is memory.held_memory(peak=True) is None
    assert memory.memory_bound() is None and memory.memory_bound(5) == 5
    memory.check_fits(10**18, "it", "no way out")


def test_psutil_agrees_with_proc(monkeypatch):
    free, held = memory.free_memory(), memory.held_memory()
    monkeypatch.setattr(memory, "SYSTEM", Path("/no/proc"))
    monkeypatch.setattr(memory, "PROCESS", Path("/no/proc"))
    assert memory.held_memory() == pytest.approx(held, rel=0.2)
    assert memory.held_memory(peak=True) >= 0.8 * held
    assert memory.free_memory() >= 0.5 * free  # a container's limit is known to /proc alone


def noise(*shape):
    """Return values of both signs at random: the surface is beside nearly every sample."""
    return np.random.default_rng(0).integers(-100, 101, shape).astype(np.int8)


@contextmanager
def peak_of():
    """Yield a list that gets the most memory that is taken within, in bytes."""
    sizes = []
    tracemalloc.start()
    yield sizes
    sizes.append(tracemalloc.get_traced_memory()[1])
    tracemalloc.stop()


@pytest.mark.parametrize("asked", ["beside", "looked"])
def test_evidence_beside_a_surface_that_is_everywhere_takes_little_memory(asked):
    values = noise(64, 192, 192)
    with peak_of() as peak:
        getattr(Census(values), asked)
    assert peak[0] < 7e7


@pytest.mark.parametrize("most", [1, 100, 10**6])
def test_the_samples_that_are_taken_do_not_depend_on_the_parts(most):
    numbers = np.flatnonzero(np.random.default_rng(0).random(20_000) < 0.3)
    few = Few(most)
    few.append((ranks_of(numbers), numbers))
    whole = few.joined()[1]
    assert len(whole) == min(most, len(numbers)) and (np.diff(whole) > 0).all()
    for count in (2, 50):
        parts = [(ranks_of(part), part) for part in np.array_split(numbers, count)]
        few = Few(most)
        for part in parts:
            few.append(part)
        np.testing.assert_array_equal(few.joined()[1], whole)


def test_few_samples_show_what_all_show(monkeypatch):
    i, j, k = np.indices((40, 40, 40)) * (np.pi / 16)
    values = np.sin(i) * np.cos(j) + np.sin(j) * np.cos(k) + np.sin(k) * np.cos(i)

    def shown():
        return weigh(Census(values).looked, (np.pi / 16,) * 3), Census(values).beside

    everything, whole = shown()
    monkeypatch.setattr(census, "MOST_LOOKED_AT", 500)
    monkeypatch.setattr(census, "MOST_BESIDE", 2000)
    few, beside = shown()
    assert few.samples == 500 < everything.samples and len(beside.bend) == 2000
    assert few.slope == pytest.approx(everything.slope, rel=0.03)
    assert few.wrong == pytest.approx(everything.wrong, abs=0.06)
    assert beside.typical_length == pytest.approx(whole.typical_length, rel=0.05)


def test_the_survey_holds_nothing_twice(monkeypatch):
    grid = SdfGrid.trusted(noise(48, 64, 64), (100.0,) * 3)
    for module in (survey_step, band_step):
        monkeypatch.setattr(module, "BLOCK_SAMPLES", 1 << 14)  # four planes
    with peak_of() as peak:
        band = survey(grid)
    kept = band.patches.nbytes + band.voxel_ijk.nbytes
    assert len(band.voxel_ijk) == 48 * 64 * 64 and peak[0] < 1.3 * kept


@pytest.mark.parametrize("kind, offset", [("ball", 0.7), ("noise", 0.0)])
def test_the_band_is_the_same_in_whatever_blocks_and_windows_it_is_found(kind, offset, monkeypatch):
    rough = 3 * np.random.default_rng(0).normal(size=(20, 12, 15))
    grid = SdfGrid.trusted(ball(24).values if kind == "ball" else rough, (1.0,) * 3)

    def near_offset(seen):
        """Return the samples near an offset, and those of them at which the field jumps."""
        return [
            (sum(jump.near for jump in way), sum(jump.edges for jump in way))
            for way in zip(*seen.jumps)
        ]

    want, seen = survey(grid, offset), look_at_band(grid, offset)
    for window, block in ((3000, 2000), (1, 1)):
        monkeypatch.setattr(survey_step, "WINDOW_SAMPLES", window)
        for module in (survey_step, band_step):
            monkeypatch.setattr(module, "BLOCK_SAMPLES", block)
        band, glance = survey(grid, offset, Resources(2)), look_at_band(grid, offset)
        for name in ("voxel_ijk", "patches", "decoded", "exact"):
            np.testing.assert_array_equal(getattr(band, name), getattr(want, name))
        np.testing.assert_array_equal(band.beyond.number, want.beyond.number)
        np.testing.assert_array_equal(band.beyond.value, want.beyond.value)
        assert glance[:5] == seen[:5] and band.leaves == want.leaves
        assert near_offset(glance) == near_offset(seen)
    assert seen.voxels == np.diff(want.voxels_before).tolist()
    assert seen.decoded == np.diff(want.decoded_before).tolist()
    assert seen.beyond == len(want.beyond.number)


def test_samples_that_were_cut_off_are_not_kept():
    """Most of a grid that was truncated at three voxels is so."""
    band = survey(SdfGrid.trusted(np.clip(ball().values, -3, 3), (1.0,) * 3))
    assert len(band.beyond.number) and np.abs(band.beyond.value).max() < 6


def test_reading_for_the_spline_takes_what_is_planned():
    values = changed(np.zeros((60, 200, 200), np.float32), lambda planes: planes)
    with peak_of() as peak:
        spline.spline_blocks(values, np.full((1, 3), 30, np.int32), 4, 1.0)
    assert peak[0] < spline.spline_bytes(values.shape)


def test_what_a_refusal_says_to_allow_is_enough():
    grid = SdfGrid.trusted(noise(24, 60, 60), (100.0,) * 3)
    bound = memory.held_memory() + 10_000_000
    with pytest.raises(OutOfMemoryError) as refused:
        next(reconstruct_slabs(grid, trilinear, 2, max_memory=bound))
    said = re.match(
        r"factor 2 on 86,400 voxels needs ([\d.]+) (.)B of memory at once, .* allow more "
        r"\(--max-memory\); 100% of the samples are near the surface: is this a distance field\?$",
        str(refused.value),
    )
    enough = int(float(said[1]) * {"M": 1e6, "G": 1e9}[said[2]])
    assert next(reconstruct_slabs(grid, trilinear, 2, max_memory=enough)).meshes


def test_planes_that_are_too_large_are_refused_before_they_are_read(tmp_path):
    path = tmp_path / "wide.npy"
    with path.open("wb") as file:  # sparse: its samples are 0
        header = {"descr": "<f4", "fortran_order": False, "shape": (4, 4096, 4096)}
        np.lib.format.write_array_header_1_0(file, header)
        file.truncate(file.tell() + 4 * 4 * 4096**2)
    bound = memory.held_memory() + 10**8
    with pytest.raises(
        OutOfMemoryError,
        match=r"^planes of 4,096 x 4,096 samples need at least [\d.]+ GB of memory, [\d.]+ [MG]B "
        r"may be used; allow more \(--max-memory\)$",
    ):
        read_grid(path, max_memory=bound)


def test_what_is_unpacked_does_not_go_to_a_folder_in_memory(tmp_path, monkeypatch):
    mounts = tmp_path / "mountinfo"
    device = tmp_path.stat().st_dev
    place = f"36 35 {memory.os.major(device)}:{memory.os.minor(device)} / /tmp rw,noatime"
    np.save(tmp_path / "swapped.npy", np.asfortranarray(ball().values))
    monkeypatch.setattr(memory, "MOUNTS", mounts)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(unpacking.tempfile, "tempdir", None)
    bound = memory.held_memory() // 2  # no room
    for kind, is_memory in (("ext4", False), ("tmpfs", True)):
        mounts.write_text(f"{place} - {kind} none rw\n")
        assert memory.is_in_memory(str(tmp_path)) == is_memory
    with pytest.raises(OutOfMemoryError, match=r"is in memory, too: set TMPDIR to a folder on"):
        read_grid(tmp_path / "swapped.npy", spacing=1, max_memory=bound)
    mounts.write_text("")
    assert not memory.is_in_memory(str(tmp_path)) and not memory.is_in_memory("/no/folder")
    read_grid(tmp_path / "swapped.npy", spacing=1, max_memory=bound)
