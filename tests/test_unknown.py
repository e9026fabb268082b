"""Unknown far samples, NaN or infinite: their side, their cut-off, and what is refused."""

import numpy as np
import pytest
from conftest import trilinear
from scipy import ndimage
from test_field_kinds import PLACE, box

from super_sdf import SdfGrid, make_grid, read_grid, reconstruct
from super_sdf.errors import GridError
from super_sdf.grid.unknown import Regions, components, filled

FACES = ndimage.generate_binary_structure(3, 1)


def truncated(cut: float = 2.0) -> np.ndarray:
    """Return distances to a box, clipped."""
    return np.clip(box(), -cut, cut).astype(np.float32)


def test_the_sides_of_regions_are_those_of_scipys_components():
    random = np.random.default_rng(0)
    for _ in range(30):
        values = random.normal(size=(6, 7, 8))
        values[random.random(values.shape) < random.uniform(0.2, 0.9)] = np.nan
        unknown, regions = np.isnan(values), Regions(values)
        labels = ndimage.label(unknown)[0]
        for found, side in ((regions.positive, values > 0), (regions.negative, values <= 0)):
            beside = labels[ndimage.binary_dilation(side, FACES) & unknown]
            want = np.isin(labels, beside)
            for i in range(len(values)):
                runs = regions.runs_of(i, unknown[i])
                np.testing.assert_array_equal(found[runs[unknown[i]]], want[i][unknown[i]])
        assert regions.size.sum() == unknown.sum()


def test_components_join_whatever_the_order_of_the_pairs():
    chain = np.array([[5, 3, 9, 1], [3, 9, 1, 7]])
    np.testing.assert_array_equal(components(10, chain), [0, 1, 2, 1, 4, 1, 6, 1, 8, 1])


@pytest.mark.parametrize("hollow", [np.nan, -np.inf])
def test_unknown_far_samples_are_taken_as_cut_off_on_their_side(hollow):
    known = truncated()
    values = known.copy()
    values[known >= 2], values[known <= -2] = np.inf, hollow
    grid = make_grid(values, **PLACE)
    limits = known[np.abs(known) < 2].min(), known[np.abs(known) < 2].max()
    np.testing.assert_array_equal(grid.values, np.clip(known, *limits))
    inner, outer = (known <= -2).sum(), (known >= 2).sum()
    nans, infinite = (inner, outer) if np.isnan(hollow) else (0, inner + outer)
    assert grid.notes[0] == (
        f"{inner + outer:,} samples are unknown ({nans:,} NaN, of which 0 lie on the positive "
        f"side, and {infinite:,} infinite): they are taken as cut off at {limits[0]:.6g} and "
        f"{limits[1]:.6g}"
    )
    assert grid.field.kind == "truncated" and reconstruct(grid, trilinear).is_closed()


def test_the_mesh_is_that_of_the_grid_that_was_filled_in_by_hand(tmp_path):
    known = truncated()
    unknown = np.abs(known) >= 2
    by_hand = np.clip(known, known[~unknown].min(), known[~unknown].max())
    np.save(tmp_path / "grid.npy", np.where(unknown, np.nan, known))
    grid = read_grid(tmp_path / "grid.npy", spacing=1.0, origin=0.0)
    np.testing.assert_array_equal(grid.planes(9, 12), by_hand[9:12])
    mesh, want = (reconstruct(g, trilinear) for g in (grid, make_grid(by_hand, **PLACE)))
    np.testing.assert_array_equal(mesh.vertices, want.vertices)


def test_densities_may_be_unknown_outside_what_was_seen():
    densities = 100 - 10 * truncated()
    seen = densities.copy()
    seen[:2] = np.nan
    want, grid = (make_grid(v, **PLACE, level=100) for v in (densities, seen))
    np.testing.assert_array_equal(grid.values, want.values)


def test_an_unknown_region_between_inside_and_outside_is_refused():
    values = truncated()
    values[14:17, :, 20] = np.nan
    with pytest.raises(GridError) as caught:
        make_grid(values, **PLACE)
    assert str(caught.value) == (
        "96 samples are NaN, values[14, 0, 20] the first, in regions that touch samples on both "
        "sides of the surface, so whether they are inside is unknown; replace each by a distance "
        "of the right sign (the cut-off value of its side)"
    )


def test_an_infinite_sample_beside_the_surface_is_refused():
    values = truncated()
    values[values < 0] = -np.inf
    with pytest.raises(GridError) as caught:
        make_grid(values, **PLACE)
    beside = (values < 0) & ndimage.binary_dilation(values > 0, FACES)
    first = ", ".join(map(str, np.argwhere(beside)[0]))
    assert str(caught.value) == (
        f"values[{first}] is -inf, and a sample beside it has the other sign, as at "
        f"{beside.sum():,} infinite samples: where the surface passes between them is unknown; "
        "replace each by a distance of the right sign (the cut-off value of its side)"
    )


@pytest.mark.parametrize("field", ["exact", "mask", "scaled", "noisy"])
def test_only_truncated_fields_have_unknown_samples(field):
    values = truncated()
    values[0, 1, 2] = np.nan
    for make in (lambda: make_grid(values, **PLACE, field=field), lambda: SdfGrid(values, 1.0)):
        with pytest.raises(GridError, match=r"^values\[0, 1, 2\] is nan: every sample must be"):
            make()


def test_filling_in_reads_planes_one_by_one():
    values = truncated()
    values[0] = np.nan
    notes: list[str] = []
    planes, extremes = filled(values, notes)
    assert planes.shape == values.shape and extremes == (-2, 2)
    assert (planes[0] == 2).all() and np.isnan(values[0]).all()
