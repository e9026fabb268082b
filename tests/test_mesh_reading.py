"""Mesh files as they come: what is wrong with one is said in a line that names it."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import trimesh
from conftest import refusal
from solids import cube, sphere

from super_sdf import Mesh
from super_sdf.errors import SuperSdfError
from super_sdf.truth.solid import load_solid, merged, read_mesh


@pytest.mark.parametrize("kind", ["ply", "stl", "stl_ascii", "obj", "off", "glb"])
def test_damaged_files_are_read_or_named_in_a_line(tmp_path, capfd, kind):
    ball = trimesh.Trimesh(sphere(size=6).vertices, sphere(size=6).faces)
    content = ball.export(file_type=kind)
    content = content if isinstance(content, bytes) else content.encode()
    path = tmp_path / f"ball.{kind.removesuffix('_ascii')}"
    rng, refused = np.random.default_rng(0), 0
    for number in range(40):
        cut = content[: rng.integers(len(content))] if number % 3 == 0 else content
        changed = bytearray(cut)
        for at in rng.integers(0, max(min(len(cut), 400), 1), 4):
            changed[at : at + 1] = rng.bytes(1)
        path.write_bytes(bytes(changed))
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


def off(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """Return a mesh as OFF."""
    rows = [" ".join(map(str, row)) for row in vertices.tolist()]
    rows += ["3 " + " ".join(map(str, row)) for row in faces.tolist()]
    return "\n".join(["OFF", f"{len(vertices)} {len(faces)} 0", *rows, ""]).encode()


def changed_cube(coordinate: float) -> np.ndarray:
    """Return the cube's vertices with one that is elsewhere."""
    vertices = cube().vertices.copy()
    vertices[3, 0] = coordinate
    return vertices


FACES, BOX = cube().faces, cube().vertices
POINTS = trimesh.PointCloud(np.eye(3)).export(file_type="ply")
WRONG = {
    "nan.off": (off(changed_cube(np.nan), FACES), "holds coordinates that are not finite"),
    "huge.off": (off(changed_cube(1e31), FACES), "reaches to 1e+31: scale it to coordinates"),
    "none.off": (off(BOX, np.zeros((0, 3), int)), "holds no triangle: give a surface mesh"),
    "far.off": (off(BOX, FACES + 3), "cannot be read as a mesh: OFF file has a face"),
    "short.off": (off(BOX, FACES)[:-20], "is truncated: it states 12 faces and holds "),
    "flat.off": (off(BOX * [1, 1, 0], FACES), "is flat: it encloses no volume"),
    "cloud.ply": (POINTS, "holds no triangle"),
    "text.ply": (b"no mesh", "cannot be read as a mesh: "),
    "lines.obj": (b"v 0 0 0\nv 1 0 0\nl 1 2\n", "holds no triangle"),
    "empty.stl": (b"", "is empty"),
    "deep.gltf": (b"[" * 99999, "cannot be read"),
}


@pytest.mark.parametrize("name", WRONG)
def test_files_without_a_solid_are_named(tmp_path, name):
    content, said = WRONG[name]
    (path := tmp_path / name).write_bytes(content)
    assert refusal(SuperSdfError, load_solid, path).startswith(f"{path} {said}")


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
    corners = BOX[FACES].reshape(-1, 3)
    rows = [f"v {x} {y} {z}" for x, y, z in corners]
    rows += [f"vt {n / 40} 0" for n in range(len(corners))]
    rows += ["f " + " ".join(f"{n}/{n}" for n in range(m, m + 3)) for m in range(1, 37, 3)]
    (tmp_path / "box.obj").write_text("\n".join(rows))
    solid, notes = load_solid(tmp_path / "box.obj")
    assert notes == [] and solid.is_closed and len(solid.mesh.vertices) == 8
