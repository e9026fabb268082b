"""Fewer triangles: closed forms, invariants on any mesh, what is measured, and the commands."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import ball, farthest, is_manifold, refusal, trilinear, walled
from hypothesis import example, given, settings, strategies as st
from solids import box_distance, cube, joined, sphere, square, torus
from trimesh.triangles import angles

from super_sdf import Mesh, SdfGrid, make_grid, read_grid, reconstruct, simplify_mesh
from super_sdf.errors import MeshError, NoSurfaceError, OptionError, OutOfMemoryError
from super_sdf.network.network import load_network
from super_sdf.truth import Solid

PART = Path(__file__).parent.parent / "examples" / "part.npz"
QUICK = ("--quality", "fast", "--factor", 2)


TURN = trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))[:3, :3]


def refined(mesh: Mesh, times: int) -> Mesh:
    """Return a mesh with every triangle cut into four, some times over."""
    fine = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    for _ in range(times):
        fine = fine.subdivide()
    fine.merge_vertices()
    return Mesh(np.array(fine.vertices), np.array(fine.faces, np.int32))


def genus(mesh: Mesh) -> int:
    """Return the genus of a connected closed mesh."""
    return 1 - (2 * len(mesh.vertices) - len(mesh.faces)) // 4


def is_closed_manifold(mesh: Mesh) -> bool:
    return mesh.is_closed() and is_manifold(mesh)


def three_holes() -> Mesh:
    """Return a plate with three drillings, the isosurface of a field of spacing 1."""
    x, y, z = np.indices((32, 14, 8)) - np.array([4.3, 6.6, 3.7])[:, None, None, None]
    plate = np.maximum(np.maximum(abs(x - 11.4) - 13.2, abs(y) - 4.6), abs(z) - 1.7)
    for k in range(3):
        plate = np.maximum(plate, 2.4 - np.hypot(x - 3.2 - 8.3 * k, y))
    return reconstruct(SdfGrid.trusted(plate.astype(np.float32), 1.0), trilinear, factor=2)


@pytest.mark.parametrize("half", [(7.5, 5, 6.5), (6, 6.25, 7)])
def test_a_box_along_the_lattice_has_few_triangles_and_slivers(half):
    """Its many tiny edges, beside nodes of the lattice, do not stay."""
    middle = 10 + np.array(half) % 1
    values = box_distance(np.moveaxis(np.indices((20,) * 3), 0, -1) - middle, np.array(half))
    fine = reconstruct(SdfGrid.trusted(values, 1.0), load_network())
    found = simplify_mesh(fine, error=0.05)
    smallest = angles(found.vertices.astype(float)[found.faces]).min(1)
    assert is_closed_manifold(found) and not len(Solid(found).intersecting())
    assert len(found.faces) < 500 and np.count_nonzero(smallest < np.radians(0.5)) < 12


@pytest.mark.parametrize("turn, most", [(np.eye(3), 12), (TURN, 24)], ids=["straight", "turned"])
def test_a_cube_of_many_triangles_has_twelve(turn, most):
    """Turned a few more: on exact planes pyfqmr's best vertex is anywhere."""
    fine = refined(cube(), 4).transformed(turn, np.ones(3))
    found = simplify_mesh(fine, error=1e-3)
    assert found.triangles_before == len(fine.faces) == 3072
    assert len(found.faces) <= most
    assert found.is_closed() and found.volume() == pytest.approx(1, abs=1e-6)
    assert max(found.deviation) < 1e-5 and found.warnings == ()
    corners = cube().vertices @ turn.T + 1
    assert np.linalg.norm(corners[:, None] - found.vertices, axis=2).min(1).max() < 1e-5


@pytest.mark.parametrize("error", [0.005, 0.02, 0.1])
def test_a_part_keeps_to_the_error_meets_itself_nowhere_and_has_no_slivers(error):
    """Both ways, also where edges of the two meshes cross; between its points a little more."""
    grid = make_grid(read_grid(PART).values[::2, ::2, ::2], spacing=3.0)
    mesh, error = reconstruct(grid, load_network()), 3 * error
    found = simplify_mesh(mesh, error=error)
    there, back = farthest(mesh, found), farthest(found, mesh)
    assert 0.7 * error < max(there, back) <= 1.05 * error
    assert found.deviation.largest == pytest.approx(there, rel=0.05)
    assert is_closed_manifold(found) and len(Solid(found).intersecting()) == 0
    corners = found.vertices[found.faces].astype(np.float64)
    assert (np.degrees(angles(corners).min(1)) < 0.5).mean() < 0.01


@pytest.mark.parametrize("goal", [{"error": 0.05}, {"triangles": 4}], ids=str)
def test_three_holes_and_all_components_stay(goal):
    plate = three_holes()
    found = simplify_mesh(plate, **goal)
    assert is_closed_manifold(found) and genus(plate) == genus(found) == 3
    assert len(found.faces) < len(plate.faces) / 3
    away = sphere(0.05).transformed(np.eye(3), np.array([2.0, 0, 0]))
    several = joined(torus(24, 12), away, away.transformed(np.eye(3), np.array([0, 2.0, 0])))
    found = simplify_mesh(several, **goal)
    split = trimesh.Trimesh(found.vertices, found.faces, process=False).split()
    assert len(split) == 3 and found.is_closed()


def test_an_open_border_stays_exactly_where_it_is():
    sheet = refined(square(0.5), 4)
    found = simplify_mesh(sheet, error=0.01)
    assert len(found.faces) < len(sheet.faces) / 4

    def border(mesh):
        return set(map(tuple, mesh.vertices[mesh.boundary()].reshape(-1, 6)))

    assert border(found) == border(sheet) and len(border(sheet)) == 64


