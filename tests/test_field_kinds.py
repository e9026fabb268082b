"""What the values of a grid are, and what becomes of masks, densities and smooth fields."""

import re
from functools import partial
from itertools import product

import numpy as np
import pytest
import trimesh
from conftest import refusal, trilinear
from scipy import ndimage
from solids import box_distance

from super_sdf import make_grid, reconstruct
from super_sdf.errors import GridError
from super_sdf.grid import derived, look, samples
from super_sdf.grid.sdf_grid import crop
from super_sdf.options import OPTIONS

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
    return n * box_distance(np.moveaxis(turned, 0, -1), [0.33, 0.21, 0.17])


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


def cube(at: float, n: int = 32) -> np.ndarray:
    """Return distances to a cube whose middle is at a place along x, in voxels."""
    x, y, z = lattice(n)
    return n * box_distance(np.stack([x - at, y, z], -1), 0.2)


def thin_frame() -> np.ndarray:
    """Return distances to walls, 1.4 voxels thick: few samples are smooth as far as the next."""
    return np.abs(box()) - 0.7


def gyroid(period: float, shift: float, over_slope: bool) -> np.ndarray:
    """Return a gyroid whose cells are that many samples wide, also over its slope."""
    x, y, z = (np.indices((32,) * 3) + shift) * (2 * np.pi / period)
    values = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x) - 0.3
    return values / np.linalg.norm(np.gradient(values), axis=0) if over_slope else values


MASK = torus() < 0
OUT, INTO = (ndimage.distance_transform_edt(side) for side in (~MASK, MASK))
TRANSFORMS = {"both sides": OUT - INTO, "inside only": INTO, "in other units": 0.37 * (OUT - INTO)}
CHESS, CITY = (partial(ndimage.distance_transform_cdt, metric=m) for m in ("chessboard", "taxicab"))
WAVES = 1 + 0.5 * np.sin(4 * np.pi * sum(lattice(32)))
NORMAL, PERIODS = np.random.default_rng(0).normal(size=(32,) * 3), (8, 10, 12, 16, 25.3)
KINDS = {
    "a torus": (torus(), "distance"),
    "a torus of 16^3": (torus(16), "distance"),
    "a box": (box(), "distance"),
    "a box along the axes, half-way between samples": (
        np.abs(np.indices((24, 24, 24)) - 11.5).max(0) - 6,
        "distance",
    ),
    "a plane half-way between samples": (np.indices((12, 12, 12))[0] - 5.5, "distance"),
    "two balls": (np.minimum(torus(), box()), "distance"),
    "a wall": (thin_frame(), "distance"),
    "cut off at 1": (np.clip(box(), -1, 1), "distance"),
    "cut off unevenly": (np.clip(box(), -1, 2.5), "distance"),
    "cut off at 0.5": (np.clip(box(), -0.5, 0.5), "distance"),
    "unknown beyond 2": (np.where(np.abs(torus()) > 2, np.nan, torus()), "distance"),
    "rounded to tenths": (np.rint(10 * box()) / 10, "distance"),
    "rounded to whole numbers": (np.rint(torus()), "noisy"),
    "the whole part": (np.trunc(torus()), "noisy"),
    "the whole part of halves": (np.trunc(2 * torus()) / 2, "noisy"),
    "noise": (noisy(box()), "noisy"),
    "little noise": (noisy(box(), 0.05), "noisy"),
    "a ball of 8^3": (8 * np.linalg.norm(lattice(8), axis=0) - 2.7, "smooth"),
    "an ellipsoid's polynomial": (ellipsoid() * 32 / 14, "smooth"),
    "a smooth union": (smooth_union(), "smooth"),
    "tanh": (2 * np.tanh(box() / 2), "smooth"),
    "steeper from place to place": (box() * WAVES, "smooth"),
    "thin, and steeper from place to place": (thin_frame() * WAVES, "smooth"),
    "touching cubes, aside": (np.minimum(cube(0.21), cube(-0.19)), "smooth"),
    "blurred steps of a thousand": (650 * np.tanh(-box()) - 350 + 20 * NORMAL, "smooth"),
    **{f"a gyroid: {x}": (gyroid(*x), "smooth") for x in product(PERIODS, (0, 0.5), (0, 1))},
    "truth": (MASK, "mask"),
    "255": (MASK * np.uint8(255), "mask"),
    "signs": (np.where(MASK, -1.0, 1.0), "mask"),
    "chessboard, 0 inside": (CHESS(~MASK) - np.maximum(CHESS(MASK) - 1, 0), "mask"),
    "city-block, 0 outside": (np.maximum(CITY(~MASK) - 1, 0) - CITY(MASK), "mask"),
    **{f"transform: {name}": (values, "mask") for name, values in TRANSFORMS.items()},
}


