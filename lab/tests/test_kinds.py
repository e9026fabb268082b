"""Grids that are not exact distances: how they are made, meshed, measured and tabled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from solids import cube

from lab.kinds import BY_METHOD, KINDS, level_set, samples_of
from lab.measuring import Task
from lab.shapes import Case, Setting, Shape, normalise
from super_sdf import load_network

SIDE = 3**-0.5  # of the cube whose box diagonal is 1
CUBIC = [name for name, kind in KINDS.items() if kind.ratio == 1]
TASK = Task(Path(), Setting(16), (), "fast")


def mesh_of(name, case, network):
    method, _, kind = name.partition(" on ")
    return BY_METHOD[method](KINDS[kind], case, network)


@pytest.fixture(scope="module")
def case() -> Case:
    return Case(Shape("box", normalise(cube())), Setting(16))


@pytest.fixture(scope="module")
def fast():
    return load_network("fast", device="cpu")


def values_of(name: str, case: Case) -> np.ndarray:
    return samples_of(KINDS[name], case)[0]


def box_distance(points: np.ndarray) -> np.ndarray:
    """Return the distance to the cube, by its closed form."""
    off = np.abs(points) - SIDE / 2
    return np.linalg.norm(np.maximum(off, 0), axis=-1) + np.minimum(off.max(-1), 0)


@pytest.mark.parametrize("name", CUBIC)
def test_a_kind_keeps_the_side_of_every_sample(name, case):
    field, h = level_set(KINDS[name], values_of(name, case)), case.spacing
    apart = 0.25 * h if KINDS[name].group == "noisy" else 1e-6
    away = np.abs(case.coarse) > apart
    assert field.dtype == np.float32 and field.shape == case.coarse.shape
    assert ((field < 0) == (case.coarse < 0))[away].all() and away.mean() > 0.8


@pytest.mark.parametrize(("ratio", "axis"), [(1.5, "x"), (1.5, "y"), (5, "z")])
def test_unequal_spacings_are_exact_and_coarse_along_one_axis(ratio, axis, case):
    values, spacing, origin = samples_of(KINDS[f"spacing 1:1:{ratio:g}, {axis}"], case)
    assert values.shape["xyz".index(axis)] == 16 and set(values.shape) == {16, 16 * ratio}
    points = np.moveaxis(np.indices(values.shape), 0, -1) * spacing + origin
    np.testing.assert_allclose(points[0, 0, 0], -points[-1, -1, -1])
    np.testing.assert_allclose(values, box_distance(points), atol=1e-6)


@pytest.mark.parametrize(
    "name",
    [
        *("mc on exact", "bspline on cut off at 1.5", "ours on share of the voxel"),
        *("ours on d/100, no spacing given", "ours on spacing 1:1:1.5, y"),
    ],
)
def test_meshes_are_at_the_place_and_size_of_the_shape(name, case, fast):
    surface = mesh_of(name, case, fast)
    assert surface.mesh.is_closed() and surface.mesh.volume() == pytest.approx(SIDE**3, rel=0.08)
    assert np.abs(surface.mesh.vertices).max() == pytest.approx(SIDE / 2, abs=0.3 * case.spacing)
    assert np.abs(box_distance(surface.mesh.vertices)).mean() < 0.15 * case.spacing


def test_what_the_values_were_taken_as(case, fast):
    pairs = ("mask", "mask"), ("cut off at 2", "distance"), ("noise of 0.25", "noisy")
    for name, kind in pairs:
        assert mesh_of(f"ours on {name}", case, fast).facts["taken_as"] == kind
