"""What an array shows: spacing, sign, and what it is not."""

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import refusal

from super_sdf.errors import GridError
from super_sdf.grid.sdf_grid import make_grid


def torus(n: int, unit: float = 1.0) -> np.ndarray:
    """A torus in [-1/2, 1/2]^3, sampled at the n^3 voxel centres, distances times unit."""
    x, y, z = (np.indices((n, n, n)) + 0.5) / n - 0.5
    return (np.hypot(np.hypot(x, y) - 0.28, z) - 0.11) * unit


@pytest.mark.parametrize("unit", [64.0, 10.0])
def test_exact_distances_show_their_spacing(unit):
    grid = make_grid(torus(64, unit))
    assert grid.spacing == pytest.approx((unit / 64,) * 3, rel=0.003)
    assert f"spacing not given: estimated as {grid.spacing[0]:.6g} from the values" in grid.notes[0]


FAR = np.abs(torus(8))
AXES = "give three axes (x, y, z), with at least 2 samples on each"
REFUSED = {
    "every value is 3: a constant field has no surface": np.full((4, 4, 4), 3.0),
    "no value is below 0 (the smallest is 0.5): they look like densities: give the level of their "
    "surface, such as level=0.8, inside='positive'": FAR + 0.5 - FAR.min(),
    "no value is above 0 (the largest is -1): they look like densities: give the level of their "
    "surface, such as level=-3.5, inside='positive'": (-1 - np.indices((3, 3, 3)).sum(0)),
    "every value is False: a constant field has no surface": np.zeros((5, 5, 5), bool),
    "no value is finite: there is no surface": np.full((3, 3, 3), np.nan),
    f"values have shape (4, 4): {AXES}": np.zeros((4, 4)),
    f"values have shape (4, 1, 4): {AXES}": np.zeros((4, 1, 4)),
    f"values have shape (nan, 4, 4): {AXES}": SimpleNamespace(
        shape=(np.nan, 4, 4), dtype=np.dtype(float), chunks=((np.nan,), (4,), (4,))
    ),
    "the largest value is 1e+200: if it stands for unknown ones, unknown=9.9999999999999997e+199, "
    "else multiply them, scale=": np.where(FAR > 0.1, 1e200, -1.0),
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