@pytest.mark.parametrize("name", KINDS)
def test_the_samples_show_what_they_are(name):
    values, kind = KINDS[name]
    inside = "negative" if "plane" in name else "auto"
    grid = make_grid(values, **PLACE, inside=inside)
    assert grid.field.kind == kind and not grid.field.given
    if kind == "mask" and name != "city-block, 0 outside":  # where 0 may be either side
        np.testing.assert_array_equal(grid.values < 0, MASK)
    assert (kind == "distance") == (not any("values taken as" in note for note in grid.notes))


def test_exact_distances_are_passed_on_as_they_are():
    values = torus().astype(np.float32)
    grid = make_grid(values, **PLACE)
    assert grid.samples is values and grid.notes == ()
    assert grid.field.report()["unit"] == pytest.approx(1, abs=0.01)
    assert grid.field.exact == (-np.inf, np.inf) and grid.field.network == "distance"


@pytest.mark.parametrize("unit", [0.01, 0.87, 1.04, 1e-60])
def test_another_unit_than_that_of_the_spacing_is_an_error(unit):
    values = unit * box()
    said = refusal(GridError, make_grid, values, **PLACE)
    scale = float(re.search(r"scale=(\S+) \(or", said).group(1))
    assert scale * unit == pytest.approx(1, rel=0.005)
    told = make_grid(values, **PLACE, scale=scale)
    assert told.notes == () and np.allclose(told.values, box(), rtol=5e-3)
    shown = float(re.search(r"the values show (\S+)\)", said).group(1))
    assert shown == pytest.approx(unit, rel=0.005)
    if unit < 0.1:
        return
    assert make_grid(values, spacing=shown, origin=0).field.kind == "distance"
    assert make_grid(values, **PLACE, field="distance").spacing == (1, 1, 1)


@pytest.mark.parametrize("field", OPTIONS["field"].kind.choices[1:])
def test_the_user_may_overrule_the_evidence(field):
    grid = make_grid(torus(), **PLACE, field=field)
    assert (grid.field.kind, grid.field.given) == (field, True)
    assert reconstruct(grid, trilinear).is_closed()


def test_of_0_and_another_value_the_other_is_inside_even_if_it_fills_the_border():
    rock = ~MASK * np.uint8(1)
    np.testing.assert_array_equal(make_grid(rock, **PLACE).values < 0, ~MASK)


def lesions() -> np.ndarray:
    """Return three small labels in a large image."""
    image = np.zeros((48, 48, 48), np.uint8)
    for label, middle in ((1, (20, 12, 22)), (2, (40, 38, 33)), (3, (30, 41, 21))):
        off = np.indices(image.shape) - np.reshape(middle, (3, 1, 1, 1))
        image[np.linalg.norm(off, axis=0) < 1.9] = label
    return image


def stack() -> np.ndarray:
    """Return two labels in three slices."""
    image = np.zeros((40, 36, 3), np.int16)
    image[10:30, 10:20], image[32:38, 20:30] = 1, 2
    return image


ORGANS = MASK * 2 + (box() < 0)
LABELS = {
    "long": ORGANS.astype(np.int64),
    "with gaps": np.array([0, 7, 100, 117])[ORGANS],
    "one in the other": sum(mask.astype(np.uint8) for mask in (box() < 0, box() < -2.5, box() < 2)),
    "of 64 bits": np.array([0, 2**60 + 1, 2**60 + 2, 2**60 + 3], np.uint64)[ORGANS],
    "small": lesions(),
    "of few slices": stack(),
}


@pytest.mark.parametrize("spacing", [(1, 1, 1), (0.5, 1, 1)])
@pytest.mark.parametrize("name", LABELS)
def test_labels_without_a_choice_are_refused(name, spacing):
    said = refusal(GridError, make_grid, LABELS[name], spacing=spacing, origin=0)
    assert said.startswith("the values look like labels (0, ")
    assert re.search(
        r"choose one with label=\d+, or mesh all with reconstruct_labels\(values\)$", said
    )


@pytest.mark.parametrize(("times", "values"), [(10, cube(0.01)), (2, torus())])
def test_whole_numbers_in_another_unit_are_scaled(times, values):
    """They are neither labels, of which 4 of 6 neighbours are equal, too, nor densities."""
    stored = np.rint(times * values).astype(np.int16)
    said = refusal(GridError, make_grid, stored, **PLACE)
    assert said.startswith("the distances have another unit than the spacing: ")
    scale = float(re.search(r"scale=([.\d]+)", said)[1])
    assert scale == pytest.approx(1 / times, rel=0.1)
    found, exact = make_grid(stored, **PLACE, scale=scale), make_grid(values, **PLACE)
    volume = reconstruct(exact, trilinear).volume()
    assert reconstruct(found, trilinear).volume() == pytest.approx(volume, rel=0.02)