@settings(max_examples=6)
@given(st.integers(0, 10**6), st.sampled_from([0.02, 0.2, 2.0]), st.booleans())
@example(235, 2.0, False)  # lost a component and a hole
def test_any_field_stays_a_closed_manifold_within_the_error(seed, error, in_float32):
    values = walled(np.random.default_rng(seed).normal(size=(9, 9, 9)).astype(np.float32))
    values[4, 4, 4] = -1
    grid = SdfGrid.trusted(values, (1.0, 1.0, 1.0), (0.0 if in_float32 else 3e4, 0.0, 0.0))
    try:
        mesh = reconstruct(grid, load_network("fast"), factor=2)
    except NoSurfaceError:
        return
    found = simplify_mesh(mesh, error=error)
    assert found.vertices.dtype == mesh.vertices.dtype
    assert is_closed_manifold(found)
    assert len(np.unique(found.vertices, axis=0)) == len(found.vertices)
    # points between those that are measured
    assert max(farthest(mesh, found), farthest(found, mesh)) <= 1.03 * error
    assert len(Solid(found).intersecting()) <= len(Solid(mesh).intersecting())
    before, after = (m.components()[0] for m in (mesh, found))
    assert before == after


def test_a_number_of_triangles_is_not_exceeded_and_what_the_shape_does_not_allow_is_said():
    mesh = torus(48, 24)
    for count in (1001, 60):
        found = simplify_mesh(mesh, triangles=count)
        assert count / 1.5 < len(found.faces) <= count and found.warnings == ()
        assert found.is_closed() and genus(found) == 1
    same = simplify_mesh(mesh, triangles=10**6)
    assert len(same.faces) == len(mesh.faces)
    assert max(same.deviation) < 1e-12
    found = simplify_mesh(mesh, triangles=4)
    left = len(found.faces)
    assert left > 4 and found.is_closed()
    said = "4 triangles cannot be reached while the mesh stays a manifold of the same topology: "
    assert found.warnings == (f"{said}it has {left}",)
    diagonal = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    assert max(found.deviation) <= 0.05 * diagonal


def test_a_number_of_triangles_is_no_farther_off_than_an_error_that_leaves_as_many():
    small = sphere(0.02, 6).transformed(np.eye(3), np.array([0.5, 0, 0.2]))
    mesh = joined(torus(48, 24), small.transformed(np.eye(3), np.array([1.0, 0, 0])))
    within = simplify_mesh(mesh, error=1e-2)
    found = simplify_mesh(mesh, triangles=len(within.faces))
    assert found.warnings == () and len(found.faces) <= len(within.faces)
    assert max(found.deviation.largest, found.deviation.largest_back) <= 1e-2
    assert is_closed_manifold(found) and found.components()[0] == 2


def test_what_does_not_fit_in_memory_is_refused():
    said = refusal(OutOfMemoryError, simplify_mesh, torus(), error=1e-3, max_memory=10**7)
    assert said.startswith("simplifying 9,216 triangles needs ")


WRONG = {
    "give error or triangles, and only one of them": {"error": 0.1, "triangles": 5},
    "error is 0: give a number greater than 0": {"error": 0},
    "error is nan: give a number greater than 0": {"error": float("nan")},
    "triangles is 3: give a whole number, 4 or more, as a closed mesh has": {"triangles": 3},
    "error is [1]: give a number greater than 0": {"error": [1]},
    "triangles is 4.5: give a whole number, 4 or more, as a closed mesh has": {"triangles": 4.5},
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_arguments_are_said(message):
    assert refusal(OptionError, simplify_mesh, cube(), **WRONG[message]) == message
    refusal(TypeError, simplify_mesh, "cube", error=1)
    refusal(MeshError, simplify_mesh, Mesh(cube().vertices * np.inf, cube().faces), error=1)


def test_the_command_simplifies_and_says_how_far_off(folder, command):
    np.savez("ball.npz", values=ball(20, 6.0).values / 2, spacing=0.5)
    words = ("upsample", "ball.npz", "a.ply", "--simplify", 0.02, "--check", "--json")
    code, out, err = command(*words, *QUICK)
    report = json.loads(out)
    found, surface = report["simplified"], report["check"]["surface"]
    off = found["deviation"]
    largest = max(off["largest"], off["largest_back"])
    assert code == 0 and report["closed"] and surface["closed"] and surface["manifold"]
    assert set(found) == {"voxel_size", "triangles_before", "triangles", "deviation", "warnings"}
    mesh = trimesh.load("a.ply", process=False)
    counts = (found["triangles"], report["triangles"], surface["triangles"])
    assert counts == (len(mesh.faces),) * 3 and found["triangles"] < found["triangles_before"] / 2
    assert len(mesh.vertices) == report["vertices"] and mesh.is_watertight
    assert set(off) == {"largest", "mean", "largest_back", "mean_back"}
    assert 0 < off["mean"] < off["largest"] <= largest <= 0.02
    assert np.allclose(report["bounds"], mesh.bounds)
    assert err.splitlines()[-2] == (
        f"Simplified: from {found['triangles_before']:,} to {found['triangles']:,} triangles; "
        f"largest distance {largest:.4f} voxels, {largest * found['voxel_size']:.4g} in world units"
    )
    assert "simplify" in report["seconds"]
    assert command("upsample", "ball.npz", "b.ply", "--tolerance", 0.01, *QUICK)[0] == 0
    assert Path("a.ply").read_bytes() == Path("b.ply").read_bytes()
