"""Distance transforms of masks, as SciPy, ITK and edt make them, and what is none.

SciPy 1.17.1 and SimpleITK 2.5.7 make the maps here. ``edt.sdf`` and ``edt.edtsq`` of edt 3.1.2 are,
to float32, SciPy's distances inside less those outside and the squares of the former, as is
``mahotas.distance`` of mahotas 1.4.19.
"""

from itertools import product

import numpy as np
import pytest
import SimpleITK
from conftest import trilinear
from scipy import ndimage

from super_sdf import make_grid, reconstruct

THICK = (0.5, 0.5, 1.5)
# of thick slices: 0, 1 and 2 look like labels, and what starts at 0 on a side starts at 1.5 along z
UNTOLD = ("taxicab inside", "chessboard inside", "outside starts at 0")


def organ(spacing: tuple[float, float, float], n: int = 26) -> np.ndarray:
    """Return a mask of a bent tube and a ball, which are along no axis."""
    steps = np.array(spacing) / min(spacing)
    lines = [np.arange(0, n, step) - n * at for step, at in zip(steps, (0.487, 0.51, 0.46))]
    x, y, z = np.meshgrid(*lines, indexing="ij")
    tube = np.hypot(np.hypot(x, y + 0.1 * z) - 0.27 * n, z + 0.2 * x) - 0.12 * n
    ball = np.sqrt((x - 5) ** 2 + y**2 + z**2) - 0.22 * n
    inside: np.ndarray = np.minimum(tube, ball) < 0
    return inside


def of_scipy(inside, spacing):
    """Return SciPy's transforms of both sides and of one, and what people make of them."""
    euclidean = ndimage.distance_transform_edt
    out, into = (euclidean(side, sampling=spacing) for side in (~inside, inside))
    h = min(spacing)
    maps = {
        "signed": out - into,
        "positive inside": into - out,
        "less half a voxel": np.where(inside, h / 2 - into, out - h / 2),
        "inside starts at 0": np.where(inside, h - into, out),
        "inside starts at 0, positive": np.where(inside, into - h, -out),
        "outside starts at 0": np.where(inside, -into, out - h),
        "outside": out,
        "inside": into,
        "negative outside": -out,
        "negative inside": -into,
        "squared": np.where(inside, -(into**2), out**2),
        "squared outside": out**2,
        "squared inside, float32": (into**2).astype(np.float32),
        "float16": (out - into).astype(np.float16),
        "another unit": 1e-3 * (out - into),
        "clipped": np.clip(out - into, -2.5 * h, 2.5 * h),
        "clipped outside": np.minimum(out, 3 * h),
        "in samples": euclidean(~inside) - euclidean(inside),
        "outside, in samples": euclidean(~inside),
    }
    for metric in ("taxicab", "chessboard"):
        far, deep = (ndimage.distance_transform_cdt(side, metric) for side in (~inside, inside))
        maps |= {metric: far - deep, f"{metric} outside": far, f"{metric} inside": deep}
    return maps


def of_itk(inside, spacing):
    """Return ITK's signed maps, whose zeros are the border of the object, and Danielsson's map."""
    image = SimpleITK.GetImageFromArray(inside.T.astype(np.uint8))
    image.SetSpacing(spacing)
    signed = {
        "Maurer": SimpleITK.SignedMaurerDistanceMap,
        "Danielsson": SimpleITK.SignedDanielssonDistanceMap,
    }
    maps = {}
    for (name, work), squared, world, positive in product(signed.items(), *[(False, True)] * 3):
        options = {"squaredDistance": squared, "useImageSpacing": world}
        made = work(image, insideIsPositive=positive, **options)
        title = f"{name}{' squared' * squared}{' world' * world}{' positive' * positive}"
        maps[title] = SimpleITK.GetArrayFromImage(made).T
    outside = SimpleITK.DanielssonDistanceMap(image, inputIsBinary=True, useImageSpacing=True)
    return {**maps, "outside": SimpleITK.GetArrayFromImage(outside).T}


@pytest.mark.parametrize("spacing", [(0.7, 0.7, 0.7), THICK])
@pytest.mark.parametrize("library", [of_scipy, of_itk])
def test_of_a_distance_transform_only_the_sides_are_used(library, spacing):
    inside = organ(spacing)
    for name, values in library(inside, spacing).items():
        if spacing == THICK and name in UNTOLD:
            continue
        grid = make_grid(values, spacing=spacing, origin=0)
        assert grid.field.kind == "mask", name
        np.testing.assert_array_equal(grid.values < 0, inside, name)


