"""Unknown far samples, NaN or infinite: their side, their cut-off, and what is refused."""

import os

import numpy as np
import pytest
import trimesh
from conftest import refusal, trilinear
from skimage.measure import marching_cubes
from solids import box_distance
from test_field_kinds import PLACE, box, thin_frame
from trimesh import grouping

from super_sdf import make_grid, reconstruct
from super_sdf.errors import GridError
from super_sdf.grid.look import beside_surface
from super_sdf.options import OPTIONS


def truncated(cut: float = 2.0) -> np.ndarray:
    """Return distances to a box, clipped."""
    return np.clip(box(), -cut, cut).astype(np.float32)


@pytest.mark.parametrize("hollow", [np.nan, -np.inf])
def test_unknown_far_samples_are_taken_as_cut_off_on_their_side(hollow):
    known = truncated()
    values = known.copy()
    values[known >= 2], values[known <= -2] = np.inf, hollow
    grid = make_grid(values, **PLACE)
    limits = known[np.abs(known) < 2].min(), known[np.abs(known) < 2].max()
    np.testing.assert_array_equal(grid.values, np.clip(known, *limits))
    inner, outer = (known <= -2).sum(), (known >= 2).sum()
    assert grid.notes[0] == (
        f"{inner + outer:,} samples are unknown, of which 0 without a number lie on the positive "
        f"side: they are taken as truncated at {limits[0]:.6g} and {limits[1]:.6g}"
    )
    assert grid.field.kind == "distance" and reconstruct(grid, trilinear).is_closed()


def split() -> np.ndarray:
    """Return distances that are unknown in a slot through the surface."""
    values = truncated()
    values[14:17, :, 20] = np.nan
    return values


def test_an_unknown_region_between_inside_and_outside_cannot_be_closed():
    grid = make_grid(split(), **PLACE)
    assert grid.notes[1] == (
        "96 of the unknown samples are in regions that touch both sides of the surface: it is open "
        "there"
    )
    assert refusal(GridError, reconstruct, grid, trilinear) == (
        "96 samples are unknown, values[14, 0, 20] the first, in regions that touch samples on "
        "both sides of the surface, so whether they are inside is unknown; end the surface there "
        "(cap=False), or replace each by a distance of the right sign (the cut-off value of its "
        "side)"
    )


def cells(known: np.ndarray) -> np.ndarray:
    """Return which cells have eight known samples."""
    for axis in range(3):
        lines = np.moveaxis(known, axis, 0)
        known = np.moveaxis(lines[1:] & lines[:-1], 0, axis)
    return known


def half_seen(seen: float = 9) -> np.ndarray:
    """Return distances to a ball that are known between two planes."""
    off = np.indices((28,) * 3) - np.array([13.6, 13.3, 13.8])[:, None, None, None]
    return np.where(np.abs(off[0]) > seen, np.nan, np.linalg.norm(off, axis=0) - 10.8)


@pytest.mark.parametrize("mesher", ["marching", "sharp"])
@pytest.mark.parametrize("make", [split, half_seen])
def test_the_surface_ends_where_that_of_marching_cubes_of_the_known_cells_does(make, mesher):
    values = make()
    grid, known = make_grid(values, **PLACE), ~np.isnan(values)
    mesh = reconstruct(grid, trilinear, mesher=mesher, cap=False)
    corners, faces = marching_cubes(np.where(known, values, 1), 0)[:2]
    faces = faces[cells(known)[tuple(corners[faces].mean(1).astype(int).T)]]
    want, found = trimesh.Trimesh(corners, faces), trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert len(found.vertices) == len(mesh.vertices) == mesh.faces.max() + 1
    assert cells(known)[tuple(found.triangles_center.astype(int).T)].all()
    edges = [grouping.group_rows(m.edges_sorted, require_count=1) for m in (found, want)]
    ends = [m.edges_sorted[e] for m, e in zip((found, want), edges)]
    lengths = [
        np.linalg.norm(np.diff(m.vertices[e], axis=1)[:, 0], axis=1).sum()
        for m, e in zip((found, want), ends)
    ]
    assert found.area == pytest.approx(want.area, rel=0.03)
    assert lengths[0] == pytest.approx(lengths[1], rel=0.04)


