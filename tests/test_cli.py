"""The command line: what it prints, its exit codes, and bad input of every kind."""

import json
import os
import re
import zipfile
from pathlib import Path

import click
import numpy as np
import pytest
import trimesh
from conftest import ball, trilinear

import super_sdf
from super_sdf import reconstruct, write_mesh
from super_sdf.cli import main as cli
from super_sdf.cli.upsample import upsample_command
from super_sdf.files.formats import GRID_SUFFIXES
from super_sdf.files.meshes import MESH_SUFFIXES
from super_sdf.network.network import shipped_models
from super_sdf.options import GRID, MESH_FORMATS, OPTIONS, UPSAMPLE, Values, parse_size


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder of its own with a good grid in it."""
    monkeypatch.chdir(tmp_path)
    np.save("in.npy", ball().values)
    return tmp_path


def test_the_main_job(here, command):
    code, out, err = command("upsample", "in.npy", "out.ply")
    assert (code, out) == (0, "")
    spacing, origin, done = err.splitlines()
    assert spacing.startswith("Note: spacing not given: taken as 1, the values show ")
    assert origin == "Note: origin not given: sample (0, 0, 0) is at 0, 0, 0"
    assert done.startswith("out.ply: ") and done.endswith(" s")
    box = r"from \(3\.6\d*, .*\) to \(15\.6\d*, .*\), \d+\.\d s"
    assert re.fullmatch(rf"out\.ply: [\d,]+ vertices, [\d,]+ triangles, closed, {box}", done)
    mesh = trimesh.load("out.ply")
    assert mesh.is_watertight and mesh.volume == pytest.approx(4 / 3 * np.pi * 216, rel=0.01)


def test_json_has_counts_times_and_findings(here, command):
    arguments = ("--spacing", "1", "--origin", "1,2,3", "--json", "--quiet")
    code, out, err = command("upsample", "in.npy", "out.stl", *arguments)
    report = json.loads(out)
    assert (code, err) == (0, "")
    assert report["origin"] == [1, 2, 3] and report["inferred"] == [] and report["warnings"] == []
    assert report["triangles"] > report["vertices"] > report["band_voxels"] > 0
    stages = ["load network", "read", "band", "network", "nodes", "isosurface", "write"]
    assert list(report["seconds"]) == stages


def test_options_reach_the_result(here, command):
    np.save("out-in.npy", -ball().values)
    assert command("upsample", "out-in.npy", "a.ply", "--inside", "positive", "--offset", 1)[0] == 0
    assert trimesh.load("a.ply").extents == pytest.approx([14] * 3, rel=0.01)
    code, _, err = command("upsample", "in.npy", "a.ply", "--force", "--threads", 1, "-v")
    assert code == 0 and "device: cpu" in err and "isosurface: " in err


def test_a_surface_that_leaves_the_grid_is_reported_and_capped(here, command):
    np.save("cut.npy", ball().values[:12])
    _, _, err = command("upsample", "cut.npy", "open.ply", "--open")
    want = "Warning: the surface runs out of the grid and is open there (close it with --cap)"
    assert want in err
    assert " triangles, open, from (" in err and not trimesh.load("open.ply").is_watertight
    want = (
        "Note: the solid runs out of the grid: its surface is closed along the border (leave it "
        "open with --open)"
    )
    for name, options in ("closed.ply", ()), ("capped.ply", ("--cap",)):
        _, _, err = command("upsample", "cut.npy", name, *options)
        assert "Warning" not in err and want in err
        assert trimesh.load(name).is_watertight
    assert Path("closed.ply").read_bytes() == Path("capped.ply").read_bytes()


def test_noise_is_told(here, command):
    values = ball().values + np.random.default_rng(0).uniform(-0.3, 0.3, (20, 20, 20))
    np.save("noisy.npy", values)
    code, out, err = command("upsample", "noisy.npy", "out.ply", "--spacing", "1", "--json")
    assert code == 0 and json.loads(out)["noisy_voxels"] > 0
    assert " % of the band the values differ by more than distances can: they are taken" in err


def test_fine_values_that_contradict_the_coarse_ones_are_warned_of(here, command, monkeypatch):
    from super_sdf.network.network import Network

    def all_inside(self, patches, table, voxels, offsets):
        return np.full((len(voxels), len(offsets)), -1, np.float32)

    monkeypatch.setattr(Network, "__call__", all_inside)
    code, _, err = command("upsample", "in.npy", "out.ply")
    assert code == 0 and "fine values contradict the coarse ones around them" in err
    assert trimesh.load("out.ply").is_watertight


def test_version_help_info_and_usage_errors(command):
    assert command("--version") == (0, f"super-sdf, version {super_sdf.__version__}\n", "")
    for flag in ("-h", "--help"):
        assert "Turn coarse signed distance grids into fine meshes" in command(flag)[1]
    code, out, _ = command("info")
    assert code == 0 and out.startswith(f"super-sdf {super_sdf.__version__}\n")
    assert "model base\n" in out and "devices: cpu" in out
    facts = json.loads(command("info", "--json")[1])
    assert facts["models"]["base"]["format_version"] == 1
    assert command("upsample")[0] == 2
    assert command("upsampel") == (
        2, "", "Error: there is no command 'upsampel': did you mean upsample?\n"
    )  # fmt: skip
    assert command("nonsense") == (
        2,
        "",
        "Error: there is no command 'nonsense': give one of upsample, batch, check, sample, view, "
        "info\n",
    )
    code, out, err = command()
    assert (code, err) == (0, "") and out == command("--help")[1]


def test_every_option_has_help_and_is_in_the_table_once():
    for name in cli.COMMANDS:
        options = cli.cli.get_command(None, name).params
        assert all(one.help for one in options if isinstance(one, click.Option)), name
    taken = {parameter.name: parameter for parameter in upsample_command.params}
    assert all(taken[name].default == OPTIONS[name].default for name in UPSAMPLE)
    assert set(Values.__annotations__) < set(GRID)
    assert tuple(f".{name}" for name in MESH_FORMATS) == MESH_SUFFIXES
    for text in (upsample_command.help, write_mesh.__doc__):
        assert all(f" {suffix}" in text for suffix in MESH_SUFFIXES)


def save_archive(name, **members):
    with zipfile.ZipFile(name, "w") as archive:
        for key, data in members.items():
            archive.writestr(f"{key}.npy", data)


def bad_files() -> None:
    """Write one file of each bad kind."""
    good = Path("in.npy").read_bytes()
    Path("short.npy").write_bytes(good[: len(good) // 2])
    Path("text.npy").write_text("hello")
    Path("empty.npy").write_bytes(b"")
    Path("text.npz").write_text("hello")
    np.save("objects.npy", np.array([{}], object), allow_pickle=True)
    np.savez("other.npz", field=np.zeros(3), more=np.zeros(3))
    save_archive("short.npz", values=good[: len(good) // 2])
    np.savez("spaced.npz", values=np.load("in.npy"), spacing=np.ones(7))
    np.savez("damaged.npz", values=np.load("in.npy"))
    damaged = bytearray(Path("damaged.npz").read_bytes())
    damaged[5000] ^= 0xFF
    Path("damaged.npz").write_bytes(damaged)
    huge = np.lib.format.header_data_from_array_1_0(np.zeros(1))
    with open("huge.npy", "wb") as file:
        np.lib.format.write_array_header_1_0(file, {**huge, "shape": (4000, 4000, 4000)})
        file.truncate(file.tell() + 8 * 4000**3)  # sparse: no bytes on disk
    np.save("constant.npy", np.ones((3, 3, 3)))


SHORT = "is truncated: its header promises 20 x 20 x 20 float32, 32,000 bytes, but 15,936 follow"
CASES = {
    "none.npy": "none.npy does not exist",
    "text.npy": "text.npy is not an .npy array: its header cannot be read",
    "empty.npy": "empty.npy is empty: give a file with something in it",
    "text.npz": "text.npz is not a readable .npz archive: File is not a zip file",
    "objects.npy": "objects.npy holds Python objects: save the numbers alone",
    "other.npz": "other.npz has no key 'values' (it holds field, more)",
    "spaced.npz": "spaced.npz[spacing] has shape (7,): give one number or three",
    "short.npy": f"short.npy {SHORT}",
    "short.npz": f"short.npz[values] {SHORT}",
    "damaged.npz": "damaged.npz[values] is damaged: its checksum is wrong",
    "constant.npy": "every value is 1: a constant field has no surface",
    "in.npy --model huge": "no model 'huge': give an ONNX file or one of: fast, base, best",
}
WRONG = {
    "in.raw": f"in.raw is not a grid file: give one of {', '.join(GRID_SUFFIXES)}",
    "in.npy --label 1.5": "--label is 1.5: give a whole number, -2^63 to 2^64 - 1",
    "in.npy --scale 0": "--scale is 0: give a number greater than 0",
    "in.npy --simplify -1": "--simplify is -1: give a number greater than 0",
    "in.npy --factor 18": "--factor is 18: give an even number from 2 to 16 (an odd one has no "
    "node on the samples)",
    "in.npy --factor four": "Invalid value for '--factor': 'four' is not a valid integer.",
    "in.npy --spacing 1,2": "Invalid value for '--spacing': '1,2': give one number, or three "
    "separated by commas",
    "in.npy --spacing 1,nan,1": "--spacing is nan: give a finite number",
    "in.npy --level 1.5 --label 2": "--label 2 and --level 1.5: give only one of them",
    "in.npy --direction 1,0,0": "Invalid value for '--direction': '1,0,0': give nine numbers "
    "separated by commas, row by row",
}


@pytest.mark.parametrize("words", [*CASES, *WRONG])
def test_bad_input_is_one_line_and_no_file(here, command, words):
    bad_files()
    before = sorted(os.listdir())
    source, *options = words.split()
    code, want = (1, CASES[words]) if words in CASES else (2, WRONG[words])
    assert command("upsample", source, "out.ply", *options) == (code, "", f"Error: {want}\n")
    assert sorted(os.listdir()) == before


def test_a_zip_bomb_is_refused_unread(here, command, monkeypatch):
    np.savez_compressed("bomb.npz", values=np.zeros((200, 200, 200), np.float32))
    packed = zipfile.ZipFile("bomb.npz").getinfo("values.npy").compress_size
    monkeypatch.setattr("super_sdf.machine.memory.free_memory", lambda: 10**7)
    monkeypatch.setattr("super_sdf.files.unpacking._scratch_file", None)
    want = (
        "bomb.npz[values], 200 x 200 x 200 float32, 32,000,000 bytes, is compressed to "
        f"{packed:,} bytes, like a zip bomb, and does not fit in memory; if it is a grid, save "
        "it as .npy"
    )
    assert command("upsample", "bomb.npz", "out.ply") == (1, "", f"Error: {want}\n")


def test_a_factor_beyond_memory_is_refused_before_the_work(here, command, monkeypatch):
    monkeypatch.setattr("super_sdf.machine.memory.free_memory", lambda: 10**7)
    monkeypatch.setattr("super_sdf.slabs.cutting.give_back", lambda: None)
    code, _, err = command("upsample", "in.npy", "out.ply", "--factor", 16)
    assert code == 1 and err.startswith("Error: factor 16 on ")
    assert re.search(r" [MG]B of memory even plane by plane, ", err)
    assert err.endswith("(--max-memory)\n")


QUICK = ("--factor", 2, "--quality", "fast")
OWN_INPUTS = {
    "upsample in.npy out.ply": ("in.npy", "out.ply"),
    "upsample in.npy new.ply --save-field out.npy": ("in.npy", "out.npy"),
    "upsample raw.mhd out.ply": ("raw.bin", "out.ply"),
    "check ball.ply in.npy --out out.ply": ("ball.ply", "out.ply"),
    "sample ball.ply out.npz -n 9": ("ball.ply", "out.npz"),
}


@pytest.mark.parametrize("words", OWN_INPUTS)
def test_no_command_writes_over_its_own_input(here, command, words):
    """Soft links: ``test_a_file_is_apart_from_another_only_if_it_is_another``."""
    values = np.load("in.npy").astype("<f4")
    values.tofile("raw.bin")
    size = " ".join(map(str, values.shape[::-1]))
    Path("raw.mhd").write_text(
        f"ObjectType = Image\nNDims = 3\nDimSize = {size}\nElementType = MET_FLOAT\n"
        "ElementDataFile = raw.bin\n"
    )
    write_mesh(reconstruct(ball(12, 3.0), trilinear, 2), "ball.ply")
    source, target = OWN_INPUTS[words]
    os.link(source, target)
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

    monkeypatch.setattr("super_sdf.pipeline.refine", exhaust)
    want = "Error: out of memory: use a smaller --factor or grid\n"
    assert command("upsample", "in.npy", "out.ply") == (1, "", want)
    monkeypatch.setattr("super_sdf.files.output.os.access", lambda path, mode: False)
    want = "Error: out.ply cannot be written: no permission in .\n"
    assert command("upsample", "in.npy", "out.ply") == (1, "", want)


@pytest.mark.parametrize(
    "step, options, written",
    [
        ("pipeline.refine", (), "nothing was written"),
        ("files.mesh_writers.write_split", (), "nothing was written"),
        (
            "cli.upsample.Upsampling.print_report",
            ("--save-field", "f.npz"),
            "out.ply and f.npz are written",
        ),
        ("certificate.check.check_files", ("--check",), "out.ply is written"),
    ],
)
def test_an_interrupt_says_what_is_written(here, command, monkeypatch, step, options, written):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"super_sdf.{step}", interrupt)
    code, out, err = command("upsample", "in.npy", "out.ply", "--quiet", *QUICK, *options)
    assert (code, out, err.strip()) == (130, "", f"Error: interrupted; {written}")
    if written == "nothing was written":
        assert os.listdir() == ["in.npy"]
    else:
        assert trimesh.load("out.ply").is_watertight


def test_less_memory_gives_the_same_file(here, command, bare_plan):
    row = np.concatenate([ball(14, 4.0).values] * 12)  # balls in a row: longer than a slab needs
    np.save("row.npy", row)
    found = []
    for memory in ("4G", "108M"):
        words = ("row.npy", f"{memory}.ply", "--spacing", 1, "--max-memory", memory, *QUICK)
        found.append(json.loads(command("upsample", *words, "--json")[1]))
    one, two = found
    assert one["slabs"] == 1 and two["slabs"] > 1 and two["planned_bytes"] <= 108e6
    assert one["triangles"] == two["triangles"]
    assert Path("4G.ply").read_bytes() == Path("108M.ply").read_bytes()


@pytest.mark.parametrize("size", ["much", "", "-4G", "1e999"])
def test_a_size_that_is_none_is_named(here, command, size):
    code, _, err = command("upsample", "in.npy", "out.ply", "--max-memory", size)
    assert code == 2 and f"{size!r}: give a number of bytes such as 1500M or 4G" in err
    sizes = {"1500M": 15 * 10**8, "4g": 4 * 10**9, "123": 123}
    assert {text: parse_size(text) for text in sizes} == sizes


def test_wrong_values_are_named_in_lists_by_their_names(here, command):
    Path("list.jsonl").write_text('{"in": "in.npy", "simplify": -1}')
    _, _, err = command("batch", "list.jsonl", "--out", "out", "--simplify", "0.5")
    assert "'simplify' is -1: give a number" in err and "--simplify" not in err


@pytest.mark.parametrize("quality", ["base", "best"])
@pytest.mark.parametrize("words", ["upsample in.npy out.ply", "batch in.npy --out meshes"])
def test_a_model_and_a_quality_are_not_given_at_once(here, command, quality, words):
    model = str(shipped_models()["fast"])
    message = f"Error: --model {model} replaces --quality {quality}: give only one of them\n"
    refused = command(*words.split(), "--model", model, "--quality", quality)
    assert refused == (2, "", message) and os.listdir() == ["in.npy"]
    assert command(*words.split(), "--model", model, "--factor", 2)[0] == 0
