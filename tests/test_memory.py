"""Memory that is short: what was freed goes back to the system."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from super_sdf.machine import memory

# Arrays of 4 MB in a row, of which the last stays: the C library keeps what is freed before it.
FREED = """
import numpy as np
from super_sdf.machine.memory import held_memory, give_back

def free_all_but_one():
    np.ones(3_900_000)  # 31 MB: from now on the library keeps pieces of this size
    return [np.ones(500_000) for _ in range(20)][-1]

start = held_memory()
last = free_all_but_one()
kept = held_memory() - start
give_back()
print(kept, held_memory() - start)
"""


def test_what_is_freed_is_given_back():
    run = subprocess.run([sys.executable, "-c", FREED], capture_output=True, text=True, check=True)
    kept, left = map(int, run.stdout.split())
    assert kept > 70e6 and left < 10e6


@pytest.mark.parametrize("error", [OSError, TypeError, AttributeError])
def test_a_c_library_that_has_no_such_calls_is_left_alone(monkeypatch, error):
    def missing(name):
        raise error

    monkeypatch.setattr(memory.ctypes, "CDLL", missing)
    memory.give_back()


@pytest.mark.parametrize(
    "size, want",
    [(32_000_000, "32 MB"), (999, "0 MB"), (10**9, "1.00 GB"), (10**13, "10,000.00 GB")],
)
def test_sizes_are_said_as_they_are_given(size, want):
    assert memory.in_words(size) == want


@pytest.fixture
def elsewhere(monkeypatch):
    """Return how to be on a system without /proc, where psutil tells these figures."""

    def go(platform, **figures):
        process = SimpleNamespace(memory_info=lambda: SimpleNamespace(rss=3_000_000, **figures))
        system = SimpleNamespace(available=7_000_000)
        module = SimpleNamespace(Process=lambda: process, virtual_memory=lambda: system)
        monkeypatch.setitem(sys.modules, "psutil", module)
        monkeypatch.setattr(sys, "platform", platform)
        for name in ("SYSTEM", "PROCESS"):
            monkeypatch.setattr(memory, name, Path("/no/proc"))

    return go


def test_on_windows_psutil_tells(elsewhere, monkeypatch):
    elsewhere("win32", peak_wset=5_000_000)
    monkeypatch.setitem(sys.modules, "resource", None)  # Windows has none
    assert memory.free_memory() == 7_000_000
    assert memory.held_memory() == 3_000_000 and memory.held_memory(peak=True) == 5_000_000
    assert memory.memory_bound() == 3_000_000 + 4_200_000


def test_on_macos_psutil_tells_and_getrusage_the_peak_in_bytes(elsewhere, monkeypatch):
    elsewhere("darwin")
    usage = SimpleNamespace(ru_maxrss=6_000_000)
    resource = SimpleNamespace(RUSAGE_SELF=0, getrusage=lambda who: usage)
    monkeypatch.setitem(sys.modules, "resource", resource)
    assert memory.free_memory() == 7_000_000
    assert memory.held_memory() == 3_000_000 and memory.held_memory(peak=True) == 6_000_000
    monkeypatch.setattr(sys, "platform", "freebsd14")
    assert memory.held_memory(peak=True) == 6_000_000 * 1024


def test_where_nothing_tells_nothing_is_known(elsewhere, monkeypatch):
    elsewhere("win32")
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


def test_where_proc_is_psutil_is_not_imported():
    script = "import sys; from super_sdf.machine import memory as m; m.free_memory();"
    script += "m.held_memory(peak=True); m.forget_peak(); assert 'psutil' not in sys.modules"
    subprocess.run([sys.executable, "-c", script], check=True)
