"""Arrays as people have reported them to other programs, and what is made of each.

Every row names the report, a repository and a number of its issues.
"""

import re

import numpy as np
import pytest
from conftest import refusal
from scipy.ndimage import distance_transform_edt, gaussian_filter
from solids import box_distance

from super_sdf import make_grid, reconstruct
from super_sdf.errors import GridError

N = 40
POINTS = np.indices((N, N, N)) - (N / 2 - 0.37)
RANDOM = np.random.default_rng(0)


def ball(radius, middle=0.0):
    return np.sqrt(((POINTS - middle) ** 2).sum(0)) - radius


def box(*half):
    return box_distance(np.moveaxis(POINTS, 0, -1), half)


def volume_of(radius):
    return 4 / 3 * np.pi * radius**3


MASK = box(9, 7, 5) < 0
BLURRED = np.where(MASK, distance_transform_edt(MASK), -distance_transform_edt(~MASK))
BODY = np.where(ball(15) < 0, np.where(ball(8) < 0, 1700, 1040), 24)
CLOUDS = sum(
    np.exp(-((POINTS - at[:, None, None, None]) ** 2).sum(0) / 6)
    for at in RANDOM.uniform(-12, 12, (9, 3))
)
SOFT, SOFTER = gaussian_filter(MASK + 0.0, 1), gaussian_filter(MASK + 0.0, 1.5)
OCCUPANCY = 1 / (1 + np.exp(1.7 * ball(13)))
CT = np.uint16(np.maximum(BODY + RANDOM.normal(0, 20, BODY.shape), 0))
TAKEN = [  # report, values, spacing, kind, volume or None
    ("isl-org/Open3D 519: cut off", np.clip(ball(13), -3, 3), 1, "distance", volume_of(13)),
    ("ethz-asl/vgn 20: cut off outside", np.minimum(ball(13), 2.5), 1, "distance", volume_of(13)),
    ("occupancy_networks 83: 0 and 1", (ball(13) < 0).astype(int), 1, "mask", volume_of(13)),
    ("cpederkoff/stl-to-voxel: 0 and 255", np.uint8(255 * (ball(12) < 0)), 1, "mask", None),
    ("nv-tlabs/GET3D 150: inside is above 0", -ball(13), 1, "distance", volume_of(13)),
    ("pmneila/PyMCubes 27: blurred mask", SOFTER - 0.5, 1, "smooth", None),
    ("pmneila/PyMCubes: smooth()", gaussian_filter(BLURRED, 1.2), 1, "smooth", None),
    ("deadsy/sdfx 85: a union", np.minimum(box(8, 8, 3), box(3, 3, 11)), 1, "distance", None),
    ("deadsy/sdfx 85: scaled", np.minimum(box(8, 8, 3), 2 * box(3, 3, 11)), 1, "smooth", None),
    ("uos/lvr2 45: quarters", np.round(ball(12.3) * 4) / 4, 1, "noisy", volume_of(12.3)),
    ("scikit-image 8116: halves", np.round(ball(12.3) * 2) / 2, None, "noisy", None),
    ("a quadric", (POINTS**2).sum(0) - 12.3**2, 1, "smooth", volume_of(12.3)),
    ("DeepSDF: clamped", np.clip(ball(13) / 19.5, -0.1, 0.1), None, "distance", None),
    ("1000 where nothing is known", np.where(ball(13) < 3, ball(13), 1000), 1, "distance", None),
]
REFUSED = [  # report, values, spacing, words of the advice
    ("niujinshuchong/sdfstudio 297: occupancy", OCCUPANCY, None, "level=0.5"),
    ("VAST-AI/TripoSR 12: density", 25 * np.exp(-0.8 * ball(13)), None, "level="),
    ("molstar 612: density of electrons", 40 * CLOUDS, None, "level="),
    ("molstar 612: an orbital", POINTS[0] * np.exp(-(POINTS**2).sum(0) / 40), None, "level="),
    ("sxyu/svox2 11: raw density", 30 * SOFT - 0.5, None, "level="),
    ("CT of 16 bits", CT, 1, "level="),
    ("resampled labels", 0.9999999998 * MASK + 2 * (ball(5, -10) < 0), None, "label=1"),
    ("labels, few of them 0", np.where(box(18, 18, 18) < 0, 7 - 4 * MASK, 0), None, "label=7"),
    ("unsigned distances", np.abs(ball(13)), 1, "offset=1"),
    ("another unit", 0.87 * ball(13), 1, "scale=1.149"),
]


@pytest.mark.parametrize("values, spacing, kind, volume", [row[1:] for row in TAKEN],
                         ids=[row[0] for row in TAKEN])  # fmt: skip
def test_values_are_taken_as_what_they_are(values, spacing, kind, volume):
    grid = make_grid(values, spacing=spacing)
    assert grid.field.kind == kind
    mesh = reconstruct(grid)
    assert mesh.is_closed() and mesh.components()[0] == 1
    if volume:
        assert mesh.volume() == pytest.approx(volume, rel=0.01)


@pytest.mark.parametrize("values, spacing, advice", [row[1:] for row in REFUSED],
                         ids=[row[0] for row in REFUSED])  # fmt: skip
def test_values_without_a_surface_at_0_are_refused_with_advice(values, spacing, advice):
    said = refusal(GridError, make_grid, values, spacing=spacing)
    assert advice in said
    if "level=" in advice:
        level, inside = re.search(r"level=([^,]+), inside='(\w+)'", said).groups()
        grid = make_grid(values, spacing=spacing, level=float(level), inside=inside)
        assert grid.field.network is None and values.min() < float(level) < values.max()


def test_a_large_label_is_named_in_full():  # seung-lab/chunkflow 138
    values = np.where(MASK, np.uint64(720575940379279312), np.uint64(0))
    values[0, 0, 0] = 720575940379279007
    assert "label=720575940379279312," in refusal(GridError, make_grid, values)


def test_a_slope_that_is_a_little_off_is_divided_out():
    grid = make_grid(1.02 * ball(12), spacing=1)
    assert grid.field.kind == "distance"
    assert grid.notes[0].startswith("the values change by 1.02 of a spacing")
    assert reconstruct(grid).volume() == pytest.approx(volume_of(12), rel=1e-3)


@pytest.mark.parametrize("size", [1e200, 1e-200])
def test_a_function_of_any_size_has_the_same_surface(size):
    def values(points):
        return size * (np.sqrt((points**2).sum(1)) - 0.6)

    mesh = reconstruct(function=values, bounds=(-1, 1), spacing=0.1)
    assert mesh.volume() == pytest.approx(volume_of(0.6), rel=0.01)
