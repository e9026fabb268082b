"""Grids that are turned or mirrored in the world or in an anatomical space, and their meshes."""

import json
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
import trimesh
from conftest import ball, refusal, trilinear
from hypothesis import given, settings, strategies as st
from test_anisotropic import pear as to_pear

from super_sdf import make_grid, read_grid, reconstruct
from super_sdf.errors import GridError, OptionError
from super_sdf.grid.sdf_grid import volume_of_samples

MIRROR = np.diag([1.0, -1.0, 1.0])
ORIGIN = np.array([10.0, -20.0, 5.0])


def turn(x: float, y: float, z: float) -> np.ndarray:
    return trimesh.transformations.euler_matrix(x, y, z)[:3, :3]


def pear() -> np.ndarray:
    """Return samples of a part that no turn or mirroring maps to itself."""
    return to_pear(np.moveaxis(np.indices((18, 15, 21)), 0, -1) * 0.5)


@given(st.tuples(*[st.floats(-3, 3)] * 3), st.booleans(), st.sampled_from(("marching", "sharp")))
@settings(max_examples=8)
def test_the_mesh_of_a_turned_grid_is_the_turned_mesh(angles, mirrored, mesher):
    direction = turn(*angles) @ (MIRROR if mirrored else np.eye(3))
    straight = reconstruct(make_grid(pear(), spacing=0.5), trilinear, 2, mesher=mesher)
    grid = make_grid(pear(), spacing=0.5, origin=ORIGIN, direction=direction)
    mesh = reconstruct(grid, trilinear, 2, mesher=mesher)
    assert np.abs(straight.vertices @ direction.T + ORIGIN - mesh.vertices).max() < 1e-5
    assert mesh.is_closed()
    assert mesh.volume() == pytest.approx(straight.volume(), rel=1e-5) and mesh.volume() > 0
    faces = straight.faces[:, ::-1] if mirrored else straight.faces
    assert np.array_equal(mesh.faces, faces)


UNIT = "give a unit vector of each axis, as columns that lie in no plane"
NO_DIRECTION = {
    "(1, 0, 0): give nine numbers, row by row, or a 3 x 3 matrix": (1, 0, 0),
    f"1, 0, 0; 0, 1, 0; 0, 0, 2: {UNIT}": np.diag([1, 1, 2]),
    f"1, 1, 0; 0, 0, 0; 0, 0, 1: {UNIT}": [[1, 1, 0], [0, 0, 0], [0, 0, 1]],
    f"{[np.nan] * 9}: it must be finite": [np.nan] * 9,
}


@pytest.mark.parametrize("said", NO_DIRECTION)
def test_what_is_no_direction_is_refused(said):
    place = {"spacing": 0.5, "direction": NO_DIRECTION[said]}
    assert refusal(GridError, make_grid, pear(), **place) == f"direction is {said}"


def test_the_command_takes_a_direction_and_check_agrees(folder, command):
    direction = turn(0.4, 0.1, -0.3) @ MIRROR
    np.save("a.npy", pear())
    job = {"in": "a.npy", "spacing": 0.5, "origin": [10, -20, 5]}
    Path("list.jsonl").write_text(json.dumps({**job, "direction": direction.ravel().tolist()}))
    said = ",".join(f"{entry:.17g}" for entry in direction.ravel())
    options = ("--spacing", 0.5, "--origin=10,-20,5", f"--direction={said}")
    code, out, err = command("upsample", "a.npy", "a.ply", "--quality", "fast", "--json", *options)
    assert code == 0 and np.allclose(json.loads(out)["direction"], direction), err
    mesh = trimesh.load("a.ply")
    off = to_pear((mesh.vertices - ORIGIN) @ direction)
    assert np.abs(off).max() < 0.06 and mesh.volume > 0 and mesh.is_watertight
    code, out, err = command("check", "a.ply", "a.npy", "--no-faults", "--json", *options)
    report = json.loads(out)
    assert code == 0 and report["strays"] == 0 and report["residual"]["mean"] < 0.02, err
    code, out, err = command("batch", "list.jsonl", "--out", "out", "--quality", "fast", "-q")
    assert code == 0 and Path("out/a.ply").read_bytes() == Path("a.ply").read_bytes(), err


# Anatomical spaces

AFFINE = np.array([[0, -0.5, 0, 10.0], [0.5, 0, 0, -20], [0, 0, 0.5, 30], [0, 0, 0, 1]])
VALUES = ball(14, 4.0).values * np.float32(0.5)
LPS = np.diag([-1.0, -1, 1])
MIDDLE = AFFINE[:3, :3] @ np.full(3, 7 - 0.37) + AFFINE[:3, 3]  # of the ball, in RAS


