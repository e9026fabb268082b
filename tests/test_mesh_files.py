"""Meshes to files, nothing half-written, and from files: what is wrong is said in a line."""

import os
import stat
import warnings
from pathlib import Path
from zipfile import ZipFile

import nibabel
import numpy as np
import pytest
import trimesh
from conftest import ball, refusal, trilinear
from solids import cube, sphere

from super_sdf import Mesh, reconstruct, write_mesh
from super_sdf.convert import convert
from super_sdf.errors import FileError, MeshError, SuperSdfError, WriteError
from super_sdf.files import meshes
from super_sdf.files.meshes import MESH_SUFFIXES, World, write_meshes
from super_sdf.files.output import check_free, replacing
from super_sdf.options import Options
from super_sdf.truth import load_solid, merged, read_mesh

pytestmark = pytest.mark.usefixtures("folder")


@pytest.fixture(scope="module")
def mesh():
    return reconstruct(ball(14, 4.0), trilinear, 2)


def test_of_several_files_all_appear_or_none(mesh):
    files = {Path("a.ply"): {"": mesh}, Path("b.ply"): {"": mesh}}
    Path("b.off").write_text("theirs")
    said = refusal(FileError, write_meshes, {**files, Path("b.off"): {"": mesh}})
    assert said == "b.off exists: remove it or use force=True"
    assert os.listdir() == ["b.off"] and Path("b.off").read_text() == "theirs"
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
    "eight spacings off": (0.1, 3.25e7),
    "beyond single": (1e39, 0.0),
    "below single": (1e-44, 0.0),
}
REFUSED = {".stl": set(PLACES) - {"near", "microns"}, ".glb": {"beyond single", "below single"}}


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".glb", ".3mf"])
@pytest.mark.parametrize("name", PLACES)
def test_a_format_holds_the_mesh_or_refuses_it(name, suffix):
    place(*PLACES[name])
    run, target = ("in.npz", f"out{suffix}", trilinear), Path(f"out{suffix}")
    if name in REFUSED.get(suffix, ()):
        said = refusal(FileError, convert, *run, Options(4, inside="negative"))
        assert said.startswith("the format has single precision, which moves vertices by up to ")
        assert said.endswith(": write .ply or .obj")
        assert os.listdir() == ["in.npz"]
    else:
        done, back = convert(*run, Options(4, inside="negative")), read(target)
        assert np.isfinite(back.vertices).all() and back.is_closed() and back.volume() > 0
        assert len(back.vertices) == done.facts["vertices"]
        assert len(back.faces) == done.facts["triangles"]


def test_normals_of_small_triangles_have_length_1():
    """Normals are stored in .stl alone: of a ball in metres, with samples a micron apart."""
    mesh = reconstruct(ball(12, 3.0), trilinear)
    write_mesh(Mesh(1e-6 * mesh.vertices, mesh.faces), "small.stl")
    normals = np.frombuffer(Path("small.stl").read_bytes()[84:], "<3f4, <9f4, <u2")["f0"]
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(("corner", "vertex", "said"), [
    (1, 9, "a face of the mesh names vertex 9 of 3: repair it"),
    (1, -1, "a face of the mesh names vertex -1 of 3: repair it"),
    (np.nan, 2, "a vertex of the mesh is not finite: repair it"),
])  # fmt: skip
def test_arrays_that_are_no_mesh_are_refused(corner, vertex, said):
    bad = Mesh(corner * np.eye(3), np.array([[0, 1, vertex]]))
    for suffix in MESH_SUFFIXES:
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
    for code, name in ((1, "meter"), (2, "millimeter"), (3, "micron")):
        image = nibabel.Nifti1Image(ball(12, 3.0).values, np.eye(4))
        image.header["xyzt_units"] = code
        nibabel.save(image, "in.nii")
        assert command("upsample", "in.nii", "u.3mf", "--force", "-q")[0] == 0
        assert f'unit="{name}"' in ZipFile("u.3mf").read("3D/3dmodel.model").decode()
    assert "the file states um" in command("upsample", "in.nii", "v.3mf", "--unit", "mm")[2]
    place(0.5, 3.0)
    assert command("upsample", "in.npz", "mm.glb", "--unit", "mm", "-q")[0] == 0
    code, out, err = command("check", "mm.glb", "in.npz", "--unit", "mm", "--no-faults")
    assert (code, err) == (0, "") and "faults: none" in out
    code, _, err = command("upsample", "in.npz", "out.ply", "--unit", "mm")
    assert code == 0 and "Note: out.ply states no unit, only a .glb or .3mf does\n" in err


# Mesh files as they come


@pytest.mark.parametrize("kind", ["ply", "stl", "stl_ascii", "obj", "off", "glb"])
def test_damaged_files_are_read_or_named_in_a_line(capfd, kind):
    round_ = trimesh.Trimesh(sphere(size=6).vertices, sphere(size=6).faces)
    content = round_.export(file_type=kind)
    content = content if isinstance(content, bytes) else content.encode()
    path = Path(f"ball.{kind.removesuffix('_ascii')}")
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
    return trimesh.Trimesh(vertices, faces, process=False).export(file_type="off").encode()


