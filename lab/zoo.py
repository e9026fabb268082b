"""A zoo of grids as people have them: the plain call, and the way out that a refusal names.

    python -m lab zoo
    python -m lab zoo --sizes 24 --only density

Each kind is made of a solid in closed form. The plain call is ``make_grid(values, spacing=h)``. If
it is refused, the option that the message names is added, and so on. A mesh is right if its mean
distance to the truth, both ways, is at most 1.1 times that of marching cubes of the same values,
and ``MARGIN`` voxels. Needs the extra test.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
import SimpleITK as sitk  # noqa: N813
from scipy import ndimage

from super_sdf import load_network, make_grid, reconstruct
from super_sdf.errors import SuperSdfError
from super_sdf.evaluation import Sampled
from super_sdf.network.contract import Decoder
from super_sdf.surface.mesh import Mesh
from super_sdf.truth import Solid

from . import parser_of
from .kinds import without_unknown
from .surfaces import closed_isosurface

Array = np.ndarray
Form = Callable[[Array], Array]

SIZES = (24, 32, 48)
H = 0.05  # world units from sample to sample
WORSE, MARGIN = 1.1, 0.004  # times marching cubes' error, and voxels
ESTIMATE = 0.03  # by which an estimated spacing may be off
POINTS, FACTOR, TRIES = 2000, 4, 4
FINE = 3  # of the lattice on which the truth is meshed
VOLUME_OFF = 0.15  # of the volume, beyond marching cubes' own error: inside out, or crumbs
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])


@dataclass(frozen=True, eq=False)
class Kind:
    """Values as they stand in a user's file, and the truth."""

    values: Any  # (nx, ny, nz)
    form: Form  # of places in voxels: the values without steps, cuts and noise
    level: float = 0.0  # of the form at the surface
    above: bool = False  # the solid is above the level
    signs: bool = False  # the values only say what is inside: marching cubes gets a mask
    options: dict[str, Any] = field(default_factory=dict)  # of the plain call
    steps: tuple[float, float, float] = (1.0, 1.0, 1.0)  # spacings, in voxels
    unit: float = H  # world units per voxel
    labels: dict[int, Form] = field(default_factory=dict)  # below 0 within
    ends: str = "mesh"  # or "refusal", "either"


# Solids: distances in voxels at places (..., 3) of a grid of n voxels a side.


def at(p: Array, n: int, turn: Array | None = None) -> Array:
    """Return x, y and z of places, (3, ...), about the middle of the grid, in its sides."""
    q = (p - (n - 1) / 2 - np.array([0.13, 0.29, -0.21])) / n
    return np.moveaxis(q if turn is None else q @ turn, -1, 0)


def sphere(x: Array, y: Array, z: Array, at: float = 0.0, radius: float = 0.3) -> Array:
    return np.sqrt((x - at) ** 2 + y**2 + z**2) - radius


def box(xyz: Array, *sides: float) -> Array:
    off = np.stack([np.abs(u) - side for u, side in zip(xyz, sides)])
    return np.sqrt((np.maximum(off, 0) ** 2).sum(0)) + np.minimum(off.max(0), 0)


def ball(p: Array, n: int, radius: float = 0.31) -> Array:
    return n * sphere(*at(p, n), 0, radius)


def body(p: Array, n: int) -> Array:
    """Return the distance to a tilted torus with a ball in its hole."""
    x, y, z = at(p, n, TURN)
    torus = np.hypot(np.hypot(x, y) - 0.3, z) - 0.1
    return n * np.minimum(torus, sphere(x, y, z, 0, 0.11))


def block(p: Array, n: int, sides=(0.3, 0.22, 0.15)) -> Array:
    return n * box(at(p, n, TURN), *sides)