def pieces(mesh) -> list:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).split(only_watertight=False)


@pytest.mark.parametrize("shift", [0, 0.4, 0.5])
def test_touching_solids_are_one_piece(shift):
    at = np.moveaxis(np.indices((33, 27, 27)), 0, -1) - np.array([16 + shift, 13, 13])
    cubes = [box_distance(at - [side * 5.6, 0, 0], 5.6) for side in (-1, 1)]
    mesh = reconstruct(make_grid(np.minimum(*cubes), **PLACE), trilinear)
    assert mesh.is_closed() and len(pieces(mesh)) == 1
    assert mesh.volume() == pytest.approx(2 * 11.2**3, rel=0.02)


def test_no_piece_of_a_spline_is_where_no_sample_is_inside():
    ijk = np.stack(np.indices((32,) * 3), -1)
    noise = ndimage.gaussian_filter(np.random.default_rng(3).normal(size=(32,) * 3), 1.2)
    values = np.exp(-((ijk - 16) ** 2).sum(-1) / 32) + 0.1 * noise / noise.std()
    mesh = reconstruct(make_grid(values, **PLACE, level=0.5), trilinear)
    inside = np.argwhere(values > 0.5)
    for piece in pieces(mesh):
        assert ((inside > piece.bounds[0]) & (inside < piece.bounds[1])).all(1).any()


class Stored(samples.SamplePlanes):
    """An array that is read by planes."""

    def __init__(self, values):
        self.values, self.shape, self.dtype = values, values.shape, values.dtype

    def read(self, first, last):
        return self.values[first:last].copy()


PARTS = ("a box", "cut off at 1", "noise", "a smooth union", "truth", "transform: both sides")


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("whole", [0, 1 << 30])
def test_planes_and_parts_are_taken_as_the_whole_array_is(name, whole, monkeypatch):
    monkeypatch.setattr(look, "SMALL_GRID", whole)
    values, kind = KINDS[name]
    want, grid = (make_grid(array, **PLACE) for array in (values, Stored(values)))
    assert grid.field.kind == kind and grid.notes == want.notes
    assert grid.field.report() == want.field.report()
    np.testing.assert_array_equal(grid.values, want.values)
    part = crop(grid, (3, 9, 14), (21, 24, 32))
    np.testing.assert_array_equal(part.values, want.values[3:21, 9:24, 14:32])
    assert part.origin == (3, 9, 14) and (part.low, part.high) == (want.low, want.high)


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
        ("i8", (2**63 - 1, 0), 2**63, f"0, {2**63 - 1}"),
        ("u1", (44, 0), 300, "0, 44"),
        ("f4", (2**24, 0.5), 2**24 + 1, f"0.5, {2**24}"),
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
    assert grid.notes[0] == "values above 40 are taken as inside (see inside=)"
    np.testing.assert_allclose(grid.values, torus(48), atol=1e-4)
    below = make_grid(-density, **PLACE, level=-40, scale=0.1, inside="negative")
    assert below.notes[0] == "values below -40 are taken as inside (see inside=)"
    np.testing.assert_allclose(below.values, torus(48), atol=1e-4)


def test_densities_have_the_surface_of_their_spline():
    blurred = ndimage.gaussian_filter(MASK.astype(np.float32), 1.5) * 1000
    for densities in (blurred, np.minimum(blurred, 255).astype(np.uint8)):
        grid = make_grid(densities, level=125)
        assert (grid.field.kind, grid.field.network) == ("density", None)
        assert grid.notes[1:] == (
            "spacing not given: taken as 1, since densities show none (give spacing=)",
            "origin not given: sample (0, 0, 0) is at 0, 0, 0",
        )
    two = make_grid(np.where(MASK, 900, 100), **PLACE, level=500)
    np.testing.assert_array_equal(two.values, make_grid(MASK, **PLACE).values)


@pytest.mark.parametrize("padding", [-10.0, -1e6])
@pytest.mark.parametrize("told", [{"level": 0.5, "scale": 2}, {"field": "smooth"}], ids=str)
def test_padding_far_from_all_values_moves_no_surface(padding, told):
    """As round the occupancies of networks: the spline would swing beside it."""
    occupancy = 1 / (1 + np.exp(2 * torus(32))) - (0 if "level" in told else 0.5)
    grid = make_grid(np.pad(occupancy, 2, constant_values=padding), **PLACE, **told)
    assert f"values of {padding:.6g}, far from all others, taken as padding" in grid.notes
    wanted = make_grid(np.pad(occupancy, 2, "edge"), **PLACE, **told)
    inner = (slice(2, -2),) * 3
    np.testing.assert_allclose(grid.values[inner], wanted.values[inner], rtol=1e-6)
    assert grid.high < 9 and grid.field.kind == wanted.field.kind


