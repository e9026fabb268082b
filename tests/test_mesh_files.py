"""Meshes to files: every format, nothing half-written."""

import os
import tracemalloc
from pathlib import Path
from unittest.mock import Mock
from zipfile import ZipFile

import numpy as np
import pytest
import trimesh
from conftest import ball, refusal, trilinear

from super_sdf import Mesh, reconstruct, write_mesh
from super_sdf.convert import ConvertOptions, convert
from super_sdf.errors import FileError, GridError, OptionError
from super_sdf.files import mesh_writers, output
from super_sdf.files.meshes import MESH_SUFFIXES, write_pieces

OPTIONS = ConvertOptions(4, inside="negative")


@pytest.fixture
def mesh():
    return reconstruct(ball(14, 4.0), trilinear, 2)


def test_a_failed_write_leaves_what_was_there(folder, mesh, monkeypatch):
    Path("out.ply").write_text("before")

    def pieces():
        yield mesh
        raise GridError("no surface")

    with pytest.raises(GridError):
        write_pieces(pieces(), "out.ply", force=True)
    full = OSError(28, "No space left on device")
    monkeypatch.setattr(mesh_writers, "write_split", Mock(side_effect=full))
    said = refusal(FileError, write_mesh, mesh, "out.ply", force=True)
    assert said == "out.ply cannot be written: No space left on device"
    said = refusal(FileError, write_mesh, mesh, "out.ply")
    assert said == "out.ply exists: remove it or use --force"
    said = refusal(OptionError, write_mesh, mesh, "out.xyz")
    assert f"give one of {', '.join(MESH_SUFFIXES)}" in said
    assert Path("out.ply").read_text() == "before" and os.listdir() == ["out.ply"]


def in_pieces(mesh):
    """Cut a mesh as slabs do: triangles come later than their vertices, never before."""
    half, some = len(mesh.vertices) // 2, len(mesh.faces) // 3
    yield Mesh(mesh.vertices[:half], mesh.faces[:0])
    yield Mesh(mesh.vertices[half:], mesh.faces[:some])
    yield Mesh(mesh.vertices[:0], mesh.faces[some:])


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
def test_a_mesh_in_pieces_makes_the_same_file(mesh, tmp_path, monkeypatch, suffix):
    one, other = tmp_path / f"one{suffix}", tmp_path / f"other{suffix}"
    write_mesh(mesh, one)
    monkeypatch.setattr(output, "SPOOL_BYTES", 1000)  # triangles go to a file beside
    monkeypatch.setattr(mesh_writers, "STL_CHUNK", 100)
    write_pieces(in_pieces(mesh), other)
    assert one.read_bytes() == other.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == [one.name, other.name]


def grown(mesh, times):
    """Yield a mesh many times, each a piece of one."""
    for turn in range(times):
        shift = np.float32(20 * turn)
        yield Mesh(mesh.vertices + shift, mesh.faces + np.int32(turn * len(mesh.vertices)))


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
def test_memory_does_not_grow_with_the_mesh(mesh, tmp_path, monkeypatch, suffix):
    monkeypatch.setattr(output, "SPOOL_BYTES", 1000)
    peaks = []
    for times in (1, 8, 24):
        tracemalloc.start()
        write_pieces(grown(mesh, times), tmp_path / f"{times}{suffix}")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] < 1.02 * peaks[1] + 10_000  # the first loads and caches what is needed


def read(path):
    """Read a mesh; corners at one very point are one vertex."""
    back = trimesh.load(path, force="mesh", process=False)
    points, rows = np.unique(back.vertices, axis=0, return_inverse=True)
    return Mesh(points, rows.ravel()[back.faces].astype(np.int32))


def place(spacing, origin):
    """Write a ball with vertices next to nodes: three samples are all but 0."""
    values = ball(12, 3.0).values.astype(np.float64)
    values[np.abs(values) < 0.1] *= 1e-6
    np.savez("in.npz", values=values * spacing, spacing=spacing, origin=origin)


PLACES = {
    "near": (1.0, 0.0),
    "parcel": (0.1, 5.4e6),
    "machine": (0.01, 1e3),
    "microns": (5e-6, 0.0),
    "nanometres": (1e-9, 1.0),
    "beyond single": (1e39, 0.0),
    "below single": (1e-44, 0.0),
    "below single, far": (1e-47, 0.0),
}
BEYOND = {"beyond single", "below single", "below single, far"}
REFUSED = {".stl": set(PLACES) - {"near", "microns"}, ".glb": BEYOND}


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".glb", ".3mf"])
@pytest.mark.parametrize("name", PLACES)
def test_a_format_holds_the_mesh_or_refuses_it(folder, name, suffix):
    place(*PLACES[name])
    run, target = ("in.npz", f"out{suffix}", trilinear, OPTIONS), Path(f"out{suffix}")
    if name in REFUSED.get(suffix, ()):
        said = refusal(FileError, convert, *run)
        assert said.startswith(f"{target} cannot hold the mesh: {suffix} has single precision")
        assert os.listdir() == ["in.npz"]
    else:
        done, back = convert(*run), read(target)
        assert np.isfinite(back.vertices).all() and back.is_closed() and back.volume() > 0
        assert len(back.vertices) == done.counts["vertices"]
        assert len(back.faces) == done.counts["triangles"]


