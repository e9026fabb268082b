"""Meshes to files: every format, nothing half-written."""

import os
from pathlib import Path
from unittest.mock import Mock
from zipfile import ZipFile

import numpy as np
import pytest
import trimesh
from conftest import ball, refusal, trilinear

from super_sdf import Mesh, reconstruct, write_mesh
from super_sdf.convert import convert
from super_sdf.errors import FileError, GridError, MeshError, OptionError
from super_sdf.files import meshes
from super_sdf.files.meshes import MESH_SUFFIXES, World, write_meshes
from super_sdf.options import Options

OPTIONS = Options(4, inside="negative")

pytestmark = pytest.mark.usefixtures("folder")


@pytest.fixture(scope="module")
def mesh():
    return reconstruct(ball(14, 4.0), trilinear, 2)


def test_a_failed_write_leaves_what_was_there(mesh, monkeypatch):
    Path("out.ply").write_text("before")
    with pytest.raises(GridError):
        write_mesh(mesh, "out.ply", force=True, before_rename=Mock(side_effect=GridError("no")))
    full = OSError(28, "No space left on device")
    monkeypatch.setattr(meshes, "_write_ply", Mock(side_effect=full))
    said = refusal(FileError, write_mesh, mesh, "out.ply", force=True)
    assert said == "out.ply cannot be written: No space left on device"
    said = refusal(FileError, write_mesh, mesh, "out.ply")
    assert said == "out.ply exists: remove it or use force=True"
    said = refusal(OptionError, write_mesh, mesh, "out.xyz")
    assert f"give one of {', '.join(MESH_SUFFIXES)}" in said
    assert Path("out.ply").read_text() == "before" and os.listdir() == ["out.ply"]


def test_of_several_files_all_appear_or_none(mesh):
    files = {Path("a.ply"): {"": mesh}, Path("b.ply"): {"": mesh}}

    def take_a_name(complete):
        assert sorted(complete) == [Path("a.ply"), Path("b.ply")]
        Path("b.ply").write_text("theirs")

    said = refusal(FileError, write_meshes, files, before_rename=take_a_name)
    assert said == "b.ply exists: remove it or use force=True"
    assert os.listdir() == ["b.ply"] and Path("b.ply").read_text() == "theirs"
    write_meshes(files, force=True)
    assert Path("a.ply").read_bytes() == Path("b.ply").read_bytes()


@pytest.mark.parametrize("suffix", [".glb", ".3mf"])
def test_parts_have_names_and_colours(mesh, suffix):
    moved, name = Mesh(mesh.vertices + np.float32(20), mesh.faces), 'l & "r"'
    world = World("mm", colours={name: (255, 0, 128)})
    write_meshes({Path(f"out{suffix}"): {"one": mesh, name: moved}}, world=world)
    scene = trimesh.load(f"out{suffix}")
    metres = 1e-3 if suffix == ".glb" else 1.0
    assert scene.bounds[1] == pytest.approx(metres * moved.vertices.max(0), rel=1e-6)
    assert {"one", name} <= set(scene.graph.nodes) | set(scene.geometry)
    if suffix == ".glb":
        assert scene.geometry[name].visual.material.baseColorFactor.tolist() == [255, 0, 55, 255]
    else:
        text = ZipFile("out.3mf").read("3D/3dmodel.model").decode()
        assert 'displaycolor="#FF0080"' in text and "l &amp; &quot;r&quot;" in text


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
    "microns": (5e-6, 0.0),
    "nanometres": (1e-9, 1.0),
    "beyond single": (1e39, 0.0),
    "below single": (1e-44, 0.0),
}
REFUSED = {
    ".stl": set(PLACES) - {"near", "microns"},
    ".glb": {"beyond single", "below single"},
}


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".glb", ".3mf"])
@pytest.mark.parametrize("name", PLACES)
def test_a_format_holds_the_mesh_or_refuses_it(name, suffix):
    place(*PLACES[name])
    run, target = ("in.npz", f"out{suffix}", trilinear, OPTIONS), Path(f"out{suffix}")
    if name in REFUSED.get(suffix, ()):
        said = refusal(FileError, convert, *run)
        assert said.startswith(f"{target} cannot be written: {suffix} has single precision")
        assert os.listdir() == ["in.npz"]
    else:
        done, back = convert(*run), read(target)
        assert np.isfinite(back.vertices).all() and back.is_closed() and back.volume() > 0
        assert len(back.vertices) == done.counts["vertices"]
        assert len(back.faces) == done.counts["triangles"]


def test_a_mesh_that_its_format_would_flatten_is_refused(mesh):
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


NO_MESHES = {
    "a face of the mesh names vertex 9 of 3: repair it": (np.eye(3), [[0, 1, 9]]),
    "a face of the mesh names vertex -1 of 3: repair it": (np.eye(3), [[0, 1, -1]]),
    "the faces of the mesh are float64 of shape (1, 3): give rows of three indices": (
        np.eye(3),
        [[0.0, 1, 2]],
    ),
    "the vertices of the mesh are float64 of shape (3, 2): give rows of three floats": (
        np.eye(3)[:, :2],
        [[0, 1, 2]],
    ),
}


@pytest.mark.parametrize("said", NO_MESHES)
def test_arrays_that_are_no_mesh_are_refused(said):
    vertices, faces = NO_MESHES[said]
    for suffix in MESH_SUFFIXES:
        bad = Mesh(vertices, np.array(faces))
        assert refusal(MeshError, write_mesh, bad, f"a{suffix}") == said
    assert os.listdir() == []


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".3mf"])
def test_files_hold_the_very_numbers(monkeypatch, suffix):
    monkeypatch.setattr(meshes, "TEXT_CHUNK", 100)
    numbers = np.random.default_rng(0).standard_normal((999, 3)) ** 9 * 1e-3
    faces = np.arange(999, dtype=np.int32).reshape(-1, 3)
    for dtype in (np.float32, np.float64):
        write_mesh(Mesh(numbers.astype(dtype), faces), f"out{suffix}", force=True)
        back = trimesh.load(f"out{suffix}", force="mesh", process=False)
        corners = back.vertices[back.faces].astype(dtype)  # readers may order vertices anew
        np.testing.assert_array_equal(corners, numbers.astype(dtype)[faces])


def test_a_unit_is_stated_and_glb_is_in_metres(mesh, command):
    for name, unit, metres in (("millimeter", "mm", 1e-3), ("inch", "in", 0.0254)):
        write_mesh(mesh, "out.3mf", force=True, unit=unit)
        with ZipFile("out.3mf") as archive:
            assert f'<model unit="{name}" ' in archive.read("3D/3dmodel.model").decode()
        for shift in (0.0, 1e6):
            far = Mesh(mesh.vertices.astype(np.float64) + shift, mesh.faces)
            write_mesh(far, "out.glb", force=True, unit=unit)
            want = [far.vertices.min(0), far.vertices.max(0)]
            bounds = trimesh.load("out.glb").bounds
            np.testing.assert_allclose(bounds, metres * np.array(want), rtol=1e-6)
    place(0.5, 3.0)
    assert command("upsample", "in.npz", "mm.glb", "--unit", "mm", "-q")[0] == 0
    code, out, err = command("check", "mm.glb", "in.npz", "--unit", "mm", "--no-faults")
    assert (code, err) == (0, "") and "faults: none" in out
    end = "can state none, give .glb or .3mf, or no unit\n"
    code, _, err = command("upsample", "in.npz", "out.ply", "--unit", "mm")
    assert code == 2 and err.endswith(f"unit is mm: out.ply {end}")
