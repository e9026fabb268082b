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
from functools import partial
from typing import Any

import numpy as np
import SimpleITK as sitk  # noqa: N813
from scipy import ndimage

from super_sdf import Mesh, load_network, make_grid, reconstruct
from super_sdf.errors import SuperSdfError
from super_sdf.network.decoder import Decoder
from super_sdf.truth.solid import Solid

from . import parser_of
from .kinds import without_unknown
from .metrics import sample_surface
from .surfaces import closed_isosurface

Array = np.ndarray
Form = Callable[[Array], Array]

SIZES = (24, 32, 48)
H = 0.05  # world units from sample to sample
WORSE, MARGIN = 1.1, 0.004  # times marching cubes' error, and voxels
ESTIMATE = 0.03  # by which an estimated spacing may be off
POINTS, FACTOR, TRIES = 2000, 4, 4
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


def _about_middle(p: Array, n: int) -> Array:
    return p - (n - 1) / 2 - np.array([0.13, 0.29, -0.21])


def ball(p: Array, n: int, radius: float = 0.31) -> Array:
    """Return the distance to a ball."""
    return np.linalg.norm(_about_middle(p, n), axis=-1) - radius * n


def body(p: Array, n: int) -> Array:
    """Return the distance to a tilted torus with a ball in its hole."""
    q = _about_middle(p, n) @ TURN
    torus = np.hypot(np.hypot(q[..., 0], q[..., 1]) - 0.3 * n, q[..., 2]) - 0.1 * n
    return np.minimum(torus, np.linalg.norm(q, axis=-1) - 0.11 * n)


def block(p: Array, n: int, turn: Array = TURN, sides=(0.3, 0.22, 0.15)) -> Array:
    """Return the distance to a turned box."""
    off = np.abs(_about_middle(p, n) @ turn) - n * np.array(sides)
    return np.linalg.norm(np.maximum(off, 0), axis=-1) + np.minimum(off.max(-1), 0)


