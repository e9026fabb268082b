"""Grids of every format come out at the right place, side and size; damage is said in a line."""

from __future__ import annotations

import os
import re
from pathlib import Path

import h5py
import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
import tifffile
import trimesh
from conftest import ball, refusal
from placed import (
    CUBES,
    OBLIQUE,
    PLACED,
    SIZES,
    STEPS,
    TURNS,
    affine_of,
    check,
    sampled,
    save,
    text_sdf,
)

from super_sdf import read_grid
from super_sdf.errors import FileError, GridError, SuperSdfError
from super_sdf.files import formats
from super_sdf.files.formats import find_format, is_grid

pytestmark = pytest.mark.usefixtures("folder")


@pytest.mark.parametrize("is_oblique", [False, True])
@pytest.mark.parametrize("turn", range(0, len(TURNS), 5))
@pytest.mark.parametrize("name", PLACED)
def test_axes_in_any_order_and_direction_with_any_spacing(name, turn, is_oblique):
    """The axes come in the order and sense in which they are nearest to the world's."""
    nearest = OBLIQUE if is_oblique else np.eye(3)
    save(name, affine_of(nearest @ TURNS[turn]))
    grid = read_grid(name)
    check(grid, STEPS[np.abs(TURNS[turn]).argmax(1)], 6e-4 if name == "series" else 2e-5)
    assert np.allclose(grid.direction, nearest, atol=1e-5)


def test_a_direction_is_given_where_the_file_has_none():
    affine = affine_of(OBLIQUE)
    place = {"spacing": STEPS, "origin": affine[:3, 3], "direction": OBLIQUE}
    np.save("c.npy", np.ascontiguousarray(sampled(affine)))
    np.save("zyx.npy", sampled(affine).T)
    np.savez("a.npz", values=sampled(affine), **place)
    save("a.tif", affine)
    with h5py.File("a.h5", "w") as file:
        for name, direction in (("field", np.eye(3)[::-1]), ("turned", OBLIQUE)):
            file[name] = sampled(affine).T
            file[name].attrs.update({**place, "direction": direction.ravel()})
    for name, options in (
        ("c.npy", place),
        ("zyx.npy", {**place, "axes": "zyx"}),
        ("a.tif", place),
        ("a.h5:/field", place),  # what is given replaces what is stated
        ("a.npz", {}),
        ("a.h5:/turned", {}),
    ):
        grid = read_grid(name, **options)
        check(grid)
        assert np.allclose(grid.direction, OBLIQUE)
    assert read_grid("a.npz", direction=np.eye(3)).is_straight


def test_three_dialects_of_sdf():
    values, low = sampled(CUBES), CUBES[:3, 3].astype("<f4")
    Path("text.sdf").write_text(text_sdf())
    tag = "#sdf 1\ndim {} {} {}\ndata\n".format(*SIZES).encode()
    Path("tagged.sdf").write_bytes(tag + values.tobytes())
    high = (low + np.array(SIZES) * 0.5).astype("<f4")
    head = np.array(SIZES, "<i4").tobytes() + low.tobytes() + high.tobytes()
    Path("boxed.sdf").write_bytes(head + values.tobytes())
    check(read_grid("text.sdf"), 0.5)
    check(read_grid("tagged.sdf", spacing=0.5, origin=low), 0.5)
    check(read_grid("boxed.sdf"), 0.5)


def test_a_given_spacing_and_origin_replace_those_of_the_file():
    """The origin is that of the file's sample (0, 0, 0), also if its axes run backwards."""
    affine = affine_of(np.diag([-1.0, 1.0, -1.0]))
    nibabel.save(nibabel.Nifti1Image(sampled(affine), np.diag([-3, 2, -1, 1])), "a.nii")
    check(read_grid("a.nii", spacing=STEPS, origin=affine[:3, 3]))