def blocks(cells: np.ndarray, size: tuple[int, int, int], shift, spacing) -> np.ndarray:
    """Return distances to a solid of equal blocks, found from all faces of these.

    ``size`` is that of a block in samples, ``shift`` how far samples are from its corners.
    """
    shape = np.array(cells.shape) * size + 9
    lines = [(np.arange(n) - 4 + off) * h for n, off, h in zip(shape, shift, spacing)]
    points = np.stack(np.meshgrid(*lines, indexing="ij"), -1)
    size = np.array(size) * spacing
    squared, inside = np.full(points.shape[:3], np.inf), np.zeros(points.shape[:3], bool)
    for cell in np.argwhere(cells):
        inside |= ((points >= cell * size) & (points <= (cell + 1) * size)).all(-1)
    for axis in range(3):
        padded = np.moveaxis(np.pad(cells, 1), axis, 0)
        for i, *others in np.argwhere(padded[1:] != padded[:-1]):
            low = np.insert(np.array(others, float) - 1, axis, i) * size
            high = low + size * (np.arange(3) != axis)
            off = np.maximum(np.maximum(low - points, points - high), 0)
            squared = np.minimum(squared, (off**2).sum(-1))
    return np.where(inside, -1, 1) * np.sqrt(squared)


ONE, L, STAIRS = np.ones((1, 1, 1), bool), np.ones((2, 2, 1), bool), np.zeros((3, 1, 3), bool)
L[1, 1] = False
for step in range(3):
    STAIRS[step, 0, : 3 - step] = True
PYRAMID = np.zeros((5, 5, 3), bool)
for step in range(3):
    PYRAMID[step : 5 - step, step : 5 - step, step] = True
SOLIDS = {
    "box": (ONE, (10, 12, 6)),
    "plate": (ONE, (12, 10, 1)),
    "bar": (ONE, (2, 2, 12)),
    "L": (L, (6, 6, 6)),
    "stairs of one sample": (STAIRS, (3, 9, 1)),
    "pyramid of one sample": (PYRAMID, (3, 3, 1)),
}
SHIFTS = [(0, 0, 0), (0.5, 0.5, 0.5), (0.5, 0, 0), (0.3, 0.1, 0.4)]


@pytest.mark.parametrize("name", SOLIDS)
def test_exact_distances_to_boxes_are_no_transform_wherever_their_faces_are(name):
    for shift, spacing in product(SHIFTS, [(1, 1, 1), (1, 1, 1.5)]):
        distances = blocks(*SOLIDS[name], shift, spacing)
        forms = [
            (distances, 1),
            (-distances, 1),
            (distances.astype(np.float16), 1),
            (np.where(distances == 0, -0.0, distances), 1),
            (np.rot90(distances, axes=(0, 1)), 1),
            (1e-3 * distances.astype(np.float32), 1e-3),
        ]
        cut = [(distances.clip(-t, t), 1) for t in (0.6, 1, 1.2, 2)] * (0.5 not in shift)
        for values, scale in forms if not any(shift) else forms[:1] + cut:
            grid = make_grid(values, spacing=np.array(spacing) * scale, origin=0)
            assert grid.field.kind == "distance", (shift, spacing)


@pytest.mark.parametrize(("name", "volume"), [("box", 720), ("L", 648), ("plate", 120)])
def test_exact_distances_with_faces_on_samples_have_the_volume_of_the_solid(name, volume):
    grid = make_grid(blocks(*SOLIDS[name], (0, 0, 0), (1, 1, 1)), spacing=1.0, origin=0)
    assert reconstruct(grid, trilinear).volume() == pytest.approx(volume, rel=0.02)


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32, np.float64, bool])
def test_two_slices_are_a_mask(dtype):
    mask = np.zeros((20, 18, 2), bool)
    mask[5:15, 4:14] = True
    for axis in range(3):
        turned = np.moveaxis(mask, 2, axis)
        spacing = np.where(np.arange(3) == axis, 5.0, 1.0)
        grid = make_grid(turned.astype(dtype), spacing=spacing, origin=0)
        np.testing.assert_array_equal(grid.values < 0, turned)