def changed_cube(coordinate: float) -> np.ndarray:
    """Return the cube's vertices with one that is elsewhere."""
    vertices = cube().vertices.copy()
    vertices[3, 0] = coordinate
    return vertices


FACES, BOX = cube().faces, cube().vertices
POINTS = trimesh.PointCloud(np.eye(3)).export(file_type="ply")
WRONG = {
    "nan.off": (off(changed_cube(np.nan), FACES), "reaches to nan: repair it"),
    "huge.off": (off(changed_cube(1e31), FACES), "reaches to 1e+31: repair it, or scale it"),
    "none.off": (off(BOX, np.zeros((0, 3), int)), "holds no triangle: give a surface mesh"),
    "far.off": (off(BOX, FACES + 3), "cannot be read as a mesh: OFF file has a face"),
    "flat.off": (off(BOX * [1, 1, 0], FACES), "is flat: it encloses no volume"),
    "cloud.ply": (POINTS, "holds no triangle"),
    "text.ply": (b"no mesh", "cannot be read as a mesh: "),
    "empty.stl": (b"", "is empty"),
    "deep.gltf": (b"[" * 99999, "cannot be read"),
}


@pytest.mark.parametrize("name", WRONG)
def test_files_without_a_solid_are_named(name):
    content, said = WRONG[name]
    Path(name).write_bytes(content)
    assert refusal(SuperSdfError, load_solid, name).startswith(f"{name} {said}")


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0, 1e6, 1e25])
def test_vertices_at_one_place_are_one_at_every_scale(size):
    ball = sphere(size=12)
    corners = ball.vertices[ball.faces].reshape(-1, 3) * size
    soup = Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))
    whole = merged(soup)
    assert len(whole.vertices) == len(ball.vertices) and whole.is_closed()
    assert np.array_equal(whole.vertices[whole.faces], soup.vertices[soup.faces])


def test_a_mesh_is_not_open_along_the_seams_of_its_texture():
    """Each face of the box has texture coordinates of its own."""
    corners = BOX[FACES].reshape(-1, 3)
    rows = [f"v {x} {y} {z}" for x, y, z in corners]
    rows += [f"vt {n / 40} 0" for n in range(len(corners))]
    rows += ["f " + " ".join(f"{n}/{n}" for n in range(m, m + 3)) for m in range(1, 37, 3)]
    Path("box.obj").write_text("\n".join(rows))
    solid, notes = load_solid("box.obj")
    assert notes == [] and solid.unbalanced_edges == 0 and len(solid.mesh.vertices) == 8


# Files that appear whole or not at all, and what is left of those that did not


def make(path, *, force=False, meanwhile=lambda: None):
    """Write a file as all are written; something happens meanwhile."""
    with replacing(Path(path), force=force) as part:
        part.write_text("mine")
        meanwhile()


def why(path, *, force=False):
    """Return why a file cannot be made there, before the work."""
    return refusal(WriteError, check_free, Path(path), force=force)


def test_a_file_that_appears_meanwhile_is_kept_unless_forced():
    make("one.ply")
    want = "^out.ply exists: remove it or use force=True$"
    with pytest.raises(WriteError, match=want):
        make("out.ply", meanwhile=lambda: Path("out.ply").write_text("theirs"))
    assert Path("out.ply").read_text() == "theirs"
    make("out.ply", force=True, meanwhile=lambda: Path("out.ply").write_text("theirs"))
    assert Path("out.ply").read_text() == "mine"
    with pytest.raises(WriteError, match=r"^new.ply exists: remove"):
        make("new.ply", meanwhile=lambda: os.symlink("gone.ply", "new.ply"))  # is not followed
    assert sorted(os.listdir()) == ["new.ply", "one.ply", "out.ply"]


@pytest.mark.parametrize("there", ["old", None])
def test_by_force_a_link_stays_one_and_what_it_leads_to_is_written(there):
    os.mkdir("disk")
    if there:
        Path("disk/there.ply").write_text(there)
    os.symlink("disk/there.ply", "out.ply")
    assert why("out.ply") == "out.ply exists: remove it or use force=True"
    make("out.ply", force=True)
    assert os.readlink("out.ply") == "disk/there.ply"
    assert Path("disk/there.ply").read_text() == "mine" and os.listdir("disk") == ["there.ply"]


@pytest.mark.parametrize("name", ["out.ply", "x" * 251 + ".ply", "ä" * 125 + ".ply"])
def test_a_file_that_is_replaced_keeps_its_mode_and_a_protected_one_stays(name):
    make(name)
    os.chmod(name, 0o664)
    make(name, force=True)
    assert os.listdir() == [name] and stat.S_IMODE(os.stat(name).st_mode) == 0o664
    Path(name).write_text("old")
    with pytest.raises(WriteError, match="is write-protected: allow writing to it, or give ano"):
        make(name, force=True, meanwhile=lambda: os.chmod(name, 0o444))
    assert "is write-protected" in why(name, force=True)  # also for root
    assert Path(name).read_text() == "old" and os.listdir() == [name]
