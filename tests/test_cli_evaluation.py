"""The commands sample and render, and lists of values on the command line."""

import os
import re
from pathlib import Path

import click
import numpy as np
import pytest
import trimesh
from click.testing import CliRunner
from conftest import ball
from solids import cube, inverted, joined, saved, torus

from super_sdf import Mesh, read_grid
from super_sdf.cli.evaluate import ListCommand
from super_sdf.machine import extras


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder of its own with a box of 3 x 1 x 1 in it."""
    monkeypatch.chdir(tmp_path)
    saved(Mesh(cube().vertices * [3, 1, 1], cube().faces), tmp_path / "box.ply")
    return tmp_path


def test_a_mesh_becomes_a_grid_and_a_mesh_again(here, command):
    code, out, err = command("sample", "box.ply", "box.npz", "-n", 40)
    assert (code, out) == (0, "")
    assert err.startswith("box.npz: 40 x 17 x 17 samples, spacing 0.0857143, ")
    grid = read_grid("box.npz")
    beyond = np.array(grid.origin) + np.array([1.5, 0.5, 0.5])
    assert grid.values[0, 0, 0] == pytest.approx(np.linalg.norm(beyond), rel=1e-6)
    assert grid.values[20, 8, 8] < 0
    assert command("upsample", "box.npz", "again.ply")[0] == 0
    again = trimesh.load("again.ply")
    np.testing.assert_allclose(again.extents, [3, 1, 1], atol=0.02)
    assert again.is_watertight


def test_spacing_padding_and_frame(here, command):
    assert command("sample", "box.ply", "a.npz", "--spacing", 0.25, "--padding", 3)[0] == 0
    grid = read_grid("a.npz")
    assert grid.shape == (19, 11, 11) and grid.spacing == (0.25,) * 3
    assert command("sample", "box.ply", "b.npz", "-n", 16, "--frame", "unit")[0] == 0
    unit = read_grid("b.npz")
    assert unit.shape == (16, 16, 16)
    assert unit.origin == pytest.approx((0.5 / 16 - 0.5,) * 3)
    assert command("sample", "box.ply", "c.npz", "-n", 30, "--band", 2)[0] == 0
    cut = read_grid("c.npz")
    assert cut.values.max() == pytest.approx(2 * cut.voxel_size)


def test_what_is_wrong_with_a_mesh_is_said(here, command):
    saved(inverted(cube()), here / "in.ply")
    code, _, err = command("sample", "in.ply", "in.npz", "-n", 12)
    assert code == 0
    assert err.splitlines()[0] == "Note: inverted: its faces point inward; they were reversed"
    twice = joined(cube(), Mesh(cube().vertices + np.array([0.4, 0, 0]), cube().faces))
    saved(twice, here / "two.ply")
    code, _, err = command("sample", "two.ply", "two.npz", "-n", 12)
    assert code == 0 and err.startswith("Note: pieces overlap, fold over or are inverted at ")
    saved(Mesh(cube().vertices, cube().faces[2:]), here / "open.ply")
    assert command("sample", "open.ply", "open.npz", "-n", 12, "--allow-open")[0] == 0


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ("box.ply box.npz", 2, "give either -n (samples along the longest axis) or --spacing"),
        ("box.ply box.npz -n 9 --spacing 1", 2, "give either -n"),
        ("box.ply box.npz -n 4", 2, "4 samples leave no room within a padding of 2 voxels"),
        ("box.ply box.npz --spacing 1 --frame unit", 2, "--frame unit has a side of 1: give -n"),
        ("box.ply box.npy -n 9", 2, "box.npy is not a grid file with spacing and origin"),
        ("none.ply box.npz -n 9", 1, "none.ply does not exist"),
        ("box.ply none/box.npz -n 9", 1, "none is not a folder: make it first"),
        ("box.ply old.npz -n 9", 1, "old.npz exists: remove it or use --force"),
        ("lidless.ply box.npz -n 9", 1, "lidless.ply is open: 4 edges have no partner"),
        ("box.ply box.npz -n 9 --band 1", 2, "band is 1: give at least 1.5 voxels"),
        ("box.ply box.npz -n 90000", 1, "a grid of 90000 x 30004 x 30004 needs "),
        (
            "box.ply box.npz -n 99999999999999",
            2,
            "n is 99999999999999: give fewer than 1e+09",
        ),
        ("box.ply box.npz -n 0", 2, "n is 0: give at least 2 samples"),
        ("none.ply box.npz -n -5", 2, "n is -5: give at least 2 samples"),
        ("box.ply box.npz -n 1 --frame unit", 2, "n is 1: give at least 2 samples"),
        ("box.ply box.npz -n 9999999 --frame unit", 1, "a grid of 9999999 x 9999999 x 9999999"),
        ("box.ply box.npz -n 9 --frame unit --padding 3", 2, "--frame unit has a side of 1: it"),
        ("box.ply box.npz --spacing 1e-300", 2, "a spacing of 1e-300 and a padding of 2 voxels"),
        ("box.ply box.npz --spacing 1e-320", 2, "a spacing of 9.99989e-321 and a padding of"),
        ("box.ply box.npz --spacing 1e300", 1, "a spacing of 1e+300 and an extent of 5e+300 are"),
        ("box.ply box.npz --spacing nan", 2, "spacing is nan: it must be greater than 0"),
        ("box.ply box.npz --spacing inf", 2, "spacing is inf: it must be greater than 0"),
        ("box.ply box.npz --spacing .1 --padding 1e300", 2, "a spacing of 0.1 and a padding of"),
        ("box.ply box.npz -n 9 --padding -1e9", 2, "padding is -1e+09: give 0 voxels or more"),
        ("box.ply box.npz -n 9 --padding nan", 2, "padding is nan: give 0 voxels or more"),
        ("box.ply box.npz -n 9 --band nan", 2, "band is nan: give at least 1.5 voxels"),
        ("far.off box.npz -n 9", 1, "the grid reaches to 1e+14, where numbers are 0.016 apart"),
        ("pipe.ply box.npz -n 9", 1, "pipe.ply is a named pipe: give a file"),
    ],
)
def test_bad_samples_are_one_line(here, command, words, code, message):
    (here / "old.npz").touch()
    saved(Mesh(cube().vertices, cube().faces[2:]), here / "lidless.ply")
    far = trimesh.Trimesh(cube().vertices + 1e14, cube().faces, process=False)
    (here / "far.off").write_text(trimesh.exchange.off.export_off(far, digits=1))
    os.mkfifo(here / "pipe.ply")
    found, out, err = command("sample", *words.split())
    assert (found, out) == (code, "")
    assert len(err.splitlines()) == 1 and err.startswith(f"Error: {message}"), err
    assert not (here / "box.npz").exists() and not list(here.glob(".*"))


@pytest.mark.graphics
@pytest.mark.parametrize("colour", ["shaded", "normal", "error"])
def test_meshes_become_a_picture(here, command, colour):
    saved(torus(), here / "ring.ply")
    reference = ("--reference", "box.ply") if colour == "error" else ()
    words = ("box.ply", "ring.ply", "out.png", "--colour", colour, *reference, "--size", 200)
    assert command("render", *words) == (0, "", "")
    assert (here / "out.png").read_bytes()[:4] == b"\x89PNG"


def test_a_grid_becomes_a_section(here, command):
    np.savez("in.npz", values=ball().values, spacing=1.0)
    assert command("render", "in.npz", "out.png", "--axis", "x", "--at", 9.0)[0] == 0
    assert (here / "out.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ("box.ply out.jpg", 2, "out.jpg is not a picture file: give .png"),
        ("none.ply out.png", 1, "none.ply does not exist"),
        ("box.ply out.png --colour error", 2, "--colour error and --reference MESH go together"),
        ("box.ply out.png --reference box.ply", 2, "--colour error and --reference MESH go"),
        ("box.ply in.npy out.png", 2, "in.npy is a grid: give it alone, or meshes only"),
        ("in.npy out.png --at 900", 2, "at is 900"),
        ("in.npy out.png --at nan", 2, "at is nan"),
        ("in.npy out.png --factor 3", 2, "factor is 3"),
        ("in.npy out.png --size 100000", 2, "size is 100000: give 1 to 8000 pixels"),
        ("box.ply out.png --size 100000", 2, "size is 100000: give 1 to 8000 pixels"),
        ("none.ply out.png --zoom 0", 2, "zoom is 0: give a number greater than 0"),
        ("none.ply out.png --zoom nan", 2, "zoom is nan: give a number greater than 0"),
        ("none.ply out.png --zoom -1", 2, "zoom is -1: give a number greater than 0"),
        ("none.ply out.png --zoom 1e300", 2, "zoom is 1e+300: give a number from 0.01 to 1000"),
        ("none.ply out.png --colour error --top 0", 2, "top is 0: give a number greater than 0"),
        ("none.ply out.png --colour error --top 1e99", 2, "top is 1e+99: no colour bar can be"),
        ("box.ply out.png --top 1", 2, "--top is the end of the colour bar: give it with"),
        ("box.ply out.png --at 1", 2, "--at does not apply to meshes: leave it out"),
        ("in.npy out.png --colour normal", 2, "--colour does not apply to a grid: leave it out"),
        (" ".join(["box.ply"] * 40 + ["out.png --size 8000"]), 2, "a picture of 32,000 x 80,000"),
        ("pipe.ply out.png", 1, "pipe.ply is a named pipe: give a file"),
    ],
)
def test_bad_pictures_are_one_line(here, command, words, code, message):
    np.save("in.npy", ball().values)
    os.mkfifo("pipe.ply")
    found, out, err = command("render", *words.split())
    assert (found, out) == (code, "")
    assert len(err.splitlines()) == 1 and err.startswith(f"Error: {message}"), err
    assert not (here / "out.png").exists()


def list_command() -> click.Command:
    """A command that shows what it was given."""

    @click.command(cls=ListCommand)
    @click.argument("words", nargs=-1)
    @click.option("--sizes", multiple=True, type=int)
    @click.option("--names", multiple=True, type=click.Choice(["a", "b"]))
    @click.option("--out")
    def show(**given):
        click.echo(" ".join(f"{key}={given[key]}" for key in ("words", "sizes", "names", "out")))

    return show


@pytest.mark.parametrize(
    "line",
    [
        "m n --sizes 32 64 128 --names a b --out a",
        "--sizes 32 64 128 m n --out a --names a b",
        "m --names a --names b --out a --sizes 32 --sizes 64 128 n",
    ],
)
def test_an_option_takes_several_values(line):
    result = CliRunner().invoke(list_command(), line.split())
    assert result.output == "words=('m', 'n') sizes=(32, 64, 128) names=('a', 'b') out=a\n"


@pytest.mark.parametrize(
    ("gone", "words", "want"),
    [
        (["scipy"], "sample box.ply a.npz", "sample needs scipy: pip install -e '.[eval]'"),
        (["scipy"], "evaluate . --out a", "evaluate needs scipy: pip install -e '.[eval]'"),
        (
            ["igl", "scipy", "pyvista"],
            "render box.ply a.png",
            "render needs igl, scipy, pyvista: pip install -e '.[view]'",
        ),
        (["pyvista"], "render box.ply a.png", "render needs pyvista: pip install -e '.[view]'"),
        (
            ["igl", "pyvista"],
            "render in.npz a.png",
            "render needs igl: pip install -e '.[view]'",
        ),
        (
            ["gpytoolbox"],
            "evaluate . --out a --peers rfta",
            "--peers needs gpytoolbox: pip install -e '.[peers]'",
        ),
    ],
)
def test_what_is_missing_is_named_with_the_extra_that_brings_it_all(
    here, command, monkeypatch, gone, words, want
):
    real = extras.find_spec
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name in gone else real(name))
    assert command(*words.split()) == (1, "", f"Error: {want} in a clone of super-sdf\n")


def test_nobody_is_told_to_install_from_an_index_that_has_no_such_package():
    root = Path(__file__).parent.parent
    folders = ("docs", "examples", "export", "models", "src")
    inside = [path for folder in folders for path in (root / folder).rglob("*")]
    sources = [path for path in [*root.glob("*.md"), *inside] if path.suffix in (".md", ".py")]
    assert len(sources) > 50
    assert not [path for path in sources if re.search(r"install '?super-sdf", path.read_text())]
