"""Meshes: open edges and pieces; marching cubes on anything; parts of a field fit together."""

import numpy as np
import pytest
from conftest import ball, is_manifold, trilinear, walled
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from super_sdf import Mesh, SdfGrid, extract_mesh, reconstruct, threads
from super_sdf.refine.band import neighbour_table
from super_sdf.refine.bounds import SampleSpheres
from super_sdf.refine.field import FineField
from super_sdf.refine.nodes import block_ijk, share_parts
from super_sdf.surface.cell_cases import make_tables
from super_sdf.surface.extract import extract
from super_sdf.surface.marching import FACES, tables
from super_sdf.surface.mesh import CLEARANCE


def dense_field(lattice: np.ndarray, factor: int = 2) -> tuple[FineField, SdfGrid]:
    """Wrap a dense fine lattice as a field in which every voxel is decoded, and all are exact."""
    shape = tuple((n - 1) // factor for n in lattice.shape)
    voxels = np.argwhere(np.ones(shape)).astype(np.int32)
    parts = share_parts(neighbour_table(voxels, shape))
    position = voxels * factor + block_ijk(factor)[:, None]
    blocks = lattice[tuple(np.moveaxis(position, 2, 0))].astype(np.float32)
    half = 0.5 - 0.5 / factor  # so that vertices come out in fine lattice indices
    grid = SdfGrid.trusted(
        np.zeros(shape, np.float32), (float(factor),) * 3, (half * factor + 0.5,) * 3
    )
    spheres = SampleSpheres(shape, np.arange(len(voxels)), blocks[len(blocks) // 2])
    return FineField(shape, factor, voxels, blocks, parts, grid, spheres=spheres), grid


def test_threads_change_nothing(monkeypatch):
    field, grid = dense_field(np.random.default_rng(0).normal(size=(13, 11, 15)))
    one, keys = extract(field, grid, mesher="sharp", cap=False)
    monkeypatch.setattr(threads, "CHUNK", 5000)
    monkeypatch.setattr(threads, "MIN_PER_THREAD", 1000)
    other, same = extract(field, grid, mesher="sharp", cap=False, threads=3)
    for a, b in ((one.vertices, other.vertices), (one.faces, other.faces), (keys, same)):
        np.testing.assert_array_equal(a, b)


def test_a_mesh_knows_its_open_edges_pieces_area_and_volume():
    mesh = reconstruct(ball(), trilinear)
    holed = Mesh(mesh.vertices, mesh.faces[5:])
    assert mesh.is_closed() and 0 < holed.open_edges() <= 15
    assert mesh.components()[0] == 1 and mesh.area() == pytest.approx(4 * np.pi * 36, rel=0.01)
    both = np.concatenate([mesh.faces, mesh.faces + len(mesh.vertices)])
    two = Mesh(np.tile(mesh.vertices, (2, 1)), both)
    assert two.components()[0] == 2 and two.volume() == pytest.approx(2 * mesh.volume())


def test_the_case_tables_of_the_package_are_those_of_the_rule():
    for stored, made in zip(tables(), make_tables()):
        np.testing.assert_array_equal(stored, made)


@pytest.mark.parametrize("face", FACES)
@pytest.mark.parametrize(("inner", "outer", "pieces"), [(-3, 2, 1), (-2, 3, 2), (-2, 2, 2)])
def test_a_face_joins_its_inside_corners_where_its_saddle_is_inside(face, inner, outer, pieces):
    """Bilinear interpolation is (a c - b d) / (a + c - b - d) at the saddle."""
    corners = np.full(8, 9.0)
    corners[list(face)] = inner, outer, inner, outer
    lattice = np.full((5, 5, 5), 9.0)
    lattice[1:3, 1:3, 1:3] = corners.reshape(2, 2, 2)
    mesh = extract_mesh(*dense_field(lattice), mesher="marching", cap=False)
    assert mesh.is_closed() and mesh.components()[0] == pieces


def test_vertices_are_those_of_scikit_image():
    lattice = np.random.default_rng(0).normal(size=(13, 11, 15)).astype(np.float32)
    mesh = extract_mesh(*dense_field(lattice), mesher="marching", cap=False)
    want = np.unique(np.round(marching_cubes(lattice, 0.0, method="lorensen")[0], 5), axis=0)
    assert len(mesh.vertices) == len(want)
    assert cKDTree(want).query(mesh.vertices)[0].max() < 2 * CLEARANCE


fields = hnp.arrays(
    np.float32,
    st.tuples(*[st.integers(6, 8)] * 3),
    elements=st.one_of(
        st.floats(-3, 3, width=32), st.sampled_from([0.0, -0.0, 1e-30, -1e-30, 1.5, -1.5, 50, -50])
    ),
    fill=st.nothing(),
)


@settings(max_examples=25)
@given(fields, st.sampled_from([2, 4]), st.sampled_from(["marching", "sharp"]), st.booleans())
def test_any_field_gives_a_closed_oriented_manifold(values, factor, mesher, leaves):
    """Also if it leaves the grid and is closed there."""
    values = values if leaves else walled(values)
    values[2, 2, 2], values[3, 3, 3] = 1, -1
    mesh = reconstruct(SdfGrid.trusted(values, 1.0), trilinear, factor, mesher=mesher)
    assert mesh.open_edges() == 0
    assert is_manifold(mesh)
    assert mesh.volume() > 0 or mesher == "sharp"
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
    assert len(np.unique(np.sort(mesh.faces, axis=1), axis=0)) == len(mesh.faces)
    beyond = np.maximum(-mesh.vertices, mesh.vertices - np.subtract(values.shape, 1))
    assert beyond.max() <= 0.51 + 1e-6  # the border is half a voxel beyond the samples
