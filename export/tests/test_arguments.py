"""The scripts refuse what they cannot work with at once, in a line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from export import dataset, train
from export.dataset import find_meshes, mesh_order, read_shard
from super_sdf.errors import FileError


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder of its own: one without meshes, one with a pipe, stores of up to two shards."""
    monkeypatch.chdir(tmp_path)
    for name in ("empty", "pipes", "two", "damaged"):
        Path(name).mkdir()
    os.mkfifo("pipes/a.ply")
    for number in range(2):
        Path(f"two/shard-0-{number:04d}.npz").write_text("never read")
    for number in range(3):
        Path(f"damaged/shard-0-{number:04d}.npz").write_text("no archive")
    return tmp_path


FEW = "of at least 3 shards, since the first 2 are held out: make more with export.dataset"
DATASET = [
    ("--meshes none", 1, "--meshes none is not a folder: give one with closed .ply meshes"),
    ("--meshes empty", 1, "--meshes empty has no .ply file: other formats are not read here"),
    ("--meshes pipes", 1, "pipes/a.ply is a named pipe: give a file"),
    ("--count 0", 2, "argument --count: 0: give at least 1"),
    ("--thin nan", 2, "argument --thin: nan: give a number from 0 to 1"),
    ("--procedural 3", 2, "argument --procedural: 3: give a number from 0 to 1"),
    ("--seed -1", 2, "argument --seed: -1: give at least 0"),
]
TRAIN = [
    ("--store none", 1, "--store none is not a folder: fill one with export.dataset"),
    ("--store empty", 1, f"--store empty has 0 {FEW}"),
    ("--store two", 1, f"--store two has 2 {FEW}"),
    ("--store damaged", 1, "damaged/shard-0-0000.npz is not a shard: "),
    ("--store two --minutes nan", 2, "argument --minutes: nan: give a number greater than 0"),
    ("--store two --rate 0", 2, "argument --rate: 0: give a number greater than 0"),
    ("--store two --noisy -1", 2, "argument --noisy: -1: give a number from 0 to 1"),
    ("--store damaged --start none.onnx", 1, "none.onnx does not exist"),
]


@pytest.mark.parametrize(
    ("script", "words", "code", "message"),
    [
        *((dataset, f"--out out {words}", *rest) for words, *rest in DATASET),
        *((train, f"--run out {words}", *rest) for words, *rest in TRAIN),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_cannot_be_worked_with_is_refused(
    here, capsys, monkeypatch, script, words, code, message
):
    monkeypatch.setattr(sys, "argv", ["script", *words.split()])
    with pytest.raises(SystemExit) as ended:
        script.main()
    out, err = capsys.readouterr()
    assert (ended.value.code, out) == (code, "")
    assert len(err.splitlines()) == 1 and err.startswith(f"Error: {message}"), err
    assert not list(here.glob("out/*"))


def test_a_truncated_shard_is_named_and_small_meshes_alone_are_all_taken(here):
    np.savez("whole.npz", windows=np.zeros(1000))
    path = Path("shard-0-0000.npz")
    path.write_bytes(Path("whole.npz").read_bytes()[:500])
    with pytest.raises(FileError, match=r"shard-0-0000\.npz is not a shard: "):
        next(read_shard(path))
    for name in "abc":
        Path(f"{name}.ply").write_text("small")
    prisms, others = find_meshes(Path())
    assert (len(prisms), others) == (3, [])
    assert set(mesh_order(0, prisms, others, 6)) == set(prisms)


def test_the_scripts_end_without_a_traceback(here):
    root = Path(dataset.__file__).parent.parent
    words = [sys.executable, "-m", "export.dataset", "--meshes", "empty", "--out", "out"]
    found = os.pathsep.join([str(root), str(root / "src")])
    environment = {**os.environ, "PYTHONPATH": found}
    done = subprocess.run(words, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout) == (1, "") and done.stderr.count("\n") == 1
