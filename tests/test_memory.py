"""Memory that is short: what was freed goes back to the system."""

import subprocess
import sys

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