def test_what_needs_the_whole_surface_is_refused(folder, command):
    np.save("seen.npy", half_seen())
    run = ["upsample", "seen.npy", "out.ply", "--spacing", 1, "--factor", 2, "--quality", "fast"]
    whole = "so whether they are inside is unknown; end the surface there (--open)"
    field = (
        "Error: samples beside the surface are unknown, so it is open there: write the mesh alone, "
        "without its field"
    )
    for options, message in (((), whole), (("--open", "--save-field", "f.npz"), field)):
        code, _, err = command(*run, *options)
        assert code == 1 and message in err and err.count("\n") == 1
        assert os.listdir() == ["seen.npy"]
    code, _, err = command(*run, "--open")
    assert code == 0 and not trimesh.load("out.ply").is_watertight
    assert "Warning: the surface ends where samples are unknown, and is open there\n" in err


def test_unequal_spacings_of_distances_that_end_need_the_spline():
    values = half_seen()[:, :, ::2]
    grid = make_grid(values, spacing=(1, 1, 2), origin=0)
    with pytest.raises(GridError, match=r"mesh the spline of the values \(field='smooth'\)$"):
        reconstruct(grid, trilinear, cap=False)
    scaled = make_grid(values, spacing=(1, 1, 2), origin=0, field="smooth")
    mesh = reconstruct(scaled, trilinear, cap=False)
    off = np.linalg.norm(mesh.vertices - np.array([13.6, 13.3, 13.8]), axis=1) - 10.8
    assert np.abs(off).mean() < 0.05 and np.abs(mesh.vertices[:, 0] - 13.6).max() < 9


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_an_infinite_sample_beside_the_other_side_is_as_unknown_as_nan():
    values = truncated()
    values[values == values.max()] = np.inf
    at = np.argwhere(beside_surface(values))[::40]
    values[tuple(at.T)] = np.copysign(np.inf, values[tuple(at.T)])
    grid = make_grid(values, **PLACE)
    values[tuple(at.T)] = np.nan
    want = make_grid(values, **PLACE)
    np.testing.assert_array_equal(grid.values, want.values)
    np.testing.assert_array_equal(grid.field.unseen, want.field.unseen)


def test_whole_numbers_may_stand_for_unknown_ones():
    values = np.where(np.abs(box()) > 3, -500, np.rint(20 * box())).astype(np.int16)
    grid = make_grid(values, **PLACE, scale=0.05)
    assert "samples are exactly -25, where no distance is" in grid.notes[0]
    assert reconstruct(grid, trilinear).is_closed()


@pytest.mark.parametrize("field", OPTIONS["field"].kind.choices[1:])
def test_fields_of_all_kinds_have_unknown_samples(field):
    known = truncated(4.0)
    values = np.where(np.abs(known) < 4, known, np.nan)
    want, grid = (make_grid(v, **PLACE, field=field) for v in (known, values))
    mesh, same = (reconstruct(g, trilinear) for g in (grid, want))
    assert grid.field.kind == field and mesh.is_closed()
    assert mesh.volume() == pytest.approx(same.volume(), rel=1e-3)


@pytest.mark.parametrize("value", [0, 1, -1000, 255, 1e10])
def test_a_value_where_nothing_was_seen_is_told_by_its_jumps(value):
    distances = np.linalg.norm(np.indices((28,) * 3).T - 13.3, axis=-1) - 8.2
    far = np.abs(distances) >= 3.2
    values = np.where(far, value, distances).astype(np.float32)
    grid = make_grid(values, **PLACE)
    assert f"samples are exactly {value:g}, where no distance is: they are taken" in grid.notes[0]
    want = make_grid(np.where(far, np.nan, distances).astype(np.float32), **PLACE)
    np.testing.assert_array_equal(grid.values, want.values)
    mesh, same = (reconstruct(g, trilinear) for g in (grid, want))
    assert mesh.volume() == pytest.approx(same.volume(), rel=1e-3)


@pytest.mark.parametrize(
    "values",
    [
        np.pad(np.clip(box(), -3, 3), 3),
        np.where(box() > 1.5, 0, np.clip(box(), -1.5, 1.5)),
        np.where(box() > 6, -1000, np.clip(box(), -4, 4)),
    ],
    ids=["padded", "unseen", "beyond samples that are cut off"],
)
def test_what_stands_for_nothing_among_distances_is_no_surface(values):
    mesh = reconstruct(make_grid(values, **PLACE), trilinear)
    want = reconstruct(make_grid(np.clip(box(), -1.5, 1.5), **PLACE), trilinear)
    assert mesh.is_closed() and mesh.volume() == pytest.approx(want.volume(), rel=0.01)


