"""Surfaces at an offset: closed forms, the sign of the solid, and how far distances reach."""

import numpy as np
import pytest
from conftest import refusal
from solids import box_distance

from super_sdf import make_grid, reconstruct
from super_sdf.errors import GridError

SIDE = 8.6


def cube(unit: float = 1.0) -> np.ndarray:
    """Return exact distances to a cube of side 8.6 units in a grid of spacing 1 unit."""
    return box_distance(np.moveaxis(np.indices((22,) * 3), 0, -1) - 10.37, SIDE / 2) * unit


def cube_volume(offset: float) -> float:
    """Return the volume at an offset: outwards by Steiner's formula, inwards a smaller cube."""
    if offset < 0:
        return (SIDE + 2 * offset) ** 3
    ball = 4 / 3 * np.pi * offset**3
    return SIDE**3 + 6 * SIDE**2 * offset + 3 * np.pi * SIDE * offset**2 + ball


@pytest.mark.parametrize("offset", [-2.0, 0.5, 3.0])
@pytest.mark.parametrize("sign", [1, -1])
def test_an_offset_grows_the_solid_whichever_sign_its_inside_has(fast, offset, sign):
    grid = make_grid(sign * cube(0.5), spacing=0.5, origin=0)
    mesh = reconstruct(grid, fast, 2, offset=0.5 * offset)
    assert mesh.is_closed()
    assert mesh.volume() == pytest.approx(cube_volume(offset) / 8, rel=0.02)


@pytest.mark.parametrize(
    "sign, offset, reason",
    [
        (1, 1.51, "they end at 3: the farthest that works is 1.5"),
        (-1, 4.0, "they end at 3: the farthest that works is 1.5"),
        (1, -2.9, "they end at -3: the farthest that works is -1.5"),
    ],
)
def test_an_offset_near_the_truncation_is_refused_with_one_that_works(fast, sign, offset, reason):
    grid = make_grid(sign * np.clip(cube() - 1.5, -3, 3), spacing=1)  # truncated on both sides
    needs = f"offset {offset:g} needs distances 1.5 spacings (1.5) to either side of it"
    said = refusal(GridError, reconstruct, grid, fast, 2, offset=offset)
    assert said == f"{needs}, but {reason}"


def test_the_suggested_offset_works(fast):
    for scale in (1.0, 0.1, 1 / 3, 1e-5):
        grid = make_grid(np.clip(cube(scale), -3 * scale, 3 * scale), spacing=scale)
        largest = float(
            refusal(GridError, reconstruct, grid, fast, 2, offset=2.2 * scale).split()[-1]
        )
        mesh = reconstruct(grid, fast, 2, offset=largest)
        assert mesh.volume() == pytest.approx(cube_volume(1.5) * scale**3, rel=0.02)


def test_truncated_distances_are_filled_in_for_an_offset(fast):
    grid = make_grid(np.clip(cube(), -1, 1), spacing=1)
    for offset in (-0.3, 0.4, 0.8):
        mesh = reconstruct(grid, fast, 2, offset=offset)
        assert mesh.volume() == pytest.approx(cube_volume(offset), rel=0.01)


@pytest.mark.parametrize("fill", [3, 1000])
def test_an_offset_beyond_all_values_has_no_surface(fast, fill):
    values = np.where(np.abs(cube()) > 3, np.copysign(fill, cube()), cube())
    near = values[np.abs(values) < 3]
    with pytest.raises(GridError) as caught:
        reconstruct(make_grid(values, spacing=1), fast, 2, offset=99)
    ends = "-3 to 3" if fill == 3 else f"{near.min():.6g} to {near.max():.6g}"
    assert str(caught.value) == f"no surface at 99: the values go from {ends}"
