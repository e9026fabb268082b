"""What the values of a grid are, and what becomes of masks, truncated and scaled fields."""

import numpy as np
import pytest
from conftest import refusal, trilinear
from scipy import ndimage

from super_sdf import SdfGrid, make_grid, reconstruct
from super_sdf.errors import GridError, OptionError
from super_sdf.options import FIELDS

PLACE = {"spacing": 1.0, "origin": 0.0}


def lattice(n: int = 32) -> np.ndarray:
    """Return the coordinates of samples of the unit cube round the origin, (3, n, n, n)."""
    line = (np.arange(n) + 0.5) / n - 0.5
    return np.stack(np.meshgrid(line, line, line, indexing="ij"))


def torus(n: int = 32) -> np.ndarray:
    """Return distances to a torus, in voxels."""
    x, y, z = lattice(n)
    return n * (np.hypot(np.hypot(x, y) - 0.3, z) - 0.12)


def box(n: int = 32) -> np.ndarray:
    """Return distances to a turned box, in voxels."""
    x, y, z = lattice(n)
    turned = np.stack([0.8 * x + 0.6 * y, 0.8 * y - 0.6 * x, z])
    off = np.abs(turned) - np.array([0.33, 0.21, 0.17])[:, None, None, None]
    return n * (np.sqrt((np.maximum(off, 0) ** 2).sum(0)) + np.minimum(off.max(0), 0))


def ellipsoid(n: int = 32) -> np.ndarray:
    """Return a polynomial whose zero set is an ellipsoid; its slope is 5 to 14."""
    x, y, z = lattice(n)
    return (x / 0.4) ** 2 + (y / 0.25) ** 2 + (z / 0.15) ** 2 - 1


def smooth_union(n: int = 48) -> np.ndarray:
    """Return two balls with a smooth joint, in voxels: their slope is less than 1 there."""
    x, y, z = lattice(n)
    one, other = (np.sqrt((x - at) ** 2 + y**2 + z**2) - 0.2 for at in (-0.15, 0.15))
    blend = np.maximum(0.15 - np.abs(one - other), 0) / 0.15
    return n * (np.minimum(one, other) - blend**2 * 0.15 / 4)


def noisy(values: np.ndarray, amplitude: float = 0.25) -> np.ndarray:
    return values + np.random.default_rng(0).uniform(-amplitude, amplitude, values.shape)


def thin_frame() -> np.ndarray:
    """Return distances to walls, 1.4 voxels thick: few samples are smooth as far as the next."""
    return np.abs(box()) - 0.7


MASK = torus() < 0
OUT, INTO = (ndimage.distance_transform_edt(side) for side in (~MASK, MASK))
TRANSFORMS = {"both sides": OUT - INTO, "inside only": INTO, "in other units": 0.37 * (OUT - INTO)}
WAVES = 1 + 0.5 * np.sin(4 * np.pi * sum(lattice(32)))
KINDS = {
    "a torus": (torus(), "exact"),
    "a torus of 16^3": (torus(16), "exact"),
    "a box": (box(), "exact"),
    "a box along the axes, half-way between samples": (
        np.abs(np.indices((24, 24, 24)) - 11.5).max(0) - 6,
        "exact",
    ),
    "a plane half-way between samples": (np.indices((12, 12, 12))[0] - 5.5, "exact"),
    "two balls": (np.minimum(torus(), box()), "exact"),
    "cut off far away": (np.clip(box(), -3.5, 4), "exact"),
    "cut off at 1": (np.clip(box(), -1, 1), "truncated"),
    "cut off unevenly": (np.clip(box(), -1, 2.5), "truncated"),
    "cut off at 0.5": (np.clip(box(), -0.5, 0.5), "truncated"),
    "cut off at 1, in units of that": (np.clip(box() / 2.5, -1, 1), "truncated"),
    "noise": (noisy(box()), "noisy"),
    "little noise": (noisy(box(), 0.02), "exact"),
    "an ellipsoid's polynomial": (ellipsoid() * 32 / 14, "scaled"),
    "a smooth union": (smooth_union(), "scaled"),
    "half as steep": (torus(48) / 2, "exact"),
    "steeper from place to place": (box() * WAVES, "scaled"),
    "thin, and steeper from place to place": (thin_frame() * WAVES, "scaled"),
    "truth": (MASK, "mask"),
    "bytes": (MASK.astype(np.uint8), "mask"),
    "255": (MASK * np.float32(255), "mask"),
    "signs": (np.where(MASK, -1.0, 1.0), "mask"),
    **{f"transform: {name}": (values, "mask") for name, values in TRANSFORMS.items()},
}


