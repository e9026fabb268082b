"""Units, number types and signs change nothing; what no number holds is refused; no warnings."""

import numpy as np
import pytest
from conftest import ball, refusal, trilinear, walled
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from solids import box_distance

from super_sdf import Mesh, make_grid, reconstruct
from super_sdf.errors import GridError

pytestmark = [
    pytest.mark.filterwarnings("error"),
    pytest.mark.filterwarnings("ignore::super_sdf.errors.SuperSdfWarning"),
]

fields = hnp.arrays(
    np.float32,
    st.tuples(*[st.integers(5, 8)] * 3),
    elements=st.floats(-3, 3, width=16),
    fill=st.nothing(),
)


def mesh_of(values: np.ndarray, spacing: float = 1.0, *, flipped: bool = False) -> Mesh:
    """Refine any values, distances or not, with a stand-in for the network."""
    inside = "positive" if flipped else "negative"
    grid = make_grid(values, spacing=spacing, field="distance", inside=inside)
    return reconstruct(grid, trilinear, 2)


@settings(max_examples=12)
@given(fields, st.integers(-100, 100), st.booleans(), st.sampled_from(["<f4", ">f4", "<f8", "g"]))
def test_any_field_gives_the_same_mesh_in_any_unit_sign_and_type(values, power, flipped, dtype):
    values = walled(values)
    values[2, 2, 2] = -1
    unit = 2.0**power  # 1e-30 to 1e30
    other = (-values if flipped else values).astype(dtype) * np.float32(unit)
    one, scaled = mesh_of(values), mesh_of(other.astype(dtype), unit, flipped=flipped)
    np.testing.assert_array_equal(one.faces, scaled.faces)
    np.testing.assert_array_equal(one.vertices * np.float32(unit), scaled.vertices)
    assert scaled.is_closed() and scaled.volume() > 0


@pytest.mark.parametrize("spacing", [1e-60, 1e-38, 1e37, 1e60])
def test_vertices_are_finite_and_distinct_at_extreme_scales(spacing):
    values = ball(12, 3.0).values.astype(float) * spacing
    mesh = reconstruct(make_grid(values, spacing=spacing), trilinear, 2)
    unit = mesh.vertices.astype(np.float64) / spacing
    want = reconstruct(ball(12, 3.0), trilinear, 2)
    np.testing.assert_allclose(unit, want.vertices, rtol=1e-5)
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
    assert mesh.volume() == pytest.approx(want.volume() * spacing**3, rel=1e-4)


@pytest.mark.parametrize("spacing", [1e-61, 1e61])
def test_scales_beyond_are_refused(spacing):
    values = ball(12, 3.0).values.astype(float) * spacing
    for given_ in (None, spacing):
        said = refusal(GridError, make_grid, values, spacing=given_)
        assert "1e-60" in said and "1e+60" in said


@pytest.mark.parametrize("spacing, origin", [(1e-50, 1e-30), (1.0, 1e13), (1e50, 1e300)])
def test_an_origin_too_far_for_the_spacing_is_refused(spacing, origin):
    grid = make_grid(ball(12, 3.0).values.astype(float) * spacing, spacing=spacing, origin=origin)
    assert refusal(GridError, reconstruct, grid, trilinear, 2) == (
        f"the grid reaches to {origin + 12 * spacing:.6g}, too far from the origin for its "
        f"spacing, {spacing:g}: vertices could not be told apart; give a nearer origin"
    )


# Surfaces at an offset: closed forms, the sign of the solid, and how far distances reach

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


@pytest.mark.parametrize("sign, offset, end", [(1, 1.51, 3), (-1, 4.0, 3), (1, -2.9, -3)])
def test_an_offset_near_the_truncation_is_refused_with_one_that_works(fast, sign, offset, end):
    grid = make_grid(sign * np.clip(cube() - 1.5, -3, 3), spacing=1)  # truncated on both sides
    needs = f"offset {offset:g} needs distances 1.5 spacings (1.5) to either side of it"
    said = refusal(GridError, reconstruct, grid, fast, 2, offset=offset)
    assert said == f"{needs}, but they end at {end}: the farthest that works is {end / 2}"


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
    said = refusal(GridError, reconstruct, make_grid(values, spacing=1), fast, 2, offset=99)
    ends = "-3 to 3" if fill == 3 else f"{near.min():.6g} to {near.max():.6g}"
    assert said == f"no surface at 99: the values go from {ends}"
