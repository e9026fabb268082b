"""What a system says of processor and control groups, and what follows, by files that stand in."""

import hashlib
import os
import platform
from pathlib import Path

import numpy as np
import pytest

from super_sdf import load_network
from super_sdf import threads as memory, system
from super_sdf import threads as resources
from super_sdf.threads import bound_of_cores, left_memory
from super_sdf.network.network import Network, find_model, fingerprint_of, small_ball

CORE_2 = "fpu sse sse2 pni ssse3 cx16"
NEHALEM = f"{CORE_2} sse4_1 sse4_2 popcnt"
SANDY_BRIDGE = f"{NEHALEM} avx"
HASWELL = f"{SANDY_BRIDGE} avx2 fma"


@pytest.fixture
def describe(monkeypatch, tmp_path):
    """Let the system describe another processor."""

    def go(text):
        (tmp_path / "cpuinfo").write_text(text)
        monkeypatch.setattr(system, "CPUINFO", str(tmp_path / "cpuinfo"))

    return go


def x86(flags, name="A (R) processor @ 2.60GHz"):
    """Return the description of a machine of two cores."""
    return f"processor\t: 0\nmodel name\t: {name}\nflags\t: {flags}\n\nflags\t: mmx\n"


ARM = "processor\t: 0\nFeatures\t: fp asimd\nCPU part\t: 0xd0c\n\n"


@pytest.mark.parametrize(
    "text, want",
    [
        (x86(HASWELL), "base-int8"),
        (x86(SANDY_BRIDGE), "base"),  # AVX without AVX2
        (x86(NEHALEM), "base-int8"),
        (ARM, "base-int8"),
        ("", "base-int8"),
    ],
)
def test_auto_is_float32_where_int8_is_slower(describe, text, want):
    describe(text)
    assert find_model("base")[0].stem == want
    assert find_model("base", "int8")[0].stem == "base-int8"
    assert find_model("base", "float32")[0].stem == "base"


def test_the_name_of_the_processor(describe, monkeypatch):
    describe(x86(HASWELL))
    assert system.processor_name() == "A (R) processor @ 2.60GHz"
    monkeypatch.setattr(system, "CPUINFO", "missing")
    assert system.processor_name() == (platform.processor() or platform.machine())
    assert system.described() == {} and not system.lacks_avx2()


MB = 10**6


@pytest.fixture
def groups(tmp_path, monkeypatch):
    """Write the files of control groups, by their paths below /sys/fs/cgroup."""

    def write(own, files):
        (tmp_path / "own").write_text(own)
        for name, text in files.items():
            path = tmp_path / "fs" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{text}\n")
        monkeypatch.setattr(system, "GROUPS", tmp_path / "fs")
        monkeypatch.setattr(system, "OWN", tmp_path / "own")

    return write


def group(name, most, taken, kept=0):
    """Return a group's files, version 2."""
    names = "memory.max", "memory.current", "memory.stat"
    texts = most, taken, f"anon 5\ninactive_file {kept}\nactive_file 7"
    return {f"{name}{file}": text for file, text in zip(names, texts)}


def old_group(name, most, taken, kept):
    """Return a group's files, version 1."""
    names = "limit_in_bytes", "usage_in_bytes", "stat"
    texts = most, taken, f"inactive_file 1\ntotal_inactive_file {kept}"
    return {f"memory/{name}memory.{file}": text for file, text in zip(names, texts)}


@pytest.mark.parametrize(
    "own, files, want",
    [
        ("0::/", {}, None),
        ("0::/", group("", "max", 5), None),
        ("0::/", group("", 500 * MB, 450 * MB, 400 * MB), 450 * MB),
        ("0::/", group("", 500 * MB, 600 * MB), 0),
        ("0::/a/b", group("a/b/", "max", 9) | group("a/", 100, 30) | group("", 300, 250), 50),
        ("0::/a/b", group("a/b/", 90, "what?") | group("a/", 100, 30), 70),
        ("0::/not/mounted/here", group("", 100, 40), 60),
        ("4:memory:/a\n1:cpu:/", old_group("a/", 100, 80, 70) | old_group("", 2**63, 90, 0), 90),
        ("3:cpu,cpuacct:/\n4:memory:/gone\n0::/", old_group("", 100, 80, 0), 20),
    ],
)
def test_memory_that_is_left(groups, own, files, want):
    groups(own, files)
    assert left_memory() == want


def test_free_memory_is_what_the_group_leaves_and_without_one_not_bounded(groups, monkeypatch):
    groups("0::/", group("", 80 * MB, 70 * MB, 65 * MB))
    assert memory.free_memory() == 75 * MB
    monkeypatch.setattr(system, "OWN", Path("none"))
    assert left_memory() is None and bound_of_cores() == float("inf")


@pytest.mark.parametrize(
    "own, files, want",
    [
        ("0::/", {"cpu.max": "max 100000"}, 8),
        ("0::/", {"cpu.max": "150000 100000"}, 2),
        ("0::/a", {"cpu.max": "300000 100000", "a/cpu.max": "10000 100000"}, 1),
        ("2:cpu,cpuacct:/", {"cpu/cpu.cfs_quota_us": -1, "cpu/cpu.cfs_period_us": 100000}, 8),
        ("2:cpu,cpuacct:/", {"cpu/cpu.cfs_quota_us": 300000, "cpu/cpu.cfs_period_us": 100000}, 3),
    ],
)
def test_threads_are_cut_to_the_cores_that_are_left(groups, monkeypatch, own, files, want):
    groups(own, files)
    monkeypatch.setattr(resources, "cores_of_system", lambda: 8)
    assert resources.count_cores() == want
    assert resources.useful_threads(200) == resources.useful_threads(0) == want
    assert resources.useful_threads(1) == 1