@pytest.mark.parametrize("name", KINDS)
def test_the_samples_show_what_they_are(name):
    values, kind = KINDS[name]
    inside = "negative" if "plane" in name else "auto"
    grid = make_grid(values, **PLACE, inside=inside)
    assert grid.field.kind == kind and not grid.field.given
    assert (kind == "exact") == (not any("values taken as" in note for note in grid.notes))


def test_exact_distances_are_passed_on_as_they_are():
    values = torus().astype(np.float32)
    grid = make_grid(values, **PLACE)
    assert grid.samples is values and grid.notes == ()
    assert grid.field.report()["slope"] == pytest.approx(1, abs=0.01)
    assert grid.field.exact == (-np.inf, np.inf)


@pytest.mark.parametrize("unit", [0.01, 0.91, 1.04])
def test_distances_in_another_unit_are_exact_in_that_of_the_spacing(unit):
    values = (unit * box()).astype(np.float32)
    grid = make_grid(values, **PLACE)
    assert np.allclose(grid.values, box(), rtol=3e-3, atol=1e-6)
    assert grid.notes[-1].startswith("the values are distances in another unit: multiplied by ")
    told = make_grid(values, **PLACE, scale=1 / unit)
    assert told.notes == () and np.allclose(told.values, box(), atol=1e-5)


@pytest.mark.parametrize("field", FIELDS[1:])
def test_the_user_may_overrule_the_evidence(field):
    grid = make_grid(torus(), **PLACE, field=field)
    assert (grid.field.kind, grid.field.given) == (field, True)
    assert reconstruct(grid, trilinear).is_closed()


def test_all_forms_of_a_mask_give_the_same_mesh():
    forms = [MASK, MASK.astype(np.uint8), np.where(MASK, -1.0, 1.0), MASK * 7.0]
    forms += TRANSFORMS.values()
    meshes = [reconstruct(make_grid(form, **PLACE), trilinear) for form in forms]
    for mesh in meshes[1:]:
        np.testing.assert_array_equal(mesh.vertices, meshes[0].vertices)
        np.testing.assert_array_equal(mesh.faces, meshes[0].faces)


@pytest.mark.parametrize("spacing", [(1, 1, 1), (0.5, 1, 1)])
@pytest.mark.parametrize("dtype", [np.uint8, np.int64])
def test_labels_without_a_choice_are_refused(dtype, spacing):
    labels = (MASK * 2 + (box() < 0)).astype(dtype)
    for field in ("auto", "exact", "scaled"):
        place = {"spacing": spacing, "origin": 0, "field": field}
        assert refusal(GridError, make_grid, labels, **place) == (
            "no solid is chosen: they look like labels (0, 1, 2, 3): choose one with label=1"
        )


LARGEST = 2**64 - 1


@pytest.mark.parametrize(
    ("dtype", "label", "other"),
    [
        *(("u8", LARGEST, LARGEST - 1), (">u8", 2**63 + 1, 2**63), ("i8", 2**53 + 1, 2**53)),
        *(("i8", -(2**63), 1 - 2**63), ("i1", -1, 1), ("f4", 2**24, 2**24 - 1), ("f8", 3.0, 2)),
        ("?", 1, 0),
    ],
)
def test_labels_are_whole_numbers_of_up_to_64_bits(dtype, label, other):
    labels = np.where(MASK, np.array(label, dtype), np.array(other, dtype))
    grid = make_grid(labels, **PLACE, label=label)
    np.testing.assert_array_equal(grid.values, make_grid(MASK, **PLACE).values)


@pytest.mark.parametrize(
    ("dtype", "values", "label", "listed"),
    [
        ("u8", (LARGEST, 2**53 + 1), LARGEST - 1, f"{2**53 + 1}, {LARGEST}"),
        ("u8", (LARGEST, 0), -1, f"0, {LARGEST}"),
        ("i8", (2**63 - 1, 0), 2**63, f"0, {2**63 - 1}"),
        ("u1", (44, 0), 300, "0, 44"),
        ("f4", (2**24, 0.5), 2**24 + 1, f"0.5, {2**24}"),
        ("f2", (60000, 0), LARGEST, "0, 60000"),
    ],
)
def test_a_label_is_never_rounded(dtype, values, label, listed):
    said = refusal(GridError, make_grid, np.where(MASK, *np.array(values, dtype)), label=label)
    assert said == f"no sample has the label {label}: the labels are {listed}"
    every = refusal(GridError, make_grid, np.full((8, 8, 8), 7), label=7)
    assert every == "every sample has the label 7: the labels are 7"


