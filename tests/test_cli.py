"""The command line: what it prints, its exit codes, and bad input of every kind."""

import json
import os
import re
import sys
import zipfile
from io import BytesIO, TextIOWrapper
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import ball

import super_sdf
from super_sdf.files.formats import GRID_SUFFIXES
from super_sdf.files.meshes import MESH_SUFFIXES
from super_sdf.options import Options


@pytest.fixture
def here(folder):
    """A folder of its own with a good grid in it."""
    np.save("in.npy", ball().values)


def test_the_main_job(here, command):
    code, out, err = command("upsample", "in.npy", "out.ply")
    assert (code, out) == (0, "")
    *_, origin, done = err.splitlines()
    assert origin == "Note: origin not given: sample (0, 0, 0) is at 0, 0, 0"
    box = r"from \(3\.6\d*, .*\) to \(15\.6\d*, .*\), \d+\.\d s"
    assert re.fullmatch(rf"out\.ply: [\d,]+ vertices, [\d,]+ triangles, closed, {box}", done)
    mesh = trimesh.load("out.ply")
    assert mesh.is_watertight and mesh.volume == pytest.approx(4 / 3 * np.pi * 216, rel=0.01)


def test_json_has_options_counts_times_and_findings(here, command):
    arguments = ("--spacing", "1", "--origin", "1,2,3", "--json", "--quiet")
    code, out, err = command("upsample", "in.npy", "out.stl", *arguments)
    report = json.loads(out)
    assert (code, err) == (0, "")
    assert report["origin"] == [1, 2, 3] and report["inferred"] == [] and report["warnings"] == []
    assert report["triangles"] > report["vertices"] > report["band_voxels"] > 0
    assert report["asked"] == json.loads(json.dumps(Options(spacing=1, origin=(1, 2, 3)).digest()))
    assert {"load network", "read", "network", "isosurface", "write"} <= set(report["seconds"])


def test_a_hyphen_is_standard_input_or_output(here, command, monkeypatch):
    assert command("upsample", "in.npy", "out.obj", "-q") == (0, "", "")
    for source in ("-", "in.npy"):
        monkeypatch.setattr("sys.stdin", TextIOWrapper(BytesIO(Path("in.npy").read_bytes())))
        code, out, err = command("upsample", source, "-", "--format", "obj")
        assert (code, out) == (0, Path("out.obj").read_text()) and "\n-: " in err
    monkeypatch.setattr("sys.stdin", TextIOWrapper(BytesIO()))
    said = "stdin.npy is empty: give a file with something in it"
    assert command("upsample", "-", "a.ply") == (1, "", f"Error: {said}\n")
    monkeypatch.setattr("sys.stdin", None)
    said = "- is a standard stream, which is closed: give a file"
    assert command("upsample", "-", "a.ply") == (2, "", f"Error: {said}\n")


@pytest.mark.parametrize(
    ("target", "words", "said"),
    [
        ("a.ply", "--format stl", "--format stl is for an OUT that is -: leave it out for a.ply"),
        ("-", "--labels all", "--labels makes a file for each label: give --format glb or 3mf"),
        ("-", "--json", "--json is for standard output, too: give a file for OUT"),
    ],
)
def test_what_does_not_go_with_a_hyphen(target, words, said, here, command):
    code, _, err = command("upsample", "in.npy", target, *words.split())
    assert (code, err) == (2, f"Error: {said}\n") and os.listdir() == ["in.npy"]


def test_options_reach_the_result(here, command):
    np.save("out-in.npy", -2 * ball().values)
    options = ("--inside", "positive", "--offset", 2, "--spacing", 2, "--origin", "1,2,3")
    code, out, _ = command("upsample", "out-in.npy", "a.ply", *options, "--json")
    report, mesh = json.loads(out), trimesh.load("a.ply")
    assert code == 0 and mesh.extents == pytest.approx([28] * 3, rel=0.01)
    assert mesh.bounds.mean(0) == pytest.approx(np.array([1, 2, 3]) + 2 * 9.63, abs=0.2)
    assert (report["vertices"], report["triangles"]) == (len(mesh.vertices), len(mesh.faces))
    np.testing.assert_allclose(report["bounds"], mesh.bounds)


def test_a_surface_that_leaves_the_grid_is_reported_and_capped(here, command):
    np.save("cut.npy", ball().values[:12])
    assert " triangles, open, from (" in command("upsample", "cut.npy", "open.ply", "--open")[2]
    _, _, err = command("upsample", "cut.npy", "closed.ply")
    note = "Note: the solid runs out of the grid: its surface is closed"
    assert "Warning" not in err and note in err
    assert trimesh.load("closed.ply").is_watertight


def test_version_help_and_usage_errors(command):
    assert command("--version") == (0, f"super-sdf, version {super_sdf.__version__}\n", "")
    assert "Turn coarse signed distance grids into fine meshes" in command("-h")[1]
    assert command() == (0, command("--help")[1], "")
    assert "an even number from 2 to 16" in command("upsample", "--help")[1]
    assert command("upsample")[0] == 2
    said = "Error: 'upsmple' is no command: give one of upsample, batch, check, sample, "
    assert command("upsmple") == (2, "", f"{said}view, info\n")
    for word, meant in {"labl": "label", "tol": "tolerance", "memry": "max-memory"}.items():
        end = f"Error: No such option '--{word}'. Did you mean '--{meant}'?\n"
        assert command("upsample", "in.npy", "out.ply", f"--{word}", 1) == (2, "", end)