def test_shares_of_voxels_are_no_steps():
    """Of a block with faces .4 voxels from the samples, each share beside a face is .9 or 0."""
    share = np.clip(15.6 - np.arange(24) + 0.5, 0, 1) - np.clip(6.4 - np.arange(24) + 0.5, 0, 1)
    values = share[:, None, None] * share[:, None] * share
    mesh = reconstruct(make_grid(values, **PLACE, level=0.5), trilinear)
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx(9.2, abs=0.1)


def test_a_mask_shows_no_spacing():
    notes = make_grid(MASK).notes + make_grid(TRANSFORMS["in other units"]).notes
    said = "spacing not given: taken as "
    assert [note[len(said) :] for note in notes if note.startswith(said)] == [
        "1, since a mask shows none (give spacing=)",
        "0.37, the step of the transform",
    ]


@pytest.mark.parametrize("radius", [8, 28])
def test_a_blurred_mask_tells_distances_from_a_ball_without_a_bias(radius):
    side = 2 * radius + 9
    ijk = np.indices((side,) * 3).reshape(3, -1).T
    away = np.linalg.norm(ijk - (radius + np.array([3.6, 4.1, 4.3])), axis=1) - radius
    inside, near = (away < 0).reshape((side,) * 3), np.abs(away) < 0.5
    found = derived.wide_distances(inside, ijk[near])
    off = found - away[near, None]
    assert (np.abs(off).mean(0) < [0.07, 0.04]).all() and (np.abs(off.mean(0)) < 0.015).all()
    np.testing.assert_allclose(derived.wide_distances(~inside, ijk[near]), -found, atol=1e-6)
    own, first = ijk[near][:, 0] >= 2 * derived.BLURRED, derived.BLURRED
    some = derived.wide_distances(inside[first:], ijk[near][own] - [first, 0, 0])
    np.testing.assert_array_equal(some, found[own])


@pytest.mark.parametrize("cavity", [False, True])
def test_the_mask_of_a_ball_is_meshed_within_a_thirtieth_of_a_voxel_without_a_bias(cavity):
    centre, radius = np.array([20.3, 19.8, 20.1]), 14
    away = np.linalg.norm(np.indices((41,) * 3).T - centre, axis=3).T - radius
    mesh = reconstruct((away < 0) ^ cavity, spacing=1.0, origin=(0, 0, 0))
    off = np.linalg.norm(mesh.vertices - centre, axis=1) - radius
    off = off[off < 4]  # not the border of the grid
    assert 0.01 < np.abs(off).mean() < 0.033 and abs(off.mean()) < 0.01


def test_a_smooth_field_of_another_slope_is_that_of_its_spline():
    grid = make_grid(ellipsoid(), **PLACE, field="smooth")
    mesh = reconstruct(grid, lambda *given: -trilinear(*given))  # always wrong
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
    for values, side in ((depth - 1, "above"), (1 - depth, "below")):
        said = refusal(GridError, make_grid, values, **PLACE, field="mask")
        assert said.startswith(f"no value is {side} 0 (") and "give the surface's level" in said


@pytest.mark.parametrize("most", [100, 255])
@pytest.mark.parametrize("width", [1.0, 1.7])
def test_probabilities_in_whole_numbers_are_densities(most, width):
    values = np.rint(most / (1 + np.exp(box() / width))).astype(np.uint8)
    said = refusal(GridError, make_grid, values, **PLACE)
    level = float(re.search(r"level=(\S+),", said).group(1))
    assert "the values look like densities" in said and 0.3 * most < level < 0.7 * most


def test_the_level_is_between_the_plateaus_of_an_image_with_noise():
    noise = np.random.default_rng(0).normal(size=box().shape)
    for outside, inside, size in ((20, 300, 5), (100, 900, 30)):
        values = np.abs(np.where(box() < 0, inside, outside) + size * noise)
        said = refusal(GridError, make_grid, values.astype(np.float32), **PLACE)
        level = float(re.search(r"level=(\S+),", said).group(1))
        assert 0.2 < (level - outside) / (inside - outside) < 0.8


def test_the_surface_of_densities_of_both_signs_may_be_at_0():
    said = refusal(GridError, make_grid, NORMAL**3 + 0.3, **PLACE)
    assert said.endswith(" (or, if the surface is at 0, field='smooth')")


@pytest.mark.parametrize("cut", [1.0, 0.8])
def test_distances_cut_off_near_show_their_spacing(cut):
    grid = make_grid(np.clip(box(), -cut, cut), origin=0)
    assert grid.field.kind == "distance" and grid.spacing == pytest.approx((1, 1, 1), rel=0.03)
    inside_only = make_grid(np.maximum(torus(15), -0.3 * cut), **PLACE)  # few are amid equal ones
    assert inside_only.field.facts["cut"] == [-0.3 * cut]
