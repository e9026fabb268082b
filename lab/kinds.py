"""Kinds of grids that are not exact distances, and what is done with them: by us, and by others.

``KINDS`` is the table: to measure another kind, made from the exact samples of a case, add an entry
to it. Meshes are closed: beyond the border of a grid everything is outside.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from super_sdf.arrays import FloatArray
from super_sdf.errors import GridError
from super_sdf.grid.sdf_grid import make_grid
from super_sdf.network.contract import Decoder
from super_sdf.pipeline import reconstruct

from .shapes import FIELD_NOISE, Case
from .surfaces import EMPTY, Surface, closed_isosurface, interpolate_spline, stretched

Array = NDArray[Any]
Spacing = NDArray[np.float64]

CUTS = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0)  # voxels
INTEGERS = 30_000.0  # of the diagonal, in steps of whole numbers of 16 bits
RATIOS = (1.5, 5.0)  # of the coarse spacing to the others
WIDTHS = (0.5, 0.8, 1.2)  # voxels, of the Gaussians by which masks are smoothed
DISTANCES = ("mc", "bspline", "ours")
MASKS = ("mc", "mc-distances", *(f"mc-gaussian-{width:g}" for width in WIDTHS), "ours")
AXES = "xyz"


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of grid, and what is done with it."""

    group: str  # exact, mask, truncated, scaled, density, noisy or unequal
    title: str  # kinds with the same title share their rows
    make: Callable[[Case], Array]  # values as they stand in a user's file
    methods: tuple[str, ...] = DISTANCES  # by the names in ``BY_METHOD``
    level: float | None = None  # for other methods; above it is inside; else distances
    options: Mapping[str, Any] = field(default_factory=dict)  # what the user says
    unit: float | None = None  # of distances whose spacing the user does not know
    ratio: float = 1.0  # the spacing along ``axis`` over that along the others
    axis: str = ""

    @property
    def name(self) -> str:
        """What the kind is called in ``KINDS`` and in the rows of an evaluation."""
        return f"{self.title}, {self.axis}" if self.axis else self.title


@lru_cache(maxsize=1)
def samples_of(kind: Kind, case: Case) -> tuple[Array, Spacing, Spacing]:
    """Return values (nx, ny, nz), spacing (3,) and the position of sample (0, 0, 0).

    The methods of a kind follow one another, so the samples of one kind are kept.
    """
    values = kind.make(case)
    spacing = case.side / np.array(values.shape)
    return values, spacing, case.low + spacing / 2


def level_set(kind: Kind, values: Array) -> FloatArray:
    """Return what the other methods mesh at 0, negative inside, float32.

    Unknown values (NaN) are those of the nearest known sample.
    """
    signed = values if kind.level is None else kind.level - values.astype(np.float32)
    return without_unknown(np.asarray(signed, np.float32))


def without_unknown(values: FloatArray) -> FloatArray:
    """Return values with each NaN replaced by that of the nearest sample that has none."""
    unknown = np.isnan(values)
    if not unknown.any():
        return values
    nearest = ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return values[tuple(nearest)]


def saturating(case: Case) -> Array:
    """Return w tanh(d/w) of distances d, w two voxels: slope 1 at the surface, less beyond."""
    width = np.float32(2 * case.spacing)
    return width * np.tanh(case.coarse / width)


def varying(case: Case) -> Array:
    """Return distances times a smooth factor of the position, .5 to 1.5, in two waves."""
    place = (np.indices(case.coarse.shape).sum(0) + 1.5) / case.setting.size
    return (case.coarse * (1 + 0.5 * np.sin(4 * np.pi * place))).astype(np.float32)


def noisy(case: Case, *, amplitude: float) -> Array:
    """Return distances with uniform noise of an amplitude in voxels."""
    random = np.random.default_rng((*case.shape.seed, FIELD_NOISE))
    noise = random.uniform(-amplitude, amplitude, case.coarse.shape) * case.spacing
    return (case.coarse + noise).astype(np.float32)


def unequal(case: Case, *, ratio: float, axis: str) -> Array:
    """Return exact distances at the case's samples along an axis, and more along the others."""
    size = case.setting.size
    shape = [size if letter == axis else round(size * ratio) for letter in AXES]
    layers = []
    for plane in range(shape[0]):
        ijk = np.indices((1, *shape[1:])).reshape(3, -1).T + np.array([plane, 0, 0])
        points = ((ijk + 0.5) / shape - 0.5) * case.side
        layers.append(case.shape.solid.signed_distance(points).reshape(shape[1:]))
    return np.stack(layers).astype(np.float32)


