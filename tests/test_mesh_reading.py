"""Mesh files as they come: what is wrong with one is said in a line that names it."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import trimesh
from conftest import refusal
from corpus.case import mutate
from corpus.meshes import off
from solids import cube, sphere

from super_sdf import Mesh, write_mesh
from super_sdf.errors import MeshError, SuperSdfError
from super_sdf.truth.mesh_files import merged, read_mesh, read_plain_ply
from super_sdf.truth.solid import load_solid

FORMATS = ("ply", "stl", "stl_ascii", "obj", "off", "glb")


@pytest.mark.parametrize("kind", FORMATS)
def test_damaged_files_are_read_or_named_in_a_line(tmp_path, capfd, kind):
    ball = trimesh.Trimesh(*vars(sphere(size=6)).values())
    content = ball.export(file_type=kind)
    content = content if isinstance(content, bytes) else content.encode()
    path = tmp_path / f"ball.{kind.removesuffix('_ascii')}"
    rng, refused = np.random.default_rng(0), 0
    for number in range(40):
        cut = content[: rng.integers(len(content))] if number % 3 == 0 else content
        path.write_bytes(mutate(cut, rng, 0, 400 if number % 3 == 1 else None))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                mesh = read_mesh(path)
                assert np.isfinite(mesh.vertices).all() and mesh.faces.max() < len(mesh.vertices)
            except SuperSdfError as error:
                refused += 1
                assert str(error).startswith(str(path)) and "\n" not in str(error)
    assert refused > 5
    assert capfd.readouterr() == ("", "")


def changed_cube(index: int, coordinate: float) -> np.ndarray:
    """Return the cube's vertices with one that is elsewhere."""
    vertices = cube().vertices.copy()
    vertices[index, 0] = coordinate
    return vertices


WRONG = {
    "is no number": (
        changed_cube(3, np.nan),
        cube().faces,
        "holds coordinates that are not finite",
    ),
    "infinite": (changed_cube(3, np.inf), cube().faces, "holds coordinates that are not finite"),
    "huge": (changed_cube(3, 1e31), cube().faces, "reaches to 1e+31: scale it to coordinates"),
    "empty": (cube().vertices, np.zeros((0, 3), int), "holds no triangle: give a surface mesh"),
    "far": (cube().vertices, cube().faces + 3, "cannot be read as a mesh: OFF file has a face"),
    "flat": (cube().vertices * [1, 1, 0], cube().faces, "is flat: it encloses no volume"),
}


@pytest.mark.parametrize("name", WRONG)
def test_meshes_that_are_none(tmp_path, name):
    vertices, faces, message = WRONG[name]
    (path := tmp_path / "box.off").write_bytes(off(vertices, faces))
    assert refusal(SuperSdfError, load_solid, path).startswith(f"{path} {message}")


def test_faces_of_vertices_that_are_not_there(tmp_path):
    path = tmp_path / "box.ply"
    trimesh.Trimesh(cube().vertices, cube().faces + 3, process=False).export(path)
    assert " has a face of vertex 10, of 8: repair it" in refusal(MeshError, read_mesh, path)


@pytest.mark.parametrize(
    "name, text, said",
    [
        ("cloud.ply", trimesh.PointCloud(np.eye(3)).export(file_type="ply"), "holds no triangle"),
        ("text.ply", b"no mesh", "cannot be read as a mesh: "),
        ("lines.obj", b"v 0 0 0\nv 1 0 0\nl 1 2\n", "holds no triangle"),
        ("empty.stl", b"", "is empty"),
        ("deep.gltf", b"[" * 99999, "cannot be read"),
    ],
)
def test_files_without_a_mesh(tmp_path, name, text, said):
    (tmp_path / name).write_bytes(text)
    assert f"{name} {said}" in refusal(SuperSdfError, read_mesh, tmp_path / name)


def test_a_scene_is_one_mesh(tmp_path):
    away = Mesh(cube().vertices + 3, cube().faces)
    scene = trimesh.Scene([trimesh.Trimesh(mesh.vertices, mesh.faces) for mesh in (cube(), away)])
    scene.export(tmp_path / "two.glb")
    solid, notes = load_solid(tmp_path / "two.glb")
    assert notes == [] and solid.mesh.volume() == pytest.approx(2)
    points = np.array([[0.0, 0, 0], [3, 3, 3], [1.5, 1.5, 1.5]])
    assert solid.is_inside(points).tolist() == [1, 1, 0]


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0, 1e6, 1e25])
def test_vertices_at_one_place_are_one_at_every_scale(size):
    ball = sphere(size=12)
    corners = ball.vertices[ball.faces].reshape(-1, 3) * size
    soup = Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))
    whole = merged(soup)
    assert len(whole.vertices) == len(ball.vertices) and whole.is_closed()
    assert np.array_equal(whole.vertices[whole.faces], soup.vertices[soup.faces])


def test_a_mesh_is_not_open_along_the_seams_of_its_texture(tmp_path):
    """Each face of the box has texture coordinates of its own."""
    corners = cube().vertices[cube().faces].reshape(-1, 3)
    rows = [f"v {x} {y} {z}" for x, y, z in corners]
    rows += [f"vt {n / 40} 0" for n in range(len(corners))]
    rows += ["f " + " ".join(f"{n}/{n}" for n in range(m, m + 3)) for m in range(1, 37, 3)]
    (tmp_path / "box.obj").write_text("\n".join(rows))
    solid, notes = load_solid(tmp_path / "box.obj")
    assert notes == [] and solid.is_closed and len(solid.mesh.vertices) == 8


@pytest.mark.parametrize("double", [False, True])
def test_plain_ply_files_are_read_as_trimesh_reads_them(tmp_path, double):
    ball = sphere(size=6)
    kind = np.float64 if double else np.float32
    write_mesh(Mesh(ball.vertices.astype(kind), ball.faces), tmp_path / "ball.ply")
    vertices, faces = read_plain_ply(tmp_path / "ball.ply")
    other = trimesh.load_mesh(tmp_path / "ball.ply", process=False)
    assert np.array_equal(vertices, other.vertices) and np.array_equal(faces, other.faces)
    assert vertices.dtype == np.float64


def test_other_ply_files_are_left_to_trimesh(tmp_path):
    """Text, quadrilaterals, more properties of faces, and a file that is cut short."""
    text = tmp_path / "text.ply"
    trimesh.Trimesh(*vars(cube()).values()).export(text, encoding="ascii")
    assert read_plain_ply(text) is None and len(read_mesh(text).faces) == 12
    plain = tmp_path / "plain.ply"
    write_mesh(cube(), plain)
    content = plain.read_bytes()
    for wrong in (content[:-1], content.replace(b"little", b"big"), b"", b"ply\n" * 100):
        plain.write_bytes(wrong)
        assert read_plain_ply(plain) is None
    start = content.index(b"end_header\n") + len(b"end_header\n") + 8 * 3 * 8
    plain.write_bytes(content[:start] + b"\x04" + content[start + 1 :])
    assert read_plain_ply(plain) is None
