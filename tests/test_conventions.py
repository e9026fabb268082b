"""What an array shows: spacing, sign, thin solids, and what it is not."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from conftest import ball, refusal
from solids import box_distance

from super_sdf.errors import GridError
from super_sdf.grid.sdf_grid import make_grid


def torus(n: int, unit: float = 1.0) -> np.ndarray:
    """A torus in [-1/2, 1/2]^3, sampled at the n^3 voxel centres, distances times unit."""
    x, y, z = (np.indices((n, n, n)) + 0.5) / n - 0.5
    return (np.hypot(np.hypot(x, y) - 0.28, z) - 0.11) * unit


@pytest.mark.parametrize("unit", [64.0, 10.0])
def test_exact_distances_show_their_spacing(unit):
    grid, h = make_grid(torus(64, unit)), unit / 64
    assert grid.spacing == pytest.approx((h,) * 3, rel=0.003)
    saturating = 2 * h * np.tanh(torus(64, unit) / (2 * h))
    assert make_grid(saturating).spacing[0] == pytest.approx(h, rel=0.15)
    assert f"spacing not given: estimated as {grid.spacing[0]:.6g} from the values" in grid.notes[0]


FAR = np.abs(torus(8))
AXES = "give three axes (x, y, z), with at least 2 samples on each"
REFUSED = {
    "every value is 3: a constant field has no surface": np.full((4, 4, 4), 3.0),
    "no value is below 0 (the smallest is 0.5): the values look like densities: give the "
    "surface's level, such as level=0.8, inside='positive'": FAR + 0.5 - FAR.min(),
    "no value is above 0 (the largest is -1): the values look like densities: give the "
    "surface's level, such as level=-3.5, inside='positive'": (-1 - np.indices((3, 3, 3)).sum(0)),
    "every value is False: a constant field has no surface": np.zeros((5, 5, 5), bool),
    "no value is finite: there is no surface": np.full((3, 3, 3), np.nan),
    f"values have shape (4, 4): {AXES}": np.zeros((4, 4)),
    f"values have shape (4, 1, 4): {AXES}": np.zeros((4, 1, 4)),
    f"values have shape (nan, 4, 4): {AXES}": SimpleNamespace(
        shape=(np.nan, 4, 4), dtype=np.dtype(float), chunks=((np.nan,), (4,), (4,))
    ),
    "the largest value is 1e+200: if it marks unknown samples, unknown=9.9999999999999997e+199, "
    "else scale the values, scale=": np.where(FAR > 0.1, 1e200, -1.0),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_is_no_signed_distance_grid_is_refused(message):
    assert refusal(GridError, make_grid, REFUSED[message]) == message


LENGTHS = "give lengths from 1e-60 to 1e+60, the largest at most 50 times the smallest"


@pytest.mark.parametrize(
    "spacing, said",
    [
        ((1, 1, 51), f"spacing is 1, 1, 51: {LENGTHS}"),
        (0, f"spacing is 0, 0, 0: {LENGTHS}"),
        (float("nan"), "spacing is nan: it must be finite"),
        ((1, 2), "spacing is (1, 2): give one number or three"),
    ],
)
def test_spacing_must_be_positive_and_finite(spacing, said):
    assert refusal(GridError, make_grid, torus(16), spacing=spacing).startswith(said)


def test_a_spacing_that_the_values_contradict_on_one_axis_is_refused():
    x, y, z = np.abs(np.indices((40, 40, 40)) - 19.4)
    values = np.maximum(x - 12, np.maximum(y - 9, z - 14))[:, :, ::2]  # spacing 1, 1, 2
    refusal(GridError, make_grid, values, spacing=1)
    for each in (2, 1.995):
        assert make_grid(values, spacing=(1, 1, each), origin=0).notes == ()


# Solids thinner than the spacing, in which no sample lies, and what only looks like one

SHELL = "mesh the shell round the surface with inside='negative', offset="
N = 32
X, Y, Z = np.indices((N, N, N)) - 15.5
R = np.sqrt(X**2 + Y**2 + Z**2)


def box(x, y, z, *half):
    """Return the signed distance to a box of half sides."""
    return box_distance(np.stack([x, y, z], -1), half)


THIN = {
    "plate": box(X, Y, Z, 9, 7, 0.25),
    "plate of a sixth": box(X, Y, Z + 0.1, 9, 7, 1 / 12),
    "lying along x": box(X, Y, Z, 0.2, 7, 9),
    "rod": np.hypot(np.hypot(X - 0.1, Y), np.maximum(np.abs(Z) - 9, 0)) - 0.3,
    "two sheets": np.minimum(box(X, Y, Z - 4, 9, 7, 0.3), box(X, Y - 0.5, Z + 5, 6, 9, 0.2)),
    "hollow ball": np.abs(R - 9.2) - 0.05,  # holds samples
    "hollow box": np.abs(box(X, Y, Z, 8, 7, 9)) - 0.4,
}


@pytest.mark.parametrize("name", sorted(set(THIN) - {"hollow ball"}))
@pytest.mark.parametrize("spacing, sign", [(None, 1), (0.1, -1)])
def test_thin_solids_are_told(name, spacing, sign):
    values = THIN[name] * sign * 0.1
    assert (values * sign).min() > 0
    grid = make_grid(values, spacing=spacing, origin=0)
    assert grid.spacing == pytest.approx((0.1,) * 3, rel=0.01)
    assert grid.low > 0


UNSIGNED = {
    "ball": np.abs(R - 9.3),
    "box": np.abs(box(X, Y, Z, 8, 7, 9)),
    "bar": np.abs(box(X, Y, Z + 0.2, 9, 2, 2)),
    "torus": np.abs(np.hypot(np.hypot(X, Y) - 9, Z) - 3.2),
    "two balls": np.abs(np.minimum(R - 5, np.sqrt((X - 11) ** 2 + Y**2 + Z**2) - 3)),
    "rod through the grid": np.abs(np.hypot(X, Y) - 4.4),
    "lower half": np.abs(Z + 3.1),
    "turned box": np.abs(box((X + Y) / 2**0.5, (X - Y) / 2**0.5, Z, 8, 7, 6)),
}
NO_SURFACE = {
    "never near": R + 5,
    "a ball that grew away": R + 0.3,
    "off the border": X + 15.8,
    "a ball beyond the border": np.sqrt((X + 18.5) ** 2 + Y**2 + Z**2) - 2.6,
    "a torus that shrank away": np.hypot(np.hypot(X, Y) - 9, Z) + 0.2,
    "a sheet that shrank away": np.abs(Z) + 0.2,
    "parabola": (R / 8) ** 2 + 0.1,
    "random": np.random.default_rng(0).random((N, N, N)) + 0.01,
    "steps": np.maximum(R - 9, 0) + 0.5,
    "slow": 0.1 * R + 0.05,
}
DENSITY = "the values look like densities: give the surface's level, such as level="
FIELDS = {f"unsigned {name}": values for name, values in UNSIGNED.items()} | NO_SURFACE


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("spacing", [None, 1.0])
def test_what_only_looks_thin_is_refused_in_one_line(name, spacing):
    parts = ("unsigned", "shrank", "grew", "never", "border")
    if any(part in name for part in parts):
        want = SHELL + "1"
    elif name == "slow":
        want = "multiply the values, scale=10" if spacing else SHELL + "0.1"
    else:
        want = DENSITY
    said = refusal(GridError, make_grid, FIELDS[name], spacing=spacing)
    assert said.startswith("no value is below 0 (the smallest is ") and want in said


def test_thin_solids_alone_are_meshed_with_a_warning(folder, command):
    np.save("thin.npy", THIN["plate"])
    np.save("ball.npy", ball().values)
    code, out, err = command("upsample", "thin.npy", "a.ply", "--json")
    report = json.loads(out)
    assert code == 0 and report["closed"] and trimesh.load("a.ply").is_watertight
    (warning,) = report["warnings"]
    assert warning == (
        "no sample lies inside: the solid is thinner than the spacing, and its mesh may have holes"
    )
    assert f"Warning: {warning}" in err
    assert json.loads(command("upsample", "ball.npy", "b.ply", "--json")[1])["warnings"] == []


@pytest.mark.parametrize("options", [{}, {"scale": 0.08}, {"inside": "negative"}])
@pytest.mark.parametrize("width", [0.3, 1.0])
def test_the_level_that_is_named_for_densities_is_one_of_the_values(width, options):
    steps = np.indices((28, 28, 28)) - np.reshape([15.0, 14.6, 14.3], (3, 1, 1, 1))
    values = 1 / (1 + np.exp((np.linalg.norm(steps, axis=0) - 8) / width))
    with pytest.raises(GridError, match=rf"{DENSITY}0\.5, inside='positive'"):
        make_grid(values, spacing=1.0, **options)