def truncated_kind(title: str, inside: float, outside: float) -> Kind:
    return Kind("truncated", f"cut off at {title}", lambda case: np.clip(
        case.coarse, -inside * case.spacing, outside * case.spacing))  # fmt: skip


HALF: dict[str, Any] = {"level": 0.5, "options": {"level": 0.5}}
PERCENT = np.float32(0.01)
ALL_KINDS = (
    Kind("exact", "exact", lambda case: case.coarse),
    Kind("mask", "mask", lambda case: (case.coarse <= 0).astype(np.uint8), MASKS, level=0.5),
    *(truncated_kind(f"{cut:g}", cut, cut) for cut in CUTS),
    truncated_kind("-1 and 2.5", 1.0, 2.5),
    Kind("truncated", "unknown beyond 2", lambda case: np.where(
        np.abs(case.coarse) <= 2 * case.spacing, case.coarse, np.float32(np.nan))),
    Kind("scaled", "d/100, no spacing given", lambda case: case.coarse * PERCENT, unit=0.01),
    Kind("scaled", "d/100, spacing and scale given", lambda case: case.coarse * PERCENT,
         options={"scale": 100}),
    Kind("exact", "int16, no spacing given", lambda case: np.rint(
        case.coarse * INTEGERS).astype(np.int16), unit=INTEGERS),
    Kind("scaled", "2h tanh(d/2h)", saturating),
    # monotone, since no distance inside is beyond half of the side
    Kind("scaled", "d + d^2", lambda case: case.coarse + case.coarse**2 / np.float32(case.side)),
    Kind("scaled", "d times 0.5 to 1.5", varying),
    Kind("density", "1/(1 + exp(d/h))", lambda case: (
        0.5 - 0.5 * np.tanh(case.coarse / (2 * case.spacing))).astype(np.float32), **HALF),
    Kind("density", "share of the voxel", lambda case: np.clip(
        0.5 - case.coarse / case.spacing, 0, 1).astype(np.float32), **HALF),
    *(Kind("noisy", f"noise of {n:g}", partial(noisy, amplitude=n)) for n in (0.1, 0.25)),
    *(Kind("unequal", f"spacing 1:1:{ratio:g}", partial(unequal, ratio=ratio, axis=axis),
           ("mc", "ours"), ratio=ratio, axis=axis) for ratio in RATIOS for axis in AXES),
)  # fmt: skip
KINDS = {kind.name: kind for kind in ALL_KINDS}


# What is done with the values of a kind.


def coarse_surface(
    kind: Kind, case: Case, network: Decoder, change: Callable[[Array], FloatArray] | None = None
) -> Surface:
    values, spacing, origin = samples_of(kind, case)
    found = change(values) if change else level_set(kind, values)
    return Surface(closed_isosurface(found, spacing, origin))


def transformed(mask: Array) -> FloatArray:
    """Return SciPy's distances of a mask, in voxels, half a voxel less on either side."""
    out, into = (ndimage.distance_transform_edt(side) for side in (mask == 0, mask > 0))
    return np.where(mask > 0, 0.5 - into, out - 0.5).astype(np.float32)


def spline_of_kind(kind: Kind, case: Case, network: Decoder) -> Surface:
    """Mesh the cubic B-spline of the values at the fine nodes."""
    found = interpolate_spline(level_set(kind, samples_of(kind, case)[0]), case.factor, 3)
    return Surface(closed_isosurface(found, case.fine, case.low))


def our_surface_of_kind(kind: Kind, case: Case, network: Decoder) -> Surface:
    """Mesh the values with super-sdf, as a user of the command would.

    ``facts``: what they were taken as, or the refusal. Without a spacing, in units of the values.
    """
    values, spacing, origin = samples_of(kind, case)
    placed = {"spacing": spacing, "origin": origin} if kind.unit is None else {}
    try:
        grid = make_grid(values, **kind.options, **placed)
        mesh = reconstruct(grid, network, factor=case.factor)
    except GridError as problem:
        return Surface(EMPTY, facts={"refused": str(problem)})
    facts = {"taken_as": grid.field.kind}
    return Surface(mesh if placed else stretched(mesh, 1 / kind.unit, origin), facts=facts)


BY_METHOD: dict[str, Callable[[Kind, Case, Decoder], Surface]] = {
    "mc": coarse_surface,
    "mc-distances": partial(coarse_surface, change=transformed),
    **{f"mc-gaussian-{width:g}": partial(coarse_surface, change=lambda mask, width=width: (
        0.5 - ndimage.gaussian_filter(mask.astype(np.float32), width, mode="nearest")))
       for width in WIDTHS},
    "bspline": spline_of_kind,
    "ours": our_surface_of_kind,
}  # fmt: skip