def bar(p: Array, n: int) -> Array:
    """Return the distance to a box along the axes, its faces on samples."""
    off = np.abs(p - n // 2) - np.array([n // 3, n // 4, n // 6])
    return np.linalg.norm(np.maximum(off, 0), axis=-1) + np.minimum(off.max(-1), 0)


def quadric(p: Array, n: int) -> Array:
    """Return the polynomial of an ellipsoid, 0 on it and -1 in the middle."""
    return ((_about_middle(p, n) / n / np.array([0.4, 0.25, 0.2])) ** 2).sum(-1) - 1


def cut_quadric(p: Array, n: int) -> Array:
    """Return a tube of two quadrics and planes, as implicit CSG makes it."""
    x, y, z = np.moveaxis(_about_middle(p, n) / n, -1, 0)
    tube = np.maximum(x**2 / 0.09 + y**2 / 0.05 - 1, (z**2 - 0.06) * 4)
    return np.maximum(tube, -(x**2 + y**2 - 0.01) * 4)


def gyroid(p: Array, n: int) -> Array:
    """Return a gyroid in a ball."""
    x, y, z = np.moveaxis(_about_middle(p, n) * (9.0 / n), -1, 0)
    wave = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
    return np.maximum(wave, ball(p, n, 0.4) * 9.0 / n)


def blobs(p: Array, n: int) -> Array:
    """Return metaballs: a sum of Gaussians, the solid above .5."""
    q = _about_middle(p, n) / n
    places = ((-0.15, 0, 0), (0.15, 0.05, 0), (0, -0.15, 0.1))
    return sum(np.exp(-((q - np.array(at)) ** 2).sum(-1) / 0.02) for at in places)


def smooth_union(p: Array, n: int, width: float = 0.1) -> Array:
    """Return two balls with a smooth joint, in voxels."""
    q = _about_middle(p, n)
    one, other = (np.linalg.norm(q - [at * n, 0, 0], axis=-1) - 0.2 * n for at in (-0.15, 0.17))
    blend = np.maximum(width * n - np.abs(one - other), 0) / (width * n)
    return np.minimum(one, other) - blend**2 * width * n / 4


def lattice(n: int, steps=(1.0, 1.0, 1.0)) -> Array:
    """Return the places of samples, (nx, ny, nz, 3), in voxels."""
    return places([int((n - 1) / step) + 1 for step in steps], steps)


def places(shape, steps=(1.0, 1.0, 1.0)) -> Array:
    """Return the places of the samples of a grid of some shape, in voxels."""
    return np.moveaxis(np.indices(shape), 0, -1) * np.array(steps)


# Kinds. ``of`` makes one of a solid, and of what is done with its distances.

KINDS: dict[str, Callable[[int], Kind]] = {}


def kind(name: str, solid=body, change=None, *, form=None, **more: Any) -> None:
    """Add a kind of grid: ``change`` takes distances in voxels to values, ``form`` without loss."""
    change = change or (lambda d: d * H)

    def make(n: int) -> Kind:
        steps = more.get("steps", (1.0, 1.0, 1.0))
        values = change(solid(lattice(n, steps), n))
        exact = form or change
        return Kind(values, lambda p: exact(solid(p, n)), **more)

    KINDS[name] = make


def _noise(shape, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(-1, 1, shape)


def _edt(inside: Array, sampling=None) -> tuple[Array, Array]:
    """Return SciPy's distance transforms outside and inside."""
    return tuple(ndimage.distance_transform_edt(side, sampling) for side in (~inside, inside))


def signed_edt(d: Array) -> Array:
    """Return the difference of SciPy's distance transforms."""
    out, into = _edt(d <= 0)
    return out - into


def _itk(call: Callable[[Any], Any], values: Array, spacing: float = 1.0) -> Array:
    image = sitk.GetImageFromArray(values)
    image.SetSpacing((spacing,) * 3)
    return sitk.GetArrayFromImage(call(image))


def _unsure(d: Array, fill: float, beyond: float = 4, part: bool = True) -> Array:
    """Return truncated distances, -1 to 1, and a fill value where nothing was seen."""
    values = np.clip(d / beyond, -1, 1)
    unseen = d < -beyond * 0.6 if part else np.abs(d) > beyond
    return np.where(unseen, fill, values)


def sigmoid(d: Array, width: float = 0.7) -> Array:
    """Return 1 deep inside, 1/2 on the surface."""
    return 1 / (1 + np.exp(np.clip(d / width, -60, 60)))


def learned(p: Array, n: int) -> Array:
    """Return what a network learned: slope .7, a little more on one side."""
    return 0.7 * ball(p, n) * (1 + 0.3 * (p[..., 0] / n - 0.5))


IN_UNIT = {"form": lambda d: d * H}
ABOVE = {"level": 0.5, "above": True}
SHARE = {**ABOVE, "form": lambda d: 0.5 - d}
MASK = {"above": True, "signs": True, "form": lambda d: -d}
SIGNS = {"signs": True, "form": lambda d: d}
MM = {"unit": 1.0}

# distances
kind("exact, float32", change=lambda d: (d * H).astype(np.float32))
kind("exact, float64, a box", block)
kind("exact, float16", change=lambda d: (d * H).astype(np.float16), **IN_UNIT)
kind("exact, positive inside", block, change=lambda d: -d * H, above=True)
kind("exact, no spacing", options={"spacing": None})
kind("exact, inside given", options={"inside": "negative"})
kind("exact, in mm, spacing in m", change=lambda d: d * 50.0)
kind("exact, in m, spacing in mm", change=lambda d: d * 0.001, unit=1.0)
kind("exact, in voxels, spacing in mm", change=lambda d: d, unit=0.7)
kind("exact, int16 in thousandths", change=lambda d: np.rint(d * 1000).astype(np.int16),
     form=lambda d: d * 1000, **MM)  # fmt: skip
kind("exact, int16 in thousandths, no spacing", form=lambda d: d * 1000,
     change=lambda d: np.rint(d * 1000).astype(np.int16), options={"spacing": None})  # fmt: skip
kind("exact, int8 in tenths", block, form=lambda d: d * 10, **MM,
     change=lambda d: np.clip(np.rint(d * 10), -127, 127).astype(np.int8))  # fmt: skip
kind("exact, slices 2.5 apart", ball, steps=(1.0, 1.0, 2.5))
kind("exact, slices 2.5 apart, no spacing", ball, steps=(1, 1, 2.5), options={"spacing": None})
kind("exact, slices 2.5 apart, one spacing given", ball, steps=(1, 1, 2.5), options={"spacing": H})
kind("exact, faces on samples", bar)
kind("exact, faces on samples, in voxels", bar, change=lambda d: d, **MM)
kind("exact, along the border", lambda p, n: ball(p, n, 0.53))
kind("exact, a ball that leaves the grid", lambda p, n: ball(p + n * 0.3, n, 0.4))
kind("exact, level moved", change=lambda d: (d - 0.8) * H)
kind("exact, true CSG", lambda p, n: np.maximum(block(p, n), -ball(p, n, 0.2)))
kind("exact, rounded to tenths of a voxel", change=lambda d: np.rint(d * 10) / 10 * H, **IN_UNIT)
kind("exact, a wall thinner than a voxel", lambda p, n: np.abs(ball(p, n)) - 0.3, ends="either")

# truncated and partly unknown distances
for cut in (3.0, 1.5, 1.0, 0.5):
    kind(f"cut off at {cut:g}", block, partial(lambda c, d: np.clip(d, -c, c) * H, cut), **IN_UNIT)
kind("cut off at 3, float16", block, **IN_UNIT,
     change=lambda d: (np.clip(d, -3, 3) * H).astype(np.float16))  # fmt: skip
kind("cut off unevenly", block, lambda d: np.clip(d, -1, 2.5) * H, **IN_UNIT)
kind("normalised, -1 to 1 at 3", change=lambda d: np.clip(d / 3, -1, 1), form=lambda d: d / 3)
kind("normalised, no spacing", change=lambda d: np.clip(d / 3, -1, 1), form=lambda d: d / 3,
     options={"spacing": None})  # fmt: skip
kind("normalised, NaN beyond", change=lambda d: _unsure(d, np.nan, 3, False), form=lambda d: d / 3)
kind("NaN deep inside", ball, change=lambda d: _unsure(d, np.nan), form=lambda d: d / 4)
kind("0 where unseen inside", ball, lambda d: _unsure(d, 0.0), form=lambda d: d / 4, ends="either")
kind("1 where unseen inside", ball, lambda d: _unsure(d, 1.0), form=lambda d: d / 4, ends="either")
kind("-1000 where unseen", ball, lambda d: _unsure(d, -1000.0), form=lambda d: d / 4, ends="either")
kind("inf outside", change=lambda d: np.where(d > 3, np.inf, d * H), **IN_UNIT)
kind("NaN across the surface", form=lambda d: d * H, ends="refusal",
     change=lambda d: np.where(_noise(d.shape) > 0.9, np.nan, d * H))  # fmt: skip


def _bordered(value: float) -> Callable[[Array], Array]:
    def change(d: Array) -> Array:
        padded = np.full(d.shape, value)
        padded[2:-2, 2:-2, 2:-2] = d[2:-2, 2:-2, 2:-2] * H
        return padded

    return change


kind("border of NaN", ball, _bordered(np.nan), **IN_UNIT)
kind("border of 1", ball, _bordered(1.0), **IN_UNIT)
kind("border of 1000", ball, _bordered(1000.0), **IN_UNIT)
kind("border of 0", ball, _bordered(0.0), **IN_UNIT, ends="either")

# densities, images, probabilities
kind("density, sigmoid", change=sigmoid, **ABOVE)
kind("density, sigmoid, no spacing", change=sigmoid, **ABOVE, options={"spacing": None})
kind("density, sigmoid, float16", change=lambda d: sigmoid(d).astype(np.float16), **ABOVE,
     form=sigmoid)  # fmt: skip
kind("density, steep sigmoid", change=lambda d: sigmoid(d, 0.15), **ABOVE)
kind("density, wide sigmoid", ball, lambda d: sigmoid(d, 3.0), **ABOVE)
kind("density, share of the voxel", block, lambda d: np.clip(0.5 - d, 0, 1), **SHARE)
kind("density, share, of a box along the axes", bar, lambda d: np.clip(0.5 - d, 0, 1), **SHARE)
kind("density, share, level given", block, lambda d: np.clip(0.5 - d, 0, 1), **SHARE,
     options={"level": 0.5})  # fmt: skip
kind("density, 1 outside", change=lambda d: 1 - sigmoid(d), level=0.5)
kind("density, the inside given", change=sigmoid, **ABOVE, options={"inside": "negative"})
kind("density, blurred over five voxels", ball, lambda d: np.clip(0.5 - d / 5, 0, 1), **ABOVE,
     form=lambda d: 0.5 - d / 5)  # fmt: skip
kind("density, 0 to 100", block, lambda d: 100 * np.clip(0.5 - d / 2, 0, 1), level=50.0,
     above=True, form=lambda d: 100 * (0.5 - d / 2))  # fmt: skip
kind("density, slices 3 apart", ball, sigmoid, **ABOVE, steps=(1, 1, 3))
kind("probability with noise", ball, form=sigmoid, **ABOVE,
     change=lambda d: np.clip(sigmoid(d) + 0.02 * _noise(d.shape), 0, 1))  # fmt: skip
kind("image of 8 bits", form=lambda d: 255 * (0.5 - d / 12), level=127.5, above=True,
     change=lambda d: np.clip(np.rint(255 * (0.5 - d / 12)), 0, 255).astype(np.uint8))  # fmt: skip
kind("image of 8 bits, steep", form=lambda d: 255 * sigmoid(d), level=127.5, above=True,
     change=lambda d: np.rint(255 * sigmoid(d)).astype(np.uint8))  # fmt: skip
kind("image of 8 bits, share of the voxel", block, form=lambda d: 255 * (0.5 - d), level=127.5,
     above=True,
     change=lambda d: np.rint(255 * np.clip(0.5 - d, 0, 1)).astype(np.uint8))  # fmt: skip
kind("image of 16 bits, with noise", form=lambda d: 300 + 3000 * sigmoid(d), level=1800,
     above=True, change=lambda d: (300 + 3000 * sigmoid(d) + 30 * _noise(d.shape)).astype(
         np.uint16))  # fmt: skip
kind("CT, int16, of bone in air", form=lambda d: -1000 + 2000 * sigmoid(d), level=0, above=True,
     change=lambda d: np.rint(-1000 + 2000 * sigmoid(d)).astype(np.int16), unit=0.7)  # fmt: skip
kind("CT, int16, of bone in water, level given", change=lambda d: np.rint(
     40 + 900 * sigmoid(d) + 20 * _noise(d.shape)).astype(np.int16), options={"level": 490},
     form=lambda d: 40 + 900 * sigmoid(d), level=490, above=True, unit=0.7)  # fmt: skip
kind("logits", change=lambda d: -d / 0.3, above=True)
kind("logits, clamped", ball, lambda d: np.clip(-d / 0.3, -10, 10), form=lambda d: -d, above=True)
kind("occupancy of a network, bent", ball, above=True, level=0.5,
     change=lambda d: sigmoid(d + 0.15 * d**2 * (d > 0)))  # fmt: skip

# masks and their transforms
kind("mask, bool", change=lambda d: d <= 0, **MASK)
kind("mask, uint8", block, lambda d: (d <= 0).astype(np.uint8), **MASK)
kind("mask, 0 and 255", change=lambda d: np.where(d <= 0, np.uint8(255), np.uint8(0)),
     **MASK)  # fmt: skip
kind("mask, float 0 and 1", change=lambda d: (d <= 0).astype(np.float32), **MASK)
kind("mask, -1 and 1", change=lambda d: np.where(d <= 0, -1.0, 1.0), **SIGNS)
kind("mask, 1 and 2", change=lambda d: np.where(d <= 0, np.int32(2), np.int32(1)),
     **MASK)  # fmt: skip
kind("mask, no spacing", change=lambda d: d <= 0, **MASK, options={"spacing": None})
kind("mask, slices 3 apart", ball, lambda d: d <= 0, **MASK, steps=(1, 1, 3))
kind("transform, signed", change=lambda d: signed_edt(d) * H, **SIGNS)
kind("transform, no spacing", change=signed_edt, **SIGNS, options={"spacing": None})
kind("transform, less half a voxel", **SIGNS,
     change=lambda d: (signed_edt(d) - np.where(d > 0, 0.5, -0.5)) * H)  # fmt: skip
kind("transform, float32, positive inside", **MASK,
     change=lambda d: (-signed_edt(d) * H).astype(np.float32))  # fmt: skip
kind("transform, of the inside only", change=lambda d: _edt(d <= 0)[1] * H, **MASK)
kind("transform, of the outside only", change=lambda d: _edt(d <= 0)[0] * H, **SIGNS)
kind("transform, Maurer's of ITK", **SIGNS, **MM, change=lambda d: _itk(
     lambda x: sitk.SignedMaurerDistanceMap(x, squaredDistance=False, useImageSpacing=True),
     (d <= 0).astype(np.uint8)))  # fmt: skip
kind("transform, squared, Maurer's of ITK", **SIGNS, **MM, change=lambda d: _itk(
     lambda x: sitk.SignedMaurerDistanceMap(x, squaredDistance=True),
     (d <= 0).astype(np.uint8)))  # fmt: skip
kind("transform, Danielsson's of ITK", **SIGNS, **MM, change=lambda d: _itk(
     lambda x: sitk.SignedDanielssonDistanceMap(x), (d <= 0).astype(np.uint8)))  # fmt: skip
kind("transform, blurred", form=lambda d: d, **MM,
     change=lambda d: ndimage.gaussian_filter(signed_edt(d), 1.0))  # fmt: skip
kind("mask, anti-aliased by ITK", form=lambda d: -d, above=True, **MM, change=lambda d: _itk(
     sitk.AntiAliasBinary, (d <= 0).astype(np.uint8)))  # fmt: skip
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

        p = lattice(n)
        which = np.where(one(p) <= 0, 1, np.where(other(p) <= 0, 2, 0))
        if len(numbers) > 3:  # parts of the block
            which = np.where((which == 1) & (p[..., 2] > n / 2), 3, which)
        forms = {numbers[1]: one, numbers[2]: other}
        if len(numbers) > 3:
            forms[numbers[1]] = lambda p: np.maximum(one(p), p[..., 2] - n // 2 - 0.5)
            forms[numbers[3]] = lambda p: np.maximum(one(p), n // 2 + 0.5 - p[..., 2])
        forms[numbers[0]] = lambda p: -np.minimum(one(p), other(p))
        return Kind(np.array(numbers, dtype)[which], one, labels=forms, unit=1.0, **more)

    KINDS[name] = make


labels("labels 0, 1, 2", (0, 1, 2), np.uint8)
labels("labels 0, 100, 117", (0, 100, 117), np.uint8)
labels("labels 0, 3, 7, 50, int32", (0, 3, 7, 50), np.int32)
labels("labels 0, 1, 2, float32", (0, 1, 2), np.float32)
labels("labels 1, 2, 3", (1, 2, 3), np.int16)
labels("labels -1, 0, 1", (-1, 0, 1), np.int16)
labels("labels 0, 500, 1000, float64", (0, 500, 1000), np.float64)
labels("labels of 64 bits", (0, 2**60 + 1, 2**60 + 2), np.uint64)
labels("labels, no spacing", (0, 1, 2), np.uint8, options={"spacing": None})
labels("labels, the inside given", (0, 1, 2, 3), np.uint8, options={"inside": "positive"})
labels("labels, one chosen", (0, 1, 2, 3), np.uint8, options={"label": 2})

# fields of one side
kind("unsigned, of a ball", ball, lambda d: np.abs(d) * H)
kind("unsigned, no spacing", ball, lambda d: np.abs(d) * H, options={"spacing": None})
kind("unsigned, of the body, a little more", change=lambda d: (np.abs(d) + 0.02) * H)
kind("unsigned, of a box", block, lambda d: np.abs(d) * H)
kind(
    "unsigned, cut off", ball, lambda d: np.minimum(np.abs(d), 3) * H, form=lambda d: np.abs(d) * H
)
kind("unsigned, squared", ball, lambda d: (d * H) ** 2)
kind("outside only, 0 within", block, lambda d: np.maximum(d, 0) * H, form=lambda d: d * H,
     ends="either")  # fmt: skip
kind("no surface, all outside", change=lambda d: (d - d.min() + 2) * H, ends="refusal")
kind("no surface, all inside", change=lambda d: (d - d.max() - 2) * H, ends="refusal")
kind("constant", change=lambda d: np.ones_like(d), ends="refusal")
kind("all 0", change=lambda d: np.zeros(d.shape, np.uint8), ends="refusal")
kind("all NaN", change=lambda d: np.full(d.shape, np.nan), ends="refusal")
kind("level out of reach", change=sigmoid, **ABOVE, options={"level": 3.0})
kind("label that is not there", change=lambda d: np.rint(sigmoid(d)), ends="refusal",
     options={"label": 5})  # fmt: skip

# fields of another slope
kind("quadric", quadric, lambda f: f)
kind("quadric, no spacing", quadric, lambda f: f, options={"spacing": None})
kind("quadric, in world units", quadric, lambda f: f * 3 * H)
kind("CSG of quadrics", cut_quadric, lambda f: f)
kind("CSG of quadrics, no spacing", cut_quadric, lambda f: f, options={"spacing": None})
kind("gyroid", gyroid, lambda f: f)
kind("metaballs", blobs, lambda f: f, **ABOVE)
kind("metaballs less their level", blobs, lambda f: 0.5 - f)
kind("smooth union", smooth_union)
kind("smooth union, thirds", smooth_union, lambda d: 3 * d * H)
kind("CSG by max, no distances", lambda p, n: np.maximum(quadric(p, n) * n / 8, -ball(p, n, 0.1)))
kind("learned, slope .7", learned)
kind("learned, slope .7, no spacing", learned, options={"spacing": None})
kind("slope by the place", lambda p, n: block(p, n) * np.where(p[..., 0] > p[..., 1], 0.9, 0.6))
kind("tanh", block, lambda d: 2 * H * np.tanh(d / 2))
kind("tanh, -1 to 1", ball, lambda d: np.tanh(d / 3))
kind("exponential", ball, lambda d: np.expm1(d / 6) * H)
kind("square root of the distance", ball, lambda d: np.sign(d) * np.sqrt(np.abs(d)) * H)
kind("noise of .1", block, lambda d: (d + 0.1 * _noise(d.shape)) * H, **IN_UNIT)
kind("noise of .4", block, lambda d: (d + 0.4 * _noise(d.shape)) * H, **IN_UNIT)


def _upwind(values: Array, rounds: int) -> Array:
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


kind("re-initialised quadric", lambda p, n: quadric(p, n) * n / 8, lambda d: _upwind(d, 40) * H,
     **IN_UNIT)  # fmt: skip
kind("fast-marched by ITK", block, form=lambda d: d, **MM, change=lambda d: _itk(
     lambda x: sitk.ReinitializeLevelSet(x) if hasattr(sitk, "ReinitializeLevelSet")
     else sitk.ApproximateSignedDistanceMap(x), (d <= 0).astype(np.float32)))  # fmt: skip

# small and odd grids
kind("two slices of a mask", lambda p, n: np.linalg.norm(_about_middle(p, n)[..., :2], axis=-1)
     - n * 0.3, lambda d: (d <= 0)[..., :2], **MASK, ends="either")  # fmt: skip
kind("Fortran order", change=lambda d: np.asfortranarray(d * H))
kind("big-endian", change=lambda d: (d * H).astype(">f4"), **IN_UNIT)


# Following the messages


def level_set(sample: Kind, options: dict[str, Any]) -> tuple[Array, Form]:
    """Return what marching cubes meshes at 0, and the true form; both negative inside."""
    values = np.asarray(sample.values)
    if "label" in options:
        label = int(options["label"])
        return 0.5 - (values == np.array(label, values.dtype)), sample.labels[label]
    level = options.get("level", options.get("offset", sample.level))
    above = options.get("inside") != "negative" if "level" in options else sample.above
    form = _signed(sample.form, level, above)
    if sample.signs:
        return np.where(form(places(values.shape, sample.steps)) <= 0, -0.5, 0.5), form
    found = _signed(lambda x: x, level, above)(values.astype(np.float64))
    return without_unknown(np.where(np.isfinite(found), found, np.nan)), form


def _signed(form: Form, level: float, above: bool) -> Form:
    return lambda p: (level - form(p)) if above else (form(p) - level)


def off(form: Form, p: Array) -> Array:
    """Return the distance of places (n, 3) to the zero set of a form, to first order."""
    return np.abs(form(p)) / np.maximum(np.linalg.norm(slope(form, p), axis=1), 1e-12)


def slope(form: Form, p: Array, step: float = 1e-3) -> Array:
    """Return the gradient of a form, (n, 3), by central differences."""
    sides = [step * np.eye(3)[axis] for axis in range(3)]
    return np.stack([(form(p + s) - form(p - s)) / (2 * step) for s in sides], axis=1)


def on_surface(form: Form, top: Array) -> Array:
    """Return points on the zero set of a form, in the box from 0 to ``top``, in voxels."""
    p = np.random.default_rng(1).uniform(0, 1, (15 * POINTS, 3)) * top
    p = p[np.argsort(off(form, p))[: 2 * POINTS]]
    for _ in range(8):
        g = slope(form, p)
        p = p - (form(p) / np.maximum((g**2).sum(1), 1e-12))[:, None] * g
    good = (off(form, p) < 1e-3) & ((p >= 0) & (p <= top)).all(1)
    return p[good][:POINTS]


def error(mesh: Mesh, form: Form, points: Array, top: Array) -> float:
    """Return the mean distance between a mesh and the truth, both ways, in voxels."""
    if not len(mesh.faces):
        return float("inf")
    there = sample_surface(mesh, (1, 2), POINTS).points
    there = there[((there > 0.1) & (there < top - 0.1)).all(1)]
    if not len(there):
        return float("inf")
    return float(off(form, there).mean() + np.abs(Solid(mesh).distance(points)).mean()) / 2


@dataclass(frozen=True)
class Outcome:
    """What came of a call: refused with a message, or errors in voxels."""

    options: str
    message: str = ""
    ours: float = float("nan")
    theirs: float = float("nan")
    volume: float = 0.0

    @property
    def verdict(self) -> str:
        """Return "refused", "right", "worse" or "inside out"."""
        if self.message:
            return "refused"
        if self.volume > VOLUME_OFF:
            return "volume"
        return "right" if self.ours <= WORSE * self.theirs + MARGIN else "worse"


NUMBER = r"-?[\d.]+(?:e[+-]?\d+)?"
OPTION = re.compile(
    rf"--(?:(field|inside) (\w+)|(level|scale|offset) ({NUMBER})|(label) (-?\d+)"
    rf"|(spacing) ({NUMBER}(?:,{NUMBER})*|X,Y,Z))"
)


def advised(message: str) -> dict[str, Any]:
    """Return the options that a message names, as ``make_grid`` takes them; the first of each."""
    found: dict[str, Any] = {}
    for groups in OPTION.findall(message):
        name, word = filter(None, groups)
        if name == "spacing":
            numbers = word.split(",")
            found.setdefault(name, "true" if numbers == ["X", "Y", "Z"] else [*map(float, numbers)])
        elif name in ("field", "inside"):
            found.setdefault(name, word)
        else:
            found.setdefault(name, int(word) if name == "label" else float(word))
    if "give --spacing" in message and "spacing" not in found:
        found["spacing"] = "true"
    return found


def call(sample: Kind, options: dict[str, Any], network: Decoder) -> Outcome:
    """Make a mesh, and measure it."""
    named = " ".join(f"{key}={value}" for key, value in options.items())
    told = {"spacing": np.array(sample.steps) * sample.unit, "origin": 0.0, **options}
    offset = told.pop("offset", 0.0)
    if isinstance(told["spacing"], str):
        told["spacing"] = np.array(sample.steps) * sample.unit
    try:
        grid = make_grid(sample.values, **told)
        mesh = reconstruct(grid, network, FACTOR, cap=True, offset=offset)
    except SuperSdfError as problem:
        return Outcome(named, str(problem))
    values, form = level_set(sample, options)
    steps = np.array(sample.steps)
    top = (np.array(values.shape) - 1) * steps
    scale = steps / np.array(grid.spacing)  # an estimate is off by some per cent
    if np.abs(scale * sample.unit - 1).max() > ESTIMATE and told["spacing"] is not None:
        scale = np.full(3, 1 / sample.unit)
    mesh = mesh.transformed(np.diag(scale), np.zeros(3))
    other = closed_isosurface(values.astype(np.float32), steps, 0.0)
    points = on_surface(form, top)
    ours, theirs = (error(m, form, points, top) for m in (mesh, other))
    fine = form(places(2 * np.array(values.shape) - 1, steps / 2)) < 0
    true = max(float(fine.sum() * steps.prod() / 8), 1.0)
    ours_off, theirs_off = (abs(m.volume() / true - 1) for m in (mesh, other))
    return Outcome(named, "", ours, theirs, ours_off - theirs_off)


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
        return f"{last.verdict}: {last.ours:.4f} of {last.theirs:.4f}, volume {last.volume:.2f}"
    wanted = {"mesh": ("right",), "refusal": ("refused",)}.get(sample.ends, ("right", "refused"))
    return "" if last.verdict in wanted else f"ends {last.verdict} {last.message}"


def main() -> None:
    """Print a table of kinds and sizes, and what is wrong."""
    parser = parser_of(__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--only", default="", help="kinds whose names hold this")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--messages", action="store_true")
    options = parser.parse_args()
    network = load_network("base", threads=options.threads)
    wrong = count = 0
    print("| kind | size | call | verdict | voxels off | marching cubes |")
    print("| --- | ---: | --- | --- | ---: | ---: |", flush=True)
    for name, make in KINDS.items():
        if options.only not in name:
            continue
        for size in options.sizes:
            sample = make(size)
            outcomes = list(follow(sample, network))
            for o in outcomes:
                print(f"| {name} | {size} | {o.options} | {o.verdict} | {o.ours:.4f} | "
                      f"{o.theirs:.4f} |", flush=True)  # fmt: skip
                if options.messages and o.message:
                    print("    ", o.message)
            found = problem(sample, outcomes)
            count, wrong = count + 1, wrong + bool(found)
            if found:
                print(f"WRONG {name} {size}: {found}", flush=True)
    print(f"\n{len(KINDS)} kinds, {count} grids, {wrong} wrong")
