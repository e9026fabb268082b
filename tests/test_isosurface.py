"""Marching cubes: the table, manifoldness on random fields, and scikit-image as an oracle."""

import numpy as np
import pytest
from conftest import ball, count_fans, trilinear, walled
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from super_sdf import SdfGrid, extract_mesh, load_network, reconstruct, upsample
from super_sdf.check.surface import count_components
from super_sdf.surface.mesh import CLEARANCE
from super_sdf.refine.band import neighbour_table
from super_sdf.surface.cell_cases import EDGE_AXIS, EDGE_START, FACES, choices, triangle_table
from super_sdf.refine.field import FineField
from super_sdf.refine.nodes import block_ijk, share_parts


def dense_field(lattice: np.ndarray, factor: int = 2) -> tuple[FineField, SdfGrid]:
    """Wrap a dense fine lattice as a field in which every voxel is decoded."""
    shape = tuple((n - 1) // factor for n in lattice.shape)
    voxels = np.argwhere(np.ones(shape)).astype(np.int32)
    parts = share_parts(neighbour_table(voxels, shape))
    position = voxels * factor + block_ijk(factor)[:, None]
    blocks = lattice[tuple(np.moveaxis(position, 2, 0))].astype(np.float32)
    half = 0.5 - 0.5 / factor  # so that vertices come out in fine lattice indices
    grid = SdfGrid.trusted(
        np.zeros(shape, np.float32), (float(factor),) * 3, (half * factor + 0.5,) * 3
    )
    return FineField(shape, factor, voxels, blocks, parts, (0, shape[0])), grid


def test_every_case_uses_exactly_its_crossed_edges():
    counts, table = triangle_table()
    number = choices().number
    assert sorted(number[number >= 0].tolist()) == list(range(len(counts)))
    assert number[:, 0].tolist() == list(range(256))
    for corners, joined in np.argwhere(number >= 0):
        case = number[corners, joined]
        inside = np.array([bool(corners >> corner & 1) for corner in range(8)])
        ends = [(start, start + (4, 2, 1)[axis]) for start, axis in zip(EDGE_START, EDGE_AXIS)]
        crossed = {edge for edge, (a, b) in enumerate(ends) if inside[a] != inside[b]}
        assert set(table[case, : counts[case]].ravel().tolist()) == crossed


@pytest.mark.parametrize("face", FACES)
@pytest.mark.parametrize(("inner", "outer", "pieces"), [(-3, 2, 1), (-2, 3, 2), (-2, 2, 2)])
def test_a_face_joins_its_inside_corners_where_its_saddle_is_inside(face, inner, outer, pieces):
    """Bilinear interpolation is (a c - b d) / (a + c - b - d) at the saddle."""
    corners = np.full(8, 9.0)
    corners[list(face)] = inner, outer, inner, outer
    lattice = np.full((5, 5, 5), 9.0)
    lattice[1:3, 1:3, 1:3] = corners.reshape(2, 2, 2)
    mesh = extract_mesh(*dense_field(lattice))
    assert mesh.is_closed() and count_components(mesh.faces, len(mesh.vertices)) == pieces


@pytest.mark.parametrize("thickness", [0.9, 1.2])
def test_a_thin_wall_across_the_lattice_has_no_slits(thickness):
    """Its nodes may be joined by diagonals only: separated, they would be a row of rods."""
    x, y, _ = np.indices((21, 21, 5))
    mesh = extract_mesh(*dense_field(np.abs(x - y + 0.1) / 2**0.5 - thickness / 2))
    assert count_components(mesh.faces, len(mesh.vertices)) == 2


def test_vertices_are_those_of_scikit_image():
    lattice = np.random.default_rng(0).normal(size=(13, 11, 15)).astype(np.float32)
    mesh = extract_mesh(*dense_field(lattice))
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


@settings(max_examples=40)
@given(fields, st.sampled_from([2, 4]), st.sampled_from(["marching", "sharp"]))
def test_any_field_gives_a_closed_oriented_manifold(values, factor, mesher):
    values = walled(values)
    values[3, 3, 3] = -1
    grid = SdfGrid.trusted(values, (1.0, 1.0, 1.0))
    mesh = reconstruct(grid, trilinear, factor, mesher=mesher)
    assert mesh.open_edges() == 0
    assert (count_fans(mesh.faces) == 1).all()
    assert mesh.volume() > 0 or mesher == "sharp"


@settings(max_examples=10)
@given(fields)
def test_any_field_is_closed_by_the_network_and_the_cap(values):
    values[2, 2, 2], values[3, 3, 3] = -1, 1
    grid = SdfGrid.trusted(values, (1.0, 1.0, 1.0))
    mesh = reconstruct(grid, load_network("fast"), 2)
    assert mesh.open_edges() == 0
    assert (count_fans(mesh.faces) == 1).all()


# Trained on limits from 1.5 voxels; the command fills in fields that are cut off nearer.
# Trained on limits from 1.5 voxels; the command fills in fields that are cut off nearer.
@pytest.mark.parametrize("limit, error", [(0.25, 0.15), (1.0, 0.02), (3.0, 0.005)])
def test_truncated_fields_are_closed(limit, error):
    values = np.clip(ball().values, -limit, limit)
    mesh = reconstruct(SdfGrid.trusted(values, 1.0), load_network())
    assert mesh.open_edges() == 0
    assert mesh.volume() == pytest.approx(4 / 3 * np.pi * 6**3, rel=error)


def test_exact_zeros_survive_merging_by_position():
    """Many programs merge coincident vertices; this cube's faces run through nodes."""
    import trimesh

    ijk = np.indices((14, 14, 14)) - 6
    values = (np.abs(ijk).max(0) - 3.0).astype(np.float32)
    mesh = reconstruct(SdfGrid.trusted(values, (0.1, 0.1, 0.1)), trilinear)
    merged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    assert len(merged.vertices) == len(mesh.vertices)
    assert merged.is_watertight and merged.is_winding_consistent
    assert merged.volume == pytest.approx(0.6**3, rel=2e-3)


def test_far_from_the_origin_vertices_are_double():
    grid = ball()
    field = upsample(grid, trilinear)
    near = extract_mesh(field, grid)
    far = extract_mesh(field, SdfGrid.trusted(grid.values, grid.spacing, (1e6, 0, 0)))
    assert near.vertices.dtype == np.float32 and far.vertices.dtype == np.float64
    np.testing.assert_allclose(far.vertices - [1e6, 0, 0], near.vertices, atol=1e-5)