def bar(p: Array, n: int) -> Array:
    """Return the distance to a box along the axes, its faces on samples."""
    return box(np.moveaxis(p - n // 2, -1, 0), n // 3, n // 4, n // 6)


def quadric(p: Array, n: int) -> Array:
    x, y, z = at(p, n)
    return (x / 0.4) ** 2 + (y / 0.25) ** 2 + (z / 0.2) ** 2 - 1


def cut_quadric(p: Array, n: int) -> Array:
    """Return a tube of two quadrics and planes, as implicit CSG makes it."""
    x, y, z = at(p, n)
    tube = np.maximum(x**2 / 0.09 + y**2 / 0.05 - 1, (z**2 - 0.06) * 4)
    return np.maximum(tube, -(x**2 + y**2 - 0.01) * 4)


def smooth_union(p: Array, n: int) -> Array:
    one, other = (sphere(*at(p, n), x, 0.2) for x in (-0.15, 0.17))
    blend = np.maximum(0.1 - np.abs(one - other), 0) / 0.1
    return n * (np.minimum(one, other) - blend**2 * 0.1 / 4)


def gyroid(p: Array, n: int) -> Array:
    x, y, z = 9 * at(p, n)
    wave = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
    return np.maximum(wave, sphere(x, y, z, 0, 0.4 * 9))


def sheet(p: Array, n: int) -> Array:
    """Return a gyroid's wall over its gradient, the usual distance to first order."""
    (a, b, c), (u, v, w) = np.sin(xyz := 13 * at(p, n)), np.cos(xyz)
    slope = np.sqrt((u * v - c * a) ** 2 + (v * w - a * b) ** 2 + (w * u - b * c) ** 2)
    wall = np.abs(a * v + b * w + c * u) / np.maximum(slope, 0.3) - 0.8
    return n / 13 * np.maximum(wall, np.abs(xyz).max(0) - 5.2)


def metaballs(p: Array, n: int) -> Array:
    x, y, z = at(p, n)
    middles = ((-0.15, 0.0, 0.0), (0.15, 0.05, 0.0), (0.0, -0.15, 0.1))
    return sum(np.exp(-((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) / 0.02) for a, b, c in middles)


def places(shape, steps=(1.0, 1.0, 1.0)) -> Array:
    return np.moveaxis(np.indices(shape), 0, -1) * np.array(steps)


# Kinds: what is done with the distances of a solid.

KINDS: dict[str, Callable[[int], Kind]] = {}


def kind(
    name: str,
    solid=body,
    change=lambda d: d * H,
    *,
    noise: float = 0.0,
    clip: tuple[float, float] | None = None,
    dtype: Any = None,
    form: Form | float | None = None,
    **more: Any,
) -> None:
    """Add a kind of grid: ``change`` takes distances in voxels to values.

    Then come what is lost: noise, a clip, rounding to a type. Where ``change`` itself loses
    something, ``form`` is the same without loss; a number is a factor.
    """
    exact = change if form is None else form if callable(form) else lambda d: d * form

    def make(n: int) -> Kind:
        steps = more.get("steps", (1.0, 1.0, 1.0))
        values = change(solid(places([int((n - 1) / step) + 1 for step in steps], steps), n))
        values = values + noise * random(values.shape) if noise else values
        values = np.clip(values, *clip) if clip else values
        if np.issubdtype(dtype, np.integer):
            values = np.rint(values).clip(np.iinfo(dtype).min, np.iinfo(dtype).max)
        values = values if dtype is None else values.astype(dtype)
        return Kind(values, lambda p: exact(solid(p, n)), **more)

    KINDS[name] = make


def random(shape) -> Array:
    return np.random.default_rng(0).uniform(-1, 1, shape)


def transforms(d: Array) -> tuple[Array, Array]:
    return tuple(ndimage.distance_transform_edt(side) for side in (d > 0, d <= 0))


def signed_transform(d: Array) -> Array:
    out, into = transforms(d)
    return out - into


def by_itk(call: Callable[[Any], Any]) -> Form:

    def change(d: Array) -> Array:
        return sitk.GetArrayFromImage(call(sitk.GetImageFromArray((d <= 0).astype(np.uint8))))

    return change


def unseen(fill: float, of_inside: bool = True) -> Form:
    """Return the change to distances over 4, and a fill value where nothing was seen."""
    return lambda d: np.where(d < -2.4 if of_inside else np.abs(d) > 4, fill, np.clip(d / 4, -1, 1))


def bordered(value: float) -> Form:
    """Return the change to distances with a border of a value."""

    def change(d: Array) -> Array:
        padded = np.full(d.shape, value)
        padded[2:-2, 2:-2, 2:-2] = d[2:-2, 2:-2, 2:-2] * H
        return padded

    return change


def sigmoid(d: Array, width: float = 0.7) -> Array:
    return 1 / (1 + np.exp(np.clip(d / width, -60, 60)))


def upwind(values: Array, rounds: int = 40) -> Array:
    """Return values after some steps of re-initialisation by first-order upwind differences."""
    sign = values / np.sqrt(values**2 + 1)
    found = values.copy()
    for _ in range(rounds):
        square = np.zeros_like(found)
        for axis in range(3):
            before, after = np.roll(found, 1, axis), np.roll(found, -1, axis)
            for edge, side in ((0, before), (-1, after)):
                np.moveaxis(side, axis, 0)[edge] = np.moveaxis(found, axis, 0)[edge]
            back, ahead = (found - before) * np.sign(sign), (after - found) * np.sign(sign)
            square += np.maximum(np.maximum(back, 0), np.maximum(-ahead, 0)) ** 2
        found -= 0.3 * sign * (np.sqrt(square) - 1)
    return found


AS_IT_IS = {"change": lambda d: d}
ABOVE = {"level": 0.5, "above": True}
DENSITY = {"change": sigmoid, **ABOVE}
SHARE = {"change": lambda d: 0.5 - d, "clip": (0, 1), **ABOVE}
MASK = {"above": True, "signs": True, "form": -1}
SIGNS = {"signs": True, "form": 1}
INSIDE = {"change": lambda d: d <= 0, **MASK}
SEEN = {"form": 1 / 4, "ends": "either"}
MM = {"unit": 1.0}
NO_SPACING = {"options": {"spacing": None}}
SLICES = {"solid": ball, "steps": (1.0, 1.0, 2.5)}
REFUSED = {"ends": "refusal"}

# distances
kind("exact, float32", dtype=np.float32)
kind("exact, float64, a box", block)
kind("exact, float16", dtype=np.float16)
kind("exact, positive inside", block, lambda d: -d * H, above=True)
kind("exact, no spacing", **NO_SPACING)
kind("exact, in mm, spacing in m", change=lambda d: d * 50.0)
kind("exact, in voxels, spacing in mm", **AS_IT_IS, unit=0.7)
kind("exact, int16 in thousandths", change=lambda d: d * 1000, dtype=np.int16, **MM)
kind("exact, int8 in tenths", block, lambda d: d * 10, dtype=np.int8, **MM)
kind("exact, slices 2.5 apart", **SLICES)
kind("exact, slices 2.5 apart, no spacing", **SLICES, **NO_SPACING)
kind("exact, slices 2.5 apart, one spacing given", **SLICES, options={"spacing": H})
kind("exact, faces on samples", bar)
kind("exact, along the border", lambda p, n: ball(p, n, 0.53))
kind("exact, a ball that leaves the grid", lambda p, n: ball(p + n * 0.3, n, 0.4))
kind("exact, true CSG", lambda p, n: np.maximum(block(p, n), -ball(p, n, 0.2)))
kind("exact, rounded to tenths of a voxel", change=lambda d: np.rint(d * 10) / 10 * H, form=H)
kind("exact, rounded to whole voxels", change=np.rint, form=1, **MM)
kind("exact, a wall thinner than a voxel", lambda p, n: np.abs(ball(p, n)) - 0.3, ends="either")

# truncated and partly unknown distances
for cut in (3.0, 1.0, 0.5):
    kind(f"cut off at {cut:g}", block, clip=(-cut * H, cut * H))
kind("cut off unevenly", block, clip=(-H, 2.5 * H))
kind("normalised, -1 to 1 at 3", change=lambda d: d / 3, clip=(-1, 1))
kind("normalised, no spacing", change=lambda d: d / 3, clip=(-1, 1), **NO_SPACING)
kind("normalised, NaN beyond", change=unseen(np.nan, of_inside=False), form=1 / 4)
kind("NaN deep inside", ball, unseen(np.nan), form=1 / 4)
kind("0 where unseen inside", ball, unseen(0.0), **SEEN)
kind("1 where unseen inside", ball, unseen(1.0), **SEEN)
kind("-1000 where unseen", ball, unseen(-1000.0), **SEEN)
kind("inf outside", change=lambda d: np.where(d > 3, np.inf, d * H), form=H)
kind("NaN across the surface", form=H, **REFUSED,
     change=lambda d: np.where(random(d.shape) > 0.9, np.nan, d * H))  # fmt: skip
kind("border of NaN", ball, bordered(np.nan), form=H)
kind("border of 1", ball, bordered(1.0), form=H)
kind("border of 0", ball, bordered(0.0), form=H, ends="either")

# densities, images, probabilities
kind("density, sigmoid", **DENSITY)
kind("density, steep sigmoid", change=lambda d: sigmoid(d, 0.15), **ABOVE)
kind("density, wide sigmoid", ball, lambda d: sigmoid(d, 3.0), **ABOVE)
kind("density, share of the voxel", block, **SHARE)
kind("density, share, level given", block, **SHARE, options={"level": 0.5})
kind("density, 1 outside", change=lambda d: 1 - sigmoid(d), level=0.5)
kind("density, the inside given", **DENSITY, options={"inside": "negative"})
kind("density, blurred over five voxels", ball, lambda d: 0.5 - d / 5, clip=(0, 1), **ABOVE)
kind("density, share, faces between samples", lambda p, n: bar(p + 0.4, n), **SHARE)
kind("density, cut at its foot, level given", ball, lambda d: 1 - d / 9, clip=(0.5, 2),
     options={"level": 0.9}, **ABOVE)  # fmt: skip
kind("map of both signs, with noise", metaballs, lambda v: v - 0.02, noise=0.02, **ABOVE)
kind("probability with noise", ball, **DENSITY, noise=0.02, clip=(0, 1))
kind("image of 8 bits", change=lambda d: 255 * (0.5 - d / 12), dtype=np.uint8, level=127.5,
     above=True)  # fmt: skip
kind("image of 16 bits, with noise", change=lambda d: 300 + 3000 * sigmoid(d), noise=30,
     dtype=np.uint16, level=1800, above=True)  # fmt: skip
kind("CT, int16, of bone in air", change=lambda d: -1000 + 2000 * sigmoid(d), dtype=np.int16,
     level=0, above=True, unit=0.7)  # fmt: skip
kind("MR, int16, with overshoot", dtype=np.int16, **ABOVE,
     change=lambda d: 500 + 2e4 * (sigmoid(d, 0.3) - 0.1 * np.exp(-((d - 1.5) ** 2))))  # fmt: skip
kind("CT, int16, of bone in water, level given", change=lambda d: 40 + 900 * sigmoid(d), noise=20,
     dtype=np.int16, options={"level": 490}, level=490, above=True, unit=0.7)  # fmt: skip
kind("logits", change=lambda d: -d / 0.3, above=True)
kind("logits, clamped", ball, lambda d: -d / 0.3, clip=(-10, 10), above=True)
kind("occupancy of a network, bent", ball, lambda d: sigmoid(d + 0.15 * d**2 * (d > 0)), **ABOVE)

# masks and their transforms
kind("mask, bool", **INSIDE)
kind("mask, 0 and 255", change=lambda d: np.where(d <= 0, 255, 0), dtype=np.uint8, **MASK)
kind("mask, float 0 and 1", **INSIDE, dtype=np.float32)
kind("mask, -1 and 1", change=lambda d: np.where(d <= 0, -1.0, 1.0), **SIGNS)
kind("mask, 1 and 2", change=lambda d: np.where(d <= 0, 2, 1), dtype=np.int32, **MASK)
kind("mask, solid at the border", change=lambda d: np.uint8(d > 0), **SIGNS, above=True)
kind("mask, no spacing", **INSIDE, **NO_SPACING)
kind("mask, slices 3 apart", ball, **INSIDE, steps=(1, 1, 3))
kind("transform, signed", change=lambda d: signed_transform(d) * H, **SIGNS)
kind("transform, no spacing", change=signed_transform, **SIGNS, **NO_SPACING)
kind("transform, less half a voxel", **SIGNS,
     change=lambda d: (signed_transform(d) - np.where(d > 0, 0.5, -0.5)) * H)  # fmt: skip
kind("transform, float32, positive inside", change=lambda d: -signed_transform(d) * H,
     dtype=np.float32, **MASK)  # fmt: skip
kind("transform, of the inside only", change=lambda d: transforms(d)[1] * H, **MASK)
kind("transform, of the outside only", change=lambda d: transforms(d)[0] * H, **SIGNS)
kind("transform, Maurer's of ITK", **SIGNS, **MM, change=by_itk(
     lambda x: sitk.SignedMaurerDistanceMap(x, squaredDistance=False)))  # fmt: skip
kind("transform, of a thin inside", lambda p, n: block(p, n, (0.3, 0.22, 0.06)), **MASK,
     change=lambda d: transforms(d)[1] * H)  # fmt: skip
kind("transform, chessboard", **SIGNS, change=lambda d: 1.0 * (
     ndimage.distance_transform_cdt(d > 0) - ndimage.distance_transform_cdt(d <= 0)))  # fmt: skip
kind("transform, squared, Maurer's of ITK", **SIGNS, **MM, change=by_itk(
     lambda x: sitk.SignedMaurerDistanceMap(x, squaredDistance=True)))  # fmt: skip
kind("transform, blurred", form=1, **MM,
     change=lambda d: ndimage.gaussian_filter(signed_transform(d), 1.0))  # fmt: skip
kind("mask, anti-aliased by ITK", change=by_itk(sitk.AntiAliasBinary), form=-1, above=True, **MM)
kind("mask, blurred", form=lambda d: 0.5 - d / 4, **ABOVE,
     change=lambda d: ndimage.gaussian_filter((d <= 0).astype(np.float32), 1.0))  # fmt: skip

# labels


def labels(name: str, numbers: tuple[int, ...], dtype: Any, **more: Any) -> None:
    """Add a kind of labels: outside, a block, and a ball beside it, by number."""

    def make(n: int) -> Kind:
        def one(p: Array) -> Array:
            return block(p + np.array([0.1, 0.1, 0]) * n, n, sides=(0.22, 0.18, 0.15))

        def other(p: Array) -> Array:
            return np.maximum(ball(p - np.array([0.18, 0.16, 0]) * n, n, 0.2), -one(p))

        p = places((n, n, n))
        which = np.where(one(p) <= 0, 1, np.where(other(p) <= 0, 2, 0))
        within = {numbers[1]: one, numbers[2]: other}
        if len(numbers) > 3:  # parts of the block
            which = np.where((which == 1) & (p[..., 2] > n / 2), 3, which)
            within[numbers[1]] = lambda p: np.maximum(one(p), p[..., 2] - n // 2 - 0.5)
            within[numbers[3]] = lambda p: np.maximum(one(p), n // 2 + 0.5 - p[..., 2])
        within[numbers[0]] = lambda p: -np.minimum(one(p), other(p))
        return Kind(np.array(numbers, dtype)[which], one, labels=within, unit=1.0, **more)

    KINDS[name] = make


labels("labels 0, 1, 2", (0, 1, 2), np.uint8)
labels("labels 0, 100, 117", (0, 100, 117), np.uint8)
labels("labels 0, 1, 2, float32", (0, 1, 2), np.float32)
labels("labels 1, 2, 3", (1, 2, 3), np.int16)
labels("labels -1, 0, 1", (-1, 0, 1), np.int16)
labels("labels of 64 bits", (0, 2**60 + 1, 2**60 + 2), np.uint64)
labels("labels, the inside given", (0, 1, 2, 3), np.uint8, options={"inside": "positive"})
labels("labels, one chosen", (0, 1, 2, 3), np.uint8, options={"label": 2})

# fields of one side
kind("unsigned, of a ball", ball, lambda d: np.abs(d) * H)
kind("unsigned, no spacing", ball, lambda d: np.abs(d) * H, **NO_SPACING)
kind("unsigned, of the body, a little more", change=lambda d: (np.abs(d) + 0.02) * H)
kind("unsigned, cut off", ball, lambda d: np.abs(d) * H, clip=(0, 3 * H))
kind("unsigned, squared", ball, lambda d: (d * H) ** 2)
kind("outside only, 0 within", block, clip=(0, np.inf), ends="either")
kind("no surface, all outside", change=lambda d: (d - d.min() + 2) * H, **REFUSED)
kind("no surface, all inside", change=lambda d: (d - d.max() - 2) * H, **REFUSED)
kind("constant", change=np.ones_like, **REFUSED)
kind("all 0", change=np.zeros_like, dtype=np.uint8, **REFUSED)
kind("all NaN", change=lambda d: d * np.nan, **REFUSED)
kind("level out of reach", **DENSITY, options={"level": 3.0})
kind("label that is not there", change=lambda d: np.rint(sigmoid(d)), options={"label": 5},
     **REFUSED)  # fmt: skip

# fields of another slope
kind("quadric", quadric, **AS_IT_IS)
kind("CSG of quadrics", cut_quadric, **AS_IT_IS)
kind("gyroid", gyroid, **AS_IT_IS)
kind("gyroid's wall over its gradient", sheet)
kind("learned, slope 1.5, with ripples",
     lambda p, n: 1.5 * ball(p, n) + 0.1 * np.sin(p @ [1.9, 1.4, 2.3]))  # fmt: skip
kind("metaballs", metaballs, **AS_IT_IS, **ABOVE)
kind("smooth union", smooth_union)
kind("CSG by max, no distances", lambda p, n: np.maximum(quadric(p, n) * n / 8, -ball(p, n, 0.1)))
kind("learned, slope .7", lambda p, n: 0.7 * ball(p, n) * (1 + 0.3 * (p[..., 0] / n - 0.5)))
kind("slope by the place", lambda p, n: block(p, n) * np.where(p[..., 0] > p[..., 1], 0.9, 0.6))
kind("tanh", block, lambda d: 2 * H * np.tanh(d / 2))
kind("exponential", ball, lambda d: np.expm1(d / 6) * H)
kind("square root of the distance", ball, lambda d: np.sign(d) * np.sqrt(np.abs(d)) * H)
kind("noise of .4", block, noise=0.4 * H)
kind("re-initialised quadric", lambda p, n: quadric(p, n) * n / 8, lambda d: upwind(d) * H, form=H)
kind("fast-marched by ITK", block, by_itk(
     lambda x: sitk.ApproximateSignedDistanceMap(x)), form=1, **MM)  # fmt: skip


# parts that were not united: inside, distances to their faces, too


def parts(name: str, *shifts: float) -> None:
    """Add a kind of grid of boxes of 0.3 a side, shifted along x, each with its own faces."""
    middle, half = (max(shifts) + min(shifts)) / 2, (max(shifts) - min(shifts)) / 2

    def make(n: int) -> Kind:
        def one(p: Array, shift: float, longer: float = 0.0) -> Array:
            x, y, z = at(p, n)
            return H * n * box((x - shift, y, z), 0.15 + longer, 0.15, 0.15)

        p = places((n, n, n))
        faces = np.min([np.abs(one(p, shift)) for shift in shifts], 0)
        return Kind(np.copysign(faces, one(p, middle, half)), lambda q: one(q, middle, half))

    KINDS[name] = make


parts("parts that touch", -0.15, 0.15)
parts("parts that overlap", -0.15, -0.05, 0.04, 0.1)

# small and odd grids
kind("two slices of a mask", lambda p, n: n * (np.hypot(*at(p, n)[:2]) - 0.3),
     lambda d: (d <= 0)[..., :2], **MASK, ends="either")  # fmt: skip
kind("Fortran order", change=lambda d: np.asfortranarray(d * H))
kind("big-endian", dtype=">f4")


# Following the messages


def level_set(sample: Kind, options: dict[str, Any]) -> tuple[Array, Form]:
    """Return what marching cubes meshes at 0, and the true form; both negative inside."""
    values = np.asarray(sample.values)
    if "label" in options:
        label = int(options["label"])
        return 0.5 - (values == np.array(label, values.dtype)), sample.labels[label]
    level = options.get("level", options.get("offset", sample.level))
    above = options.get("inside") != "negative" if "level" in options else sample.above
    side = -1 if above else 1

    def form(p: Array) -> Array:
        return side * (sample.form(p) - level)

    if sample.signs:
        return np.where(form(places(values.shape, sample.steps)) <= 0, -0.5, 0.5), form
    found = side * (values.astype(np.float64) - level)
    return without_unknown(np.where(np.isfinite(found), found, np.nan)), form


@dataclass(frozen=True)
class Outcome:
    """What came of a call: refused with a message, or errors in voxels."""

    options: str
    verdict: str  # "refused", "right", "worse" or "volume"
    message: str = ""
    ours: float = float("nan")
    theirs: float = float("nan")


NUMBER = r"-?[\d.]+(?:e[+-]?\d+)?"
OPTION = re.compile(
    rf"--(?:(field|inside) (\w+)|(level|scale|offset|unknown) ({NUMBER})|(label) (-?\d+)"
    rf"|(spacing) ({NUMBER}(?:,{NUMBER})*|X,Y,Z))"
)


def advised(message: str) -> dict[str, Any]:
    """Return the options that a message names, as ``make_grid`` takes them; the first of each.

    A spacing that is only named stays as it is: the user knows it.
    """
    named = [[*filter(None, groups)] for groups in OPTION.findall(message)]
    named += [["spacing", "X,Y,Z"]] if "give --spacing" in message else []
    found: dict[str, Any] = dict(reversed(named))
    for name, word in found.items():
        if name == "spacing" and "X" not in word:
            found[name] = [*map(float, word.split(","))]
        elif name in ("label", "level", "scale", "offset", "unknown"):
            found[name] = int(word) if name == "label" else float(word)
    return found


def distance(truth: Mesh, mesh: Mesh, count: int, within: Array | None = None) -> float:
    """Return the mean distance between two surfaces, both ways, at points drawn from each.

    NaN without a mesh. ``within``, (3,), leaves out caps: points beside the border of the box from
    the origin to there.
    """
    if not len(mesh.faces):
        return float("nan")
    total = 0.0
    for seed, (one, other) in enumerate(((truth, mesh), (mesh, truth)), 1):
        points = Sampled(one, (1, seed), count).drawn[0]
        if within is not None:
            points = points[((points > 0.1) & (points < within - 0.1)).all(1)]
        total += float(Solid(other).distance(points).mean()) / 2 if len(points) else np.inf
    return total


def call(sample: Kind, options: dict[str, Any], network: Decoder) -> Outcome:
    """Make a mesh, and measure it."""
    named = " ".join(f"{key}={value}" for key, value in options.items())
    steps = np.array(sample.steps)
    told = {"spacing": steps * sample.unit, "origin": 0.0, **options}
    offset = told.pop("offset", 0.0)
    told["spacing"] = steps * sample.unit if isinstance(told["spacing"], str) else told["spacing"]
    try:
        grid = make_grid(sample.values, **told)
        mesh = reconstruct(grid, network, FACTOR, offset=offset)
    except SuperSdfError as problem:
        return Outcome(named, "refused", problem.flagged)
    values, form = level_set(sample, options)
    scale = steps / np.array(grid.spacing)  # an estimate is off by some per cent
    if np.abs(scale * sample.unit - 1).max() > ESTIMATE and told["spacing"] is not None:
        scale = np.full(3, 1 / sample.unit)
    mesh = mesh.transformed(np.diag(scale), np.zeros(3))
    other = closed_isosurface(values.astype(np.float32), steps, 0.0)
    shape = np.array(values.shape)
    fine = form(places(FINE * (shape - 1) + 1, steps / FINE)).astype(np.float32)
    truth, top = closed_isosurface(fine, steps / FINE, 0.0), (shape - 1) * steps
    ours, theirs = (distance(truth, m, POINTS, within=top) for m in (mesh, other))
    volume = max(truth.volume(), 1.0)
    ours_off, theirs_off = (abs(m.volume() / volume - 1) for m in (mesh, other))
    verdict = "right" if ours <= WORSE * theirs + MARGIN else "worse"
    verdict = "volume" if ours_off - theirs_off > VOLUME_OFF else verdict
    return Outcome(named, verdict, "", ours, theirs)


def follow(sample: Kind, network: Decoder) -> Iterator[Outcome]:
    """Yield the outcome of the plain call, and of each way out that a message names."""
    options = dict(sample.options)
    for _ in range(TRIES):
        outcome = call(sample, options, network)
        yield outcome
        more = advised(outcome.message)
        if outcome.verdict != "refused" or not more or all(options.get(k) == more[k] for k in more):
            return
        options |= more


def problem(sample: Kind, outcomes: list[Outcome]) -> str:
    """Return what is wrong with the outcomes of a kind; empty if nothing is."""
    last = outcomes[-1]
    if last.verdict not in ("right", "refused"):
        return f"{last.verdict}: {last.ours:.4f} of {last.theirs:.4f}"
    wanted = {"mesh": ("right",), "refusal": ("refused",)}.get(sample.ends, ("right", "refused"))
    return "" if last.verdict in wanted else f"ends {last.verdict} {last.message}"


def main() -> None:
    """Print a table of kinds and sizes, and what is wrong."""
    parser = parser_of(__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--only", default="", help="kinds whose names hold this")
    options = parser.parse_args()
    network, wrong = load_network("base", threads=1), []
    print("| kind | size | call | verdict | voxels off | marching cubes |")
    print("| --- | ---: | --- | --- | ---: | ---: |", flush=True)
    for name, size in product([name for name in KINDS if options.only in name], options.sizes):
        sample = KINDS[name](size)
        outcomes = list(follow(sample, network))
        for o in outcomes:
            figures = f"{o.verdict} {o.message} | {o.ours:.4f} | {o.theirs:.4f}"
            print(f"| {name} | {size} | {o.options} | {figures} |", flush=True)
        if found := problem(sample, outcomes):
            wrong.append(f"{name} {size}: {found}")
    print("\n".join([f"\n{len(KINDS)} kinds, {len(wrong)} wrong", *wrong]))
