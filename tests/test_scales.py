"""Units, number types and signs change nothing; what no number holds is refused; no warnings."""

import numpy as np
import pytest
from conftest import ball, refusal, trilinear, walled
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from super_sdf import Mesh, make_grid, reconstruct
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
        assert said.endswith("in a unit in which it is between 1e-60 and 1e+60")


@pytest.mark.parametrize("spacing, origin", [(1e-50, 1e-30), (1.0, 1e13), (1e50, 1e300)])
def test_an_origin_too_far_for_the_spacing_is_refused(spacing, origin):
    grid = make_grid(ball(12, 3.0).values.astype(float) * spacing, spacing=spacing, origin=origin)
    assert refusal(GridError, reconstruct, grid, trilinear, 2) == (
        f"the grid reaches to {origin + 12 * spacing:.6g}, too far from the origin for its "
        f"spacing, {spacing:g}: vertices could not be told apart; give a nearer origin"
    )
