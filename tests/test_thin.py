"""Solids thinner than the spacing, in which no sample lies, and what only looks like one."""

import json

import numpy as np
import pytest
import trimesh
from conftest import ball, refusal
from solids import box_distance

from super_sdf.errors import GridError
from super_sdf.grid.sdf_grid import make_grid

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
DENSITY = "they look like densities: give the level of their surface, such as level="
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