NOT_SEEN = {
    "value": lambda x, unseen: {"values": np.where(unseen, 255, 2 * x), "label": 2, "unknown": 255},
    "NaN": lambda x, unseen: {"values": np.where(unseen, np.nan, 2 * x), "label": 2},
    "masked": lambda x, unseen: {"values": np.ma.array(x, mask=unseen)},
    "two": lambda x, unseen: {"values": np.where(unseen, np.nan, np.where(x, 0.7, 0.3))},
    "level": lambda x, unseen: {"values": np.where(unseen, np.nan, x), "level": 0.5},
}


@pytest.mark.parametrize("way", NOT_SEEN)
def test_unknown_samples_of_masks_and_labels_are_on_the_side_round_them(way):
    solid = box() < 0
    for unseen in (box() < -2, box() > 2):
        assert ((make_grid(**NOT_SEEN[way](solid, unseen), **PLACE).values < 0) == solid).all()
    grid = make_grid(**NOT_SEEN[way](solid, np.isnan(split())), **PLACE)
    assert "end the surface there" in refusal(GridError, reconstruct, grid, trilinear)


@pytest.mark.parametrize("cut", [0.2, 1, 3])
@pytest.mark.parametrize("make", [box, thin_frame])
def test_values_that_are_cut_off_were_seen(cut, make):
    random = np.random.default_rng(0).normal(size=(32,) * 3)
    for low, noise in ((-cut, 0), (-2 * cut, 0.05)):
        grid = make_grid(np.clip(make() + noise * random, low, cut), **PLACE)
        assert not any("exactly" in note for note in grid.notes)


@pytest.mark.parametrize("half", [0.6, 0.9, 1.3])
def test_flat_ground_of_a_thin_plate_was_seen_where_values_level_off(half):
    distances = box_distance(np.indices((32,) * 3).T - 15.5, [11, 11, half])
    grid = make_grid(2 * np.tanh(distances / 2), **PLACE)
    assert not any("exactly" in note for note in grid.notes)


def fused(cut: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what twelve depth images say of two balls, over the cut-off, and how many saw it.

    The distance is that along the line of sight.
    """
    at = np.moveaxis(np.indices((32,) * 3) - 15.7, 0, -1)
    total, count = np.zeros((32,) * 3), np.zeros((32,) * 3)
    for sight in trimesh.creation.icosahedron().vertices:
        top = np.full(count.shape, -np.inf)
        for centre, radius in (((-4, 0, 0), 6.2), ((5.5, 1, 2), 4.1)):
            aside = np.linalg.norm(np.cross(at - centre, sight), axis=-1)
            height = np.sqrt(np.maximum(radius**2 - aside**2, 0)) + np.dot(centre, sight)
            top = np.where(aside < radius, np.maximum(top, height), top)
        ahead = at @ sight - top
        seen = ahead > -cut
        total += np.where(seen, np.minimum(ahead / cut, 1), 0)
        count += seen
    return np.divide(total, count, out=np.ones_like(total), where=count > 0), count


@pytest.mark.parametrize("unseen, scale", [(-1, 1), (np.nan, 3), (0, 32767), (-1000, 1)])
def test_fused_depth_images_are_meshed_by_their_spline(unseen, scale):
    values, count = fused(3.0)
    values = np.where(count > 0, values, unseen) * scale
    if scale > 3 and np.isfinite(values).all() and unseen != -1000:
        values = np.rint(values).astype(np.int16)
    grid = make_grid(values, **PLACE)
    assert grid.field.kind == "smooth" and grid.field.has_jumps
    assert reconstruct(grid, trilinear, 2).is_closed()


@pytest.mark.filterwarnings("error")
def test_a_small_solid_in_a_large_truncated_grid_is_read_without_warnings():
    x, y, z = np.indices((160, 160, 160), dtype=np.float32)
    away = np.sqrt((x - 53.6) ** 2 + (y - 80) ** 2 + (z - 80.4) ** 2) - 3
    assert make_grid(np.clip(away, -3, 3), spacing=1.0, origin=0.0).field.kind == "distance"