def test_what_cannot_be_held_is_named_with_the_figures(folder):
    place(0.1, 5.4e6)
    assert refusal(FileError, convert, "in.npz", "out.stl", trilinear, OPTIONS) == (
        "out.stl cannot hold the mesh: .stl has single precision, in steps of 0.5 at 5.4e+06, and "
        "vertices are down to 2.5e-05 apart; write .ply or .obj"
    )
    place(1e39, 0.0)
    said = refusal(FileError, convert, "in.npz", "out.glb", trilinear, OPTIONS)
    assert "numbers up to 3.4e+38, the mesh reaches 6e+39, and" in said
    place(1.0, 1e17)
    want = (
        "the grid reaches to 1e+17, too far from the origin for its spacing, 1: vertices could not "
        "be told apart; give a nearer origin"
    )
    for suffix in MESH_SUFFIXES:
        assert refusal(GridError, convert, "in.npz", f"out{suffix}", trilinear, OPTIONS) == want
    assert os.listdir() == ["in.npz"]


def test_glb_says_from_where_it_counts(folder):
    place(0.1, 5.4e6)
    done = convert("in.npz", "out.glb", trilinear, OPTIONS)
    assert done.notes[-1] == (
        "out.glb has single precision: its vertices are relative to 5400000.55, 5400000.55, "
        "5400000.55, the translation of its node"
    )
    convert("in.npz", "out.ply", trilinear, OPTIONS)
    np.testing.assert_allclose(read("out.glb").volume(), read("out.ply").volume(), rtol=1e-5)
    np.testing.assert_allclose(
        *[trimesh.load(f"out{s}").bounds for s in (".glb", ".ply")], rtol=1e-12
    )


def test_a_mesh_that_its_format_would_flatten_is_refused(folder, mesh):
    far = Mesh(mesh.vertices.astype(np.float64) * 1e-3 + 1e5, mesh.faces)
    assert refusal(FileError, write_mesh, far, "out.stl") == (
        "out.stl cannot be written: .stl has single precision, in which vertices of this mesh "
        "coincide; write .ply or .obj"
    )
    write_mesh(far, "out.glb")
    assert len(read("out.glb").vertices) == len(mesh.vertices)
    bad = Mesh(np.where(mesh.vertices > 5, np.nan, mesh.vertices), mesh.faces)
    for suffix in MESH_SUFFIXES:
        said = refusal(FileError, write_mesh, bad, f"bad{suffix}")
        assert said.endswith("a vertex of the mesh is not finite")
    assert os.listdir() == ["out.glb"]


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".3mf"])
def test_files_hold_the_very_numbers(tmp_path, monkeypatch, suffix):
    monkeypatch.setattr(mesh_writers, "CHUNK", 100)
    monkeypatch.setattr(mesh_writers, "TEXT_CHUNK", 100)
    numbers = np.random.default_rng(0).standard_normal((999, 3)) ** 9 * 1e-3
    faces = np.arange(999, dtype=np.int32).reshape(-1, 3)
    for dtype in (np.float32, np.float64):
        write_mesh(Mesh(numbers.astype(dtype), faces), tmp_path / f"out{suffix}", force=True)
        back = trimesh.load(tmp_path / f"out{suffix}", force="mesh", process=False)
        corners = back.vertices[back.faces].astype(dtype)  # readers may order vertices anew
        np.testing.assert_array_equal(corners, numbers.astype(dtype)[faces])


def test_normals_of_stl_look_out_at_every_scale(tmp_path, mesh):
    for scale in (1e-30, 1.0, 1e30):
        write_mesh(
            Mesh(mesh.vertices * np.float32(scale), mesh.faces), tmp_path / "out.stl", force=True
        )
        rows = np.fromfile(tmp_path / "out.stl", mesh_writers.STL_ROW, offset=84)
        a, b, c = (rows["corners"] / np.float32(scale)).astype(np.float64).transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        np.testing.assert_allclose(rows["normal"], normal, atol=2e-3)


def test_a_unit_is_stated_and_glb_is_in_metres(folder, mesh):
    for name, unit, metres in (("millimeter", "mm", 1e-3), ("inch", "in", 0.0254)):
        write_mesh(mesh, "out.3mf", force=True, unit=unit)
        with ZipFile("out.3mf") as archive:
            assert f'<model unit="{name}" ' in archive.read("3D/3dmodel.model").decode()
        assert read("out.3mf").volume() == pytest.approx(mesh.volume(), rel=1e-5)
        for shift in (0.0, 1e6):
            far = Mesh(mesh.vertices.astype(np.float64) + shift, mesh.faces)
            write_mesh(far, "out.glb", force=True, unit=unit)
            bounds = trimesh.load("out.glb").bounds
            want = [far.vertices.min(0), far.vertices.max(0)]
            np.testing.assert_allclose(bounds, metres * np.array(want), rtol=1e-6)


def test_the_unit_of_a_conversion(folder, command):
    place(0.5, 3.0)
    plain = "upsample in.npz plain.glb", "upsample in.npz out.glb --unit mm"
    assert [command(*words.split(), "-q")[0] for words in plain] == [0, 0]
    small, large = (trimesh.load(f"{name}.glb").bounds for name in ("out", "plain"))
    np.testing.assert_allclose(1000 * small, large, rtol=1e-7)
    code, out, err = command("check", "out.glb", "in.npz", "--unit", "mm", "--no-faults")
    assert (code, err) == (0, "") and "faults: none" in out
    code, _, err = command("upsample", "in.npz", "out.ply", "--unit", "mm")
    assert (code, err) == (
        2,
        "Error: --unit is mm: out.ply can state none, give .glb or .3mf, or no unit\n",
    )
    code, _, err = command("batch", "in.npz", "--out", "meshes", "--unit", "mm")
    assert (code, err) == (
        2,
        "Error: --unit is mm: *.ply can state none, give .glb or .3mf, or no unit\n",
    )
    assert not Path("meshes").exists()
    assert command("batch", "in.npz", "--out", "meshes", "--unit", "mm", "--format", "3mf")[0] == 0
