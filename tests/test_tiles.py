"""Tiles make the mesh of one piece: closed, with the same triangles, wherever a grid is cut."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from conftest import ball, refusal, trilinear
from hypothesis import given, settings, strategies as st

from super_sdf import SdfGrid, load_network, make_grid, pipeline, reconstruct, tiles
from super_sdf.errors import MeshError, OptionError, OutOfMemoryError
from super_sdf.options import Options
from super_sdf.pipeline import make_tile, mesh_grid


class Close:
    """Trilinear interpolation, which says how far it sees, so that margins are small."""

    receptive_field = 1
    __call__ = staticmethod(trilinear)


CLOSE = Close()
OPTIONS = [
    Options(),
    Options(2, mesher="marching", cap=False),
    Options(4, mesher="sharp", cap=False),
    Options(8, mesher="marching", offset=0.25),
]


def assert_same(one, other, off=1e-4):
    """Two meshes have the same vertices, up to ``off``, and the same triangles of them."""
    from scipy.spatial import cKDTree

    distance, number = cKDTree(one.vertices).query(other.vertices)
    assert len(one.vertices) == len(other.vertices) == len(np.unique(number))
    assert distance.max() <= off
    faces = number[other.faces]
    assert len(faces) == len(one.faces)
    canonical = (np.sort(m, axis=1) for m in (one.faces, faces))
    first, second = (m[np.lexsort(m.T)] for m in canonical)
    np.testing.assert_array_equal(first, second)
    assert one.volume() == pytest.approx(other.volume(), rel=1e-5)


def balls(shape=(110, 20, 30), count=40, seed=0, h=1.0):
    """Return a union of balls, some of which run out of a long grid."""
    rng, ijk = np.random.default_rng(seed), np.indices(shape).astype(np.float64)
    centres, radii = rng.uniform(3, np.array(shape) - 4, (count, 3)), rng.uniform(1.5, 5, count)
    places = zip(centres[..., None, None, None], radii)
    away = np.min([np.linalg.norm(ijk - c, axis=0) - r for c, r in places], axis=0)
    return SdfGrid.trusted((away * h).astype(np.float32), h, (1.0, 2.0, 3.0))


@pytest.mark.parametrize("options", OPTIONS, ids=["auto", "open", "sharp", "offset"])
def test_tiles_make_the_same_mesh(options):
    grid = balls(h=0.5)
    one = mesh_grid(grid, CLOSE, options)
    assert one.tiles == 1 and (one.open_edges > 0) == (not options.cap)
    for count in (2, 3, 8):
        many = mesh_grid(grid, CLOSE, options, least_tiles=count)
        assert many.tiles >= count
        assert_same(one.mesh, many.mesh, 5e-5)
        assert (one.open_edges, one.whole.count) == (many.open_edges, many.whole.count)


@settings(max_examples=15)
@given(st.integers(0, 2**32), st.integers(2, 8), st.booleans(), st.booleans())
def test_tiles_of_random_fields_make_the_same_mesh(seed, count, cap, sharp):
    values = np.random.default_rng(seed).normal(size=(60, 9, 8))
    grid = SdfGrid.trusted(values + np.roll(values, 1, 0) + np.roll(values, 1, 1), 1.0)
    options = Options(2, mesher="sharp" if sharp else "marching", cap=cap)
    one = mesh_grid(grid, CLOSE, options)
    many = mesh_grid(grid, CLOSE, options, least_tiles=count)
    assert_same(one.mesh, many.mesh)
    assert one.open_edges == many.open_edges
    assert one.whole.noisy == many.whole.noisy


def stretched():
    x, y, z = np.indices((40, 30, 20)) * np.array([1, 1, 2.0])[:, None, None, None]
    away = np.hypot(np.hypot(x - 19.3, y - 14.6) - 9, z - 19.1) - 3.3
    return make_grid(away, spacing=(1, 1, 2), origin=0.0)


def unknown():
    values = balls().values.copy()
    values[50:52, values[50] > 2] = np.nan
    return make_grid(values, spacing=1.0, origin=0.0)


KINDS = {
    "mask": lambda: make_grid(balls().values < 0, spacing=1.0, origin=0.0),
    "smooth": lambda: make_grid(np.tanh(balls().values / 3), spacing=1.0, origin=0, field="smooth"),
    "stretched": stretched,
    "unknown": unknown,
}


@pytest.mark.parametrize("kind", KINDS)
def test_tiles_of_other_kinds_of_grids_make_the_same_mesh(kind):
    grid, network = KINDS[kind](), load_network("fast")
    options = Options(2, cap=grid.field.unseen is None)
    one = mesh_grid(grid, network, options)
    many = mesh_grid(grid, network, options, least_tiles=3)
    assert many.tiles >= 3
    assert_same(one.mesh, many.mesh)


class Sliced:
    """Stands for an array of Zarr or HDF5, which is read by slices; counts what is read."""

    def __init__(self, values):
        self.values, self.shape, self.dtype, self.chunks = values, values.shape, values.dtype, None
        self.most = 0

    def __getitem__(self, box):
        part = self.values[box]
        self.most = max(self.most, part.size)
        return part


def test_an_array_that_is_read_by_slices_is_never_read_whole(monkeypatch):
    monkeypatch.setattr("super_sdf.refine.band.BLOCK_SAMPLES", 3000)
    values = balls().values
    lazy = Sliced(values)
    grid = SdfGrid.trusted(lazy, 1.0, extremes=(float(values.min()), float(values.max())))
    one = mesh_grid(balls(), CLOSE, Options(2, mesher="marching"))
    many = mesh_grid(grid, CLOSE, Options(2, mesher="marching"), least_tiles=4)
    assert lazy.most < 0.7 * values.size
    assert len(many.mesh.vertices) == len(one.mesh.vertices)


def test_tiles_can_be_made_elsewhere_in_any_order():
    def elsewhere(make, tasks):
        make = pickle.loads(pickle.dumps(make))
        parts = [make(pickle.loads(pickle.dumps(task))) for task in tasks]
        return reversed([replace(part, worker="far away") for part in parts])

    grid = balls()
    one = mesh_grid(grid, CLOSE, Options(2))
    many = mesh_grid(grid, CLOSE, Options(2), map_tiles=elsewhere, least_tiles=3)
    assert_same(one.mesh, many.mesh)


def spoilt(task, network):
    """Make a tile; the worker of the first one numbers what it shares with others otherwise."""
    part = make_tile(task, network)
    if task.tile.inner_low != (0, 0, 0):
        return replace(part, worker="worker 7")
    return replace(part, keys=part.keys + ~part.mine, worker="worker 3")


@pytest.mark.parametrize("cap", [True, False])
def test_a_tampered_tile_is_an_error_that_names_it(monkeypatch, cap):
    monkeypatch.setattr(pipeline, "make_tile", spoilt)
    said = refusal(MeshError, mesh_grid, balls(), CLOSE, Options(2, cap=cap), least_tiles=3)
    assert said.startswith("the mesh is torn, ") and "in samples 0 to " in said
    assert "(worker 3)" in said and "use workers with the same processor" in said


def test_a_bound_of_memory_chooses_the_tiles(monkeypatch):
    grid, how = balls(), {"factor": 2, "mesher": "marching"}
    one, held = mesh_grid(grid, CLOSE, Options(**how)), 10**8
    monkeypatch.setattr(tiles, "held_memory", lambda: held)
    need = held + tiles.FIXED + 1000 * one.whole.count
    many = mesh_grid(grid, CLOSE, Options(max_memory=need, **how))
    assert many.tiles > 1
    assert_same(one.mesh, many.mesh)
    too_little = Options(max_memory=held + 10, **how)
    said = refusal(OutOfMemoryError, mesh_grid, grid, CLOSE, too_little)
    assert said.startswith("factor 2 on ") and "not even in small tiles" in said
    options, save = Options(max_memory=need, **how), {"save_field": lambda field: None}
    said = refusal(OutOfMemoryError, mesh_grid, grid, CLOSE, options, **save)
    assert "the refined field does not fit in the" in said


def test_a_network_that_sees_the_whole_grid_cannot_be_given_tiles():
    said = refusal(OptionError, mesh_grid, ball(), trilinear, Options(2), least_tiles=2)
    assert "the network states no receptive field" in said


def test_a_large_band_is_predicted_in_runs_of_planes(monkeypatch):
    network, grid = load_network("fast"), balls((60, 20, 20), 12)
    one = reconstruct(grid, network, 2)
    monkeypatch.setattr("super_sdf.refine.prediction.AT_ONCE", 1000)
    many = reconstruct(grid, network, 2)
    np.testing.assert_array_equal(one.vertices, many.vertices)
    np.testing.assert_array_equal(one.faces, many.faces)