@pytest.mark.parametrize("dtype", [">f4", "<f8", "f2", ">i4", "i8", "i1"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_every_dtype_and_order_is_read(dtype, order):
    values = np.clip(ball().values * 8, -120, 120).astype(dtype)
    np.save("in.npy", np.asarray(values, order=order))
    np.testing.assert_array_equal(read_grid("in.npy", spacing=8).values, values)


def test_what_is_no_grid_is_refused_with_the_way_out(command):
    for name in ("a.nii", "a.zarr"):
        os.mkdir(name)
    first = "super-sdf sample part.stl part.npz -n 64"
    for name, said in {
        "part.stl": f"is a mesh, not a grid: sample it first, {first}",
        "part.step": f"is a CAD model, not a grid: sample it first, export part.stl, then {first}",
        "a.nii": "is a folder: give a file",
        "a.zarr": "cannot be read as Zarr: No group found in store",
        "no.zarr": "does not exist",
    }.items():
        code, _, err = command("upsample", name, "o.ply")
        assert code == (2 if "part" in name else 1) and err.count("\n") == 1
        assert err.startswith(f"Error: {name} {said}")


def test_components_and_missing_axes_are_refused():
    sitk.WriteImage(sitk.Image([4, 4, 4], sitk.sitkVectorFloat32, 3), "v.mha")
    tifffile.imwrite("rgb.tif", np.zeros((5, 6, 7, 3), np.uint8), photometric="rgb")
    nrrd.write("two.nrrd", np.zeros((4, 5)))
    for name in ("v.mha", "rgb.tif", "two.nrrd"):
        with pytest.raises(GridError, match=f"{name} has .*: give a (file|stack) of three axes"):
            read_grid(name)


def test_the_page_on_formats_lists_those_of_the_table():
    page = (Path(__file__).parent.parent / "docs" / "guides" / "formats.md").read_text()
    for format_ in (*formats.FORMATS, formats.DICOM):
        start = f"| {format_.name} | `{'`, `'.join(format_.suffixes)}` | "
        assert start + (f"`{format_.extra}`" if format_.extra else "none") in page


def test_another_package_brings_formats(monkeypatch, command):
    """The package is that of the page on formats."""
    page = (Path(__file__).parent.parent / "docs" / "guides" / "formats.md").read_text()
    table, code = (re.search(rf"```{kind}\n(.*?)```", page, re.S)[1] for kind in ("toml", "python"))
    table = re.sub(r'project\.entry-points\.|"', "", table)
    Path("my_formats.py").write_text(code)
    Path("my_formats-1.0.dist-info").mkdir()
    Path("my_formats-1.0.dist-info/entry_points.txt").write_text(table)
    monkeypatch.syspath_prepend(Path.cwd())
    (0.5 * ball(64, 20.0).values).astype("f4").tofile("in.raw64")
    grid = read_grid("in.raw64")
    assert grid.shape == (64, 64, 64) and grid.spacing == (0.5,) * 3 and is_grid("in.raw64")
    words = "--factor", 2, "--quality", "fast", "-q"
    assert command("batch", "in.raw64", "--out", ".", *words)[0] == 0
    assert command("upsample", "in.raw64", "out.pts", *words)[0] == 0
    vertices = np.loadtxt("out.pts")
    assert np.allclose(vertices, trimesh.load("in.ply", process=False).vertices, atol=1e-5)
    Path("bad.raw64").write_bytes(b"1234")
    said = "bad.raw64 cannot be read as .raw64: cannot reshape array"
    assert refusal(FileError, read_grid, "bad.raw64").startswith(said)


SUFFIXES = [
    *("a.nii", "a.nii.gz", "a.nrrd", "a.mha", "a.vti", "a.tif", "a.h5", "a.vdb", "a.sdf"),
    *("a.mgz", "a.vtkhdf", "a.mrc", "a.map.gz", "a.vtk", "a.nc", "a.mat"),
]


@pytest.mark.parametrize("damage", ["truncated", "another kind"])
@pytest.mark.parametrize("name", [*SUFFIXES, "a.hdr", "itk.h5", "text.vtk", "v3.nc", "v73.mat"])
def test_a_damaged_file_is_refused_in_one_line(name, damage, capfd):
    save(name)
    assert read_grid(name, field="mask").low < 0
    data = Path("a.img" if name == "a.hdr" else name)
    if damage == "truncated":
        data.write_bytes(data.read_bytes()[: int(0.9 * data.stat().st_size)])
    else:
        Path(name).write_bytes(b"hello, this is no grid at all\n" * 20)
    capfd.readouterr()
    said = refusal(SuperSdfError, read_grid, name)
    assert said.startswith(name) and len(said) < 400
    assert capfd.readouterr() == ("", "")


def test_a_missing_library_is_named_with_the_command_that_installs_it(monkeypatch):
    names = [*(name for name in SUFFIXES if find_format(name).extra), "series"]
    for name in names:
        save(name)
    monkeypatch.setattr("super_sdf.errors.find_spec", lambda module: None)
    for name in names:
        format_, said = find_format(name), refusal(SuperSdfError, read_grid, name)
        wanted = f"pip install -e '.[{format_.extra}]' in a clone of super-sdf"
        assert said.startswith(f"{format_.name} (") and said.endswith(wanted)