def test_densities_have_their_surface_at_a_level():
    density = 40 - 10 * torus(48).astype(np.float32)
    grid = make_grid(density, **PLACE, level=40, scale=0.1)
    assert grid.notes[0] == "values above 40 are taken as inside (see --inside)"
    np.testing.assert_allclose(grid.values, torus(48), atol=1e-4)
    below = make_grid(-density, **PLACE, level=-40, scale=0.1, inside="negative")
    assert below.notes[0] == "values below -40 are taken as inside (see --inside)"
    np.testing.assert_allclose(below.values, torus(48), atol=1e-4)


def test_densities_without_a_ramp_are_a_mask():
    steep = MASK * 1000.0 + np.random.default_rng(0).uniform(0, 30, MASK.shape)
    for densities in (steep, np.where(MASK, 900, 100)):
        grid = make_grid(densities, **PLACE, level=500)
        assert grid.field.kind == "mask"
        np.testing.assert_array_equal(grid.values, make_grid(MASK, **PLACE).values)


def test_densities_with_a_ramp_have_the_surface_of_their_spline():
    blurred = ndimage.gaussian_filter(MASK.astype(np.float32), 1.5) * 1000
    grid = make_grid(blurred, level=500)
    assert grid.field.kind == "scaled"
    assert grid.notes[1].startswith("spacing not given: taken as 1, since densities show none")


BAD = {
    "inside is 'out': give one of auto, negative, positive": {"inside": "out"},
    "field is 'wrong': give one of auto, exact, truncated, mask, scaled, noisy": {"field": "wrong"},
    "label is 'a': give a whole number, -2^63 to 2^64 - 1": {"label": "a"},
    "label is 1.5: give a whole number, -2^63 to 2^64 - 1": {"label": 1.5},
    "label is True: give a whole number, -2^63 to 2^64 - 1": {"label": True},
    f"label is {2**64}: give a whole number, -2^63 to 2^64 - 1": {"label": 2**64},
    f"label={2**53 + 1} and level=2.5: give only one of them": {"label": 2**53 + 1, "level": 2.5},
    "level is nan: give a finite number": {"level": float("nan")},
    "scale is -1: give a number greater than 0": {"scale": -1},
    "label=1 and field='exact': the samples of a label are a mask": {"label": 1, "field": "exact"},
}


@pytest.mark.parametrize("message", BAD)
def test_wrong_options_are_refused(message):
    assert refusal(OptionError, make_grid, torus(), **PLACE, **BAD[message]) == message


def test_a_mask_is_no_grid_without_make_grid():
    for values in (MASK, MASK.astype(int)):
        with pytest.raises(GridError, match="a mask holds no distances; make a grid of it with"):
            SdfGrid(values, 1.0)


def test_a_mask_shows_no_spacing_and_one_value_no_surface():
    notes = make_grid(MASK).notes + make_grid(TRANSFORMS["in other units"]).notes
    said = "spacing not given: taken as "
    assert [note[len(said) :] for note in notes if note.startswith(said)] == [
        "1, since a mask shows none (give --spacing)",
        "0.37, the step of the transform",
    ]
    with pytest.raises(GridError, match="every value is False: a constant field has no surface"):
        make_grid(np.zeros((5, 5, 5), bool), **PLACE)


def opposite(patches, table, voxels, offsets):
    """Stand in for a network that is always wrong."""
    return -trilinear(patches, table, voxels, offsets)


def test_a_smooth_field_of_another_slope_is_that_of_its_spline():
    mesh = reconstruct(make_grid(ellipsoid(), **PLACE, field="scaled"), opposite)
    x, y, z = (mesh.vertices.T + 0.5) / 32 - 0.5
    value = (x / 0.4) ** 2 + (y / 0.25) ** 2 + (z / 0.15) ** 2 - 1
    assert np.abs(value).max() < 0.02  # a twentieth of a change from sample to sample


def test_values_on_one_side_of_0_are_a_mask_only_with_zeros():
    depth = np.minimum(box(), 0)
    for values in (depth, -depth):
        grid = make_grid(values, **PLACE, field="mask")
        np.testing.assert_array_equal(grid.values < 0, depth < 0)
    grid = make_grid(depth, **PLACE, field="mask", inside="negative")
    np.testing.assert_array_equal(grid.values < 0, depth < 0)
    for values, side, level in (
        (depth - 1, "below", "-2.39, inside='negative'"),
        (1 - depth, "above", "2.39, inside='positive'"),
    ):
        assert refusal(GridError, make_grid, values, **PLACE, field="mask") == (
            f"every value is {side} 0 (they go from {values.min():.6g} to {values.max():.6g}), so "
            "their signs make no mask: they look like densities: give the level of their surface, "
            f"such as level={level}"
        )
