"""What control groups allow, by files that stand in."""

from types import SimpleNamespace

import pytest

from super_sdf import threads

MB = 10**6
FREE = 1024 * MB  # as the system says


@pytest.fixture
def groups(tmp_path, monkeypatch):
    """Write the files of control groups, by their paths below /sys/fs/cgroup."""

    def write(own, files):
        (tmp_path / "own").write_text(own)
        for name, text in files.items():
            path = tmp_path / "fs" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{text}\n")
        monkeypatch.setattr(threads, "GROUPS", tmp_path / "fs")
        monkeypatch.setattr(threads, "OWN", tmp_path / "own")
        free = SimpleNamespace(available=FREE)
        monkeypatch.setattr(threads.psutil, "virtual_memory", lambda: free)

    return write


def group(name, most, taken, kept=0):
    """Return a group's files."""
    names = "memory.max", "memory.current", "memory.stat"
    texts = most, taken, f"anon 5\ninactive_file {kept}\nactive_file 7"
    return {f"{name}{file}": text for file, text in zip(names, texts)}


@pytest.mark.parametrize(
    "own, files, want",
    [
        ("0::/", {}, FREE),
        ("4:memory:/\n1:cpu:/", group("", 100, 80), FREE),
        ("0::/", group("", 500 * MB, 450 * MB, 400 * MB), 450 * MB),
        ("0::/a/b", group("a/b/", "max", 90) | group("a/", 100, 30) | group("", 300, 250), 50),
        ("4:memory:/x\n0::/not/mounted/here", group("", 100, 40), 60),
    ],
)
def test_memory_that_is_left(groups, own, files, want):
    groups(own, files)
    assert threads.free_memory() == want


@pytest.mark.parametrize("quota, want", [("max 100000", 8), ("150000 100000", 2)])
def test_threads_are_cut_to_the_cores_that_are_left(groups, monkeypatch, quota, want):
    groups("0::/", {"cpu.max": quota})
    monkeypatch.setattr(threads, "cores_of_system", lambda: 8)
    assert threads.count_cores() == threads.useful_threads(200) == want
    assert threads.useful_threads(1) == 1
