"""Units, number types and signs change nothing; what no number holds is refused; no warnings."""

import numpy as np
import pytest
from conftest import ball, refusal, trilinear, walled
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from super_sdf import Mesh, SdfGrid, make_grid, reconstruct
from super_sdf.errors import GridError

pytestmark = pytest.mark.filterwarnings("error")

fields = hnp.arrays(
    np.float32,
    st.tuples(*[st.integers(5, 8)] * 3),
    elements=st.floats(-3, 3, width=16),
    fill=st.nothing(),
)


def mesh_of(values: np.ndarray, spacing: float = 1.0, *, flipped: bool = False) -> Mesh:
    """Refine any values, distances or not, with a stand-in for the network."""
    grid = SdfGrid.trusted(values, spacing, positive_inside=flipped)
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


DTYPES = ["i1", "i8", ">i2", "u1", "u4", "u8", "f2", ">f4", "g"]


@pytest.mark.parametrize("dtype", DTYPES)
def test_whole_numbers_of_any_type_are_the_same_field(dtype):
    values = np.round(4 * ball(14, 4.0).values).astype(np.int8)
    want = make_grid(values, spacing=4)
    if np.dtype(dtype).kind == "u":  # without a sign: thicken by an offset
        values, want = np.abs(values), make_grid(np.abs(values), spacing=4, inside="negative")
    offset = 2 if np.dtype(dtype).kind == "u" else 0
    grid = make_grid(values.astype(dtype), spacing=4, inside="negative")
    one, other = (reconstruct(g, trilinear, 2, offset=offset) for g in (want, grid))
    np.testing.assert_array_equal(one.vertices, other.vertices)
    np.testing.assert_array_equal(one.faces, other.faces)


@pytest.mark.parametrize("far", ["u8", "f2", "f8"])
def test_the_largest_numbers_are_far_away(far):
    values = np.round(10 * ball(12, 3.0).values).astype(far if far[0] == "f" else "i8")
    values[np.abs(values) > 30] = np.finfo(far).max if far[0] == "f" else np.iinfo("i8").max
    values[5, 5, 5] = np.finfo(far).min if far[0] == "f" else np.iinfo("i8").min
    grid = make_grid(-values if far == "u8" else values, spacing=10, origin=0)
    mesh = reconstruct(grid, trilinear, 2)
    assert mesh.is_closed() and mesh.volume() == pytest.approx(4 / 3 * np.pi * 30**3, rel=0.2)


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
        assert said.endswith("in a unit in which it is between 1e-60 and 1e+60")


@pytest.mark.parametrize("spacing, origin", [(1e-50, 1e-30), (1.0, 1e13), (1e50, 1e300)])
def test_an_origin_too_far_for_the_spacing_is_refused(spacing, origin):
    grid = make_grid(ball(12, 3.0).values.astype(float) * spacing, spacing=spacing, origin=origin)
    assert refusal(GridError, reconstruct, grid, trilinear, 2) == (
        f"the grid reaches to {origin + 12 * spacing:.6g}, too far from the origin for its "
        f"spacing, {spacing:g}: vertices could not be told apart; give a nearer origin"
    )


THIN = {
    "a sheet": lambda x, y, z: np.abs(z - 5),
    "a sheet of a tenth": lambda x, y, z: np.abs(z - 5) - 0.1,
    "walls": lambda x, y, z: np.abs(z % 4 - 2) - 0.3,
    "a needle": lambda x, y, z: np.hypot(x - 5, y - 5) - 0.2,
    "a point": lambda x, y, z: np.sqrt((x - 5) ** 2 + (y - 5) ** 2 + (z - 5) ** 2),
    "a dot": lambda x, y, z: np.sqrt((x - 5) ** 2 + (y - 5) ** 2 + (z - 5) ** 2) - 1e-30,
    "alternating": lambda x, y, z: np.where((x + y + z) % 2, 1.0, -1.0) + 1e-3 * x,
}


@pytest.mark.parametrize("shape", THIN)
@pytest.mark.parametrize("spacing", [None, 1.0])
def test_thin_fields_raise_no_warnings(shape, spacing):
    values = THIN[shape](*np.indices((11, 10, 12)).astype(float))
    try:
        grid = make_grid(values, spacing=spacing, inside="negative")
        mesh = reconstruct(grid, trilinear, 2)
    except GridError as error:
        assert "\n" not in str(error)
    else:
        assert mesh.is_closed() and np.isfinite(mesh.vertices).all()