@pytest.fixture
def here(folder):
    """Work in a folder with the same ball as NIfTI in RAS, as NRRD and MetaImage in both."""
    nibabel.save(nibabel.Nifti1Image(VALUES, AFFINE), "ball.nii")
    nibabel.save(nibabel.MGHImage(VALUES, AFFINE), "ball.mgz")
    for name, turn in (("right-anterior-superior", np.eye(3)), ("left-posterior-superior", LPS)):
        axes, corner = (turn @ AFFINE[:3, :3]).T, turn @ AFFINE[:3, 3]
        header = {"space": name, "space directions": axes, "space origin": corner}
        nrrd.write(f"{name}.nrrd", VALUES, header)
    matrix = " ".join(map(str, (LPS @ AFFINE[:3, :3]).T.ravel() / 0.5))
    offset = " ".join(map(str, LPS @ AFFINE[:3, 3]))
    Path("ball.mha").write_bytes(
        f"NDims = 3\nDimSize = 14 14 14\nElementType = MET_FLOAT\nElementSpacing = .5 .5 .5\n"
        f"TransformMatrix = {matrix}\nOffset = {offset}\nElementDataFile = LOCAL\n".encode()
        + VALUES.T.tobytes()
    )


FILES = {
    "ball.nii": "RAS",
    "ball.mgz": "RAS",
    "right-anterior-superior.nrrd": "RAS",
    "left-posterior-superior.nrrd": "LPS",
    "ball.mha": "LPS",
}


@pytest.mark.parametrize("name", FILES)
def test_a_grid_is_in_the_space_of_its_file_or_in_the_one_asked_for(here, name):
    for asked in (None, "RAS", "LPS"):
        grid = read_grid(name, space=asked)
        assert grid.space == (asked or FILES[name])
        where = grid.to_world(np.argwhere(grid.values == grid.low).mean(0))
        want = MIDDLE if grid.space == "RAS" else LPS @ MIDDLE
        np.testing.assert_allclose(where, want, atol=0.5)


@pytest.mark.parametrize("suffix, asked", [(".ply", None), (".stl", "LPS"), (".obj", "RAS")])
def test_meshes_lie_there_and_say_so(here, command, suffix, asked):
    words = ["--space", asked] if asked else []
    out = f"out{suffix}"
    assert command("upsample", "ball.nii", out, "--factor", 2, "-q", *words)[0] == 0
    want = MIDDLE if asked != "LPS" else LPS @ MIDDLE
    np.testing.assert_allclose(trimesh.load(out).bounds.mean(0), want, atol=0.02)
    head = Path(out).read_bytes()[:200]
    assert f"SPACE={asked or 'RAS'}".encode() in head
    code, said, _ = command("check", out, "ball.nii", "--no-faults", *words)
    assert code == 0 and "faults: none" in said


def test_what_states_no_space_has_none(here, command):
    np.savez("in.npz", values=VALUES, spacing=0.5)
    assert read_grid("in.npz").space is None
    assert command("upsample", "in.npz", "out.ply", "--factor", 2, "-q")[0] == 0
    assert b"SPACE" not in Path("out.ply").read_bytes()[:320]
    nrrd.write("plain.nrrd", VALUES, {"spacings": [0.5] * 3})
    nibabel.save(nibabel.Nifti1Image(VALUES, None), "plain.nii")
    for name in ("in.npz", "plain.nrrd", "plain.nii"):
        said = f"{name} states neither RAS nor LPS: leave out "
        assert refusal(OptionError, read_grid, name, space="LPS") == f"{said}space='LPS'"
        code, _, err = command("upsample", name, "a.ply", "--space", "LPS")
        assert code == 2 and err.endswith(f"{said}--space LPS\n")


LEANING = np.array([[1, 0.3, 0], [0, np.sqrt(1 - 0.09), 0.2], [0, 0, np.sqrt(1 - 0.04)]])
LEAN = {"spacing": (0.5, 0.5, 1.0), "origin": (3, 4, 5), "direction": LEANING}


def leaning_ball() -> np.ndarray:
    """Return distances to a ball of radius 5 at samples whose axes are not at right angles."""
    steps = np.moveaxis(np.indices((36, 34, 18)), 0, -1) * LEAN["spacing"]
    return np.linalg.norm((steps - (9, 8.5, 8.5)) @ LEANING.T, axis=-1) - 5


LEANING_KINDS = {
    "mask": (leaning_ball() < 0, {}, 0.5),
    "density": (1 / (1 + np.exp(leaning_ball())), {"level": 0.5}, 0.03),
    "smooth": (leaning_ball(), {}, 0.03),
}


@pytest.mark.parametrize("kind", LEANING_KINDS)
def test_what_is_no_distance_is_meshed_on_axes_that_lean(kind):
    values, options, limit = LEANING_KINDS[kind]
    grid = make_grid(values, **LEAN, **options)
    mesh = reconstruct(grid, trilinear)
    centre = np.array(LEAN["origin"]) + LEANING @ (9, 8.5, 8.5)
    off = np.linalg.norm(mesh.vertices - centre, axis=1) - 5
    assert grid.field.kind == kind and mesh.is_closed() and np.abs(off).max() < limit
    assert mesh.volume() == pytest.approx(4 / 3 * np.pi * 125, rel=0.03)
    assert volume_of_samples(grid) == pytest.approx(4 / 3 * np.pi * 125, rel=0.03)


def test_the_network_takes_no_distances_on_axes_that_lean():
    said = refusal(GridError, make_grid, leaning_ball(), **LEAN, field="distance")
    assert said.startswith("direction is 1, 0.3, 0; 0, 0.9539, 0.2; 0, 0, 0.9798: its axes are not")
    assert said.endswith("mesh the spline of the values (field='smooth')")