CASES = {
    "none.npy": "none.npy does not exist",
    "empty.npy": "empty.npy is empty",
    "text.npz": "text.npz is not a readable .npz archive: write it by numpy.savez",
    "objects.npy": "objects.npy cannot be read as NumPy: ",
    "other.npz": "other.npz holds no array of three axes",
    "short.npy": "short.npy cannot be read as NumPy: it is cut off: it has only 16,000 bytes",
    "short.npz": "short.npz cannot be read as NumPy",
    "in.npy --model huge": "no model 'huge': give an ONNX file or one of: fast, base, best",
}
FACTOR = "give an even number from 2 to 16 (an odd one has no node on the samples)"
WRONG = {
    "in.raw": f"in.raw is not a grid file: give one of {', '.join(GRID_SUFFIXES)}",
    "in.npy --label 1.5": "--label is '1.5': give a whole number, -2^63 to 2^64 - 1",
    "in.npy --label 1 --field noisy": "--label 1 and --field noisy: the samples of a label are a",
    "in.npy --scale 0": "--scale is '0': give a number greater than 0",
    "in.npy --mesher dual": "--mesher is 'dual': give one of auto, marching, sharp",
    "in.npy --factor 18": f"--factor is '18': {FACTOR}",
    "in.npy --spacing 1,2": "--spacing is '1,2': give one number, or three",
    "in.npy --spacing 1,nan,1": "--spacing is '1,nan,1': give one number, or three",
    "in.npy --level 1.5 --label 2": "--label 2 and --level 1.5: give only one of them",
    "in.npy --max-memory much": "--max-memory is 'much': give a number of bytes",
    "in.npy --direction 1,0,0": "--direction is '1,0,0': give nine numbers, row by row",
}


@pytest.mark.parametrize("words", [*CASES, *WRONG])
def test_bad_input_is_one_line_and_no_file(here, command, words):
    half = Path("in.npy").read_bytes()[:16000]
    Path("short.npy").write_bytes(half)
    Path("text.npz").write_text("hello")
    Path("empty.npy").write_bytes(b"")
    np.save("objects.npy", np.array([[[{}]]], object), allow_pickle=True)
    np.savez("other.npz", field=np.zeros(3), more=np.zeros(3))
    with zipfile.ZipFile("short.npz", "w") as archive:
        archive.writestr("values.npy", half)
    before = sorted(os.listdir())
    source, *options = words.split()
    code, out, err = command("upsample", source, "out.ply", *options)
    want = CASES.get(words) or WRONG[words]
    assert (code, out) == (1 if words in CASES else 2, "")
    assert err.startswith(f"Error: {want}") and err.count("\n") == 1
    assert sorted(os.listdir()) == before


OWN_INPUTS = {
    "upsample in.npy out.ply": ("in.npy", "out.ply"),
    "upsample in.npy new.ply --save-field out.npy": ("in.npy", "out.npy"),
    "sample ball.ply out.npz -n 9": ("ball.ply", "out.npz"),
}


@pytest.mark.parametrize("words", OWN_INPUTS)
def test_no_command_writes_over_its_own_input(here, command, words):
    trimesh.creation.icosphere(2, 3).export("ball.ply")
    source, target = OWN_INPUTS[words]
    (os.symlink if source == "ball.ply" else os.link)(source, target)
    before, names = Path(source).read_bytes(), sorted(os.listdir())
    want = f"Error: {target} is the same file as {source}: give another file\n"
    assert command(*words.split(), "--force") == (1, "", want)
    assert Path(source).read_bytes() == before and sorted(os.listdir()) == names


TARGETS = {
    "out.xyz": (2, f"out.xyz is not a mesh file: give one of {', '.join(MESH_SUFFIXES)}"),
    "there.ply": (1, "there.ply exists: remove it or use --force"),
    "no/out.ply": (1, "no is not a folder: make it first"),
    "dir.ply": (1, "dir.ply is a folder: give a file"),
}


@pytest.mark.parametrize("target", TARGETS)
def test_targets_are_checked_before_the_work(here, command, target):
    Path("there.ply").write_text("mine")
    Path("dir.ply").mkdir()
    code, want = TARGETS[target]
    assert command("upsample", "none.npy", target) == (code, "", f"Error: {want}\n")
    assert Path("there.ply").read_text() == "mine"


def test_no_permission_and_no_memory_are_one_line_each(here, command, monkeypatch):
    def exhaust(*_, **__):
        raise MemoryError

    monkeypatch.setattr("super_sdf.convert.mesh_grid", exhaust)
    want = "Error: out of memory: use a smaller --factor or grid\n"
    assert command("upsample", "in.npy", "out.ply")[::2] == (1, want)
    monkeypatch.setattr("super_sdf.files.output.os.access", lambda path, mode: False)
    want = "Error: out.ply cannot be written: no permission in .\n"
    assert command("upsample", "in.npy", "out.ply") == (1, "", want)


def test_the_progress_bar_runs_to_100_percent(here, command, monkeypatch):
    monkeypatch.setattr(type(sys.stderr), "isatty", lambda self: True, raising=False)
    code, _, err = command("upsample", "in.npy", "out.ply", "--spacing", "1")
    assert code == 0 and err.index("reading") < err.index("upsampling") < err.index("100%")
