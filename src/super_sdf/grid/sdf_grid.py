"""The coarse input: a regular grid of signed distances and its position in the world."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Triple
from ..errors import GridError, OptionError, OptionTypeError, in_python, seen
from ..options import FieldKind, Inside, Options
from .interpret import NONE_EXACT, Field, interpret
from .look import Extremes
from .samples import (
    AXES,
    EQUAL_SPACING,
    SKEW,
    STRAIGHT,
    Direction,
    Index,
    SampleArray,
    SamplePlanes,
    as_triple,
    check_direction,
    check_spacing,
    cropped,
    in_rows,
    is_cubic,
    placed,
    steps_of,
)


@dataclass(frozen=True, eq=False, init=False, repr=False)
class SdfGrid:
    """Signed distances at the points ``world = origin + direction @ (spacing * (i, j, k))``.

    ``SdfGrid(values, spacing, origin, direction)`` calls ``make_grid``; all else is inferred.

    Attributes
    ----------
    values : (nx, ny, nz) array
        All samples, negative inside. Samples in a file, or computed from others, are loaded on
        first use and stay in memory; ``planes`` reads some planes without loading all.
    low, high : float
        The smallest and the largest sample, negative inside.
    field : Field
        The kind of the values, and which values can be exact.
    space : str or None
        The anatomical space of the world, "RAS" or "LPS", if a file states one.
    """

    samples: SampleArray
    spacing: Triple
    origin: Triple
    direction: Direction
    flagged: tuple[str, ...]  # notes, with the flags of the command line
    low: float
    high: float
    field: Field
    space: str | None = None
    is_resampled: bool = False  # values between samples are interpolated

    def __init__(
        self,
        values: ArrayLike | SamplePlanes,
        spacing: ArrayLike,
        origin: ArrayLike | None = None,
        direction: ArrayLike | None = None,
    ) -> None:
        grid = make_grid(values, spacing=spacing, origin=origin, direction=direction)
        vars(self).update(vars(grid))

    @classmethod
    def trusted(
        cls,
        samples: SampleArray,
        spacing: ArrayLike,
        origin: ArrayLike | None = None,
        notes: tuple[str, ...] = (),
        *,
        extremes: Extremes | None = None,
        direction: ArrayLike | None = None,
        field: Field | None = None,
    ) -> SdfGrid:
        """Return a grid whose sign and spacing are known and not checked against the values.

        ``extremes``, the smallest and the largest sample, saves the search for them. Values are
        taken as exact distances unless ``field`` states another kind.
        """
        steps, axes, field = check_spacing(spacing), check_direction(direction), field or Field()
        is_sheared = np.abs(np.transpose(axes) @ np.array(axes) - np.eye(3)).max() > 2 * SKEW
        are_distances = field.kind in ("distance", "noisy")
        if is_sheared and are_distances and not field.own_lattice:
            raise GridError(
                f"direction is {in_rows(axes)}: its axes are not at right angles, and there "
                "distances are not refined; mesh the spline of the values (--field smooth)"
            )
        if (is_sheared or not is_cubic(steps)) and not are_distances:
            field = replace(field, own_lattice=True, exact=NONE_EXACT)
        if extremes is None:
            each = [(plane.min(), plane.max()) for plane in samples]
            extremes = float(np.min(each)), float(np.max(each))
        first = as_triple(0.0 if origin is None else origin, "origin")
        place = {"spacing": steps, "origin": first, "direction": axes, "flagged": notes}
        values = {"samples": samples, "low": extremes[0], "high": extremes[1], "field": field}
        return with_fields(object.__new__(cls), **place, **values)

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.shape))
        spacing, origin = (", ".join(f"{x:.6g}" for x in at) for at in (self.spacing, self.origin))
        turned = "" if self.is_straight else f", direction {in_rows(self.direction)}"
        return (
            f"SdfGrid({shape} {self.samples.dtype}, spacing {spacing}, origin {origin}{turned}, "
            f"values {self.low:.6g} to {self.high:.6g})"
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences that say what was inferred rather than given."""
        return tuple(map(in_python, self.flagged))

    @property
    def values(self) -> NDArray[Any]:
        """All samples, negative inside."""
        whole: NDArray[Any] = np.asanyarray(self.samples)
        return whole

    def planes(self, first: int, last: int) -> NDArray[Any]:
        """Return the samples with first <= i < last, negative inside, (last - first, ny, nz)."""
        return self.samples[first:last]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of samples along x, y and z."""
        nx, ny, nz = self.samples.shape
        return nx, ny, nz

    @property
    def voxel_size(self) -> float:
        """The spacing h of the lattice that is refined, in world units: the finest one."""
        return min(steps_of(self.spacing))

    @property
    def is_cubic(self) -> bool:
        """Whether the spacing is the same on all axes, up to 0.1 %."""
        return is_cubic(self.spacing)

    @property
    def is_straight(self) -> bool:
        """Whether the array's axes run along the world's: the direction is the identity."""
        return self.direction == STRAIGHT

    @property
    def is_mirrored(self) -> bool:
        """Whether the array's axes are left-handed in the world."""
        return bool(np.linalg.det(np.array(self.direction)) < 0)

    @property
    def reach(self) -> float:
        """The largest coordinate of the grid in the world, about."""
        sides = np.array(self.spacing) * self.shape
        return float((np.abs(self.origin) + np.abs(self.direction) @ sides).max())

    def to_world(self, ijk: ArrayLike) -> NDArray[np.float64]:
        """Return the world positions (..., 3) of indices (..., 3), which need not be whole."""
        along = np.asarray(ijk, np.float64) * np.array(self.spacing)
        turned = along if self.is_straight else along @ np.array(self.direction).T
        world: NDArray[np.float64] = turned + np.array(self.origin)
        return world

    def to_index(self, world: NDArray[Any]) -> NDArray[np.float64]:
        """Return world positions (n, 3) in spacings from sample (0, 0, 0)."""
        along = world - np.array(self.origin)
        turned = along if self.is_straight else np.linalg.solve(self.direction, along.T).T
        places: NDArray[np.float64] = turned / np.array(self.spacing)
        return places


def make_grid(
    values: ArrayLike | SamplePlanes,
    *,
    spacing: ArrayLike | None = None,
    origin: ArrayLike | None = None,
    direction: ArrayLike | None = None,
    inside: Inside = "auto",
    field: FieldKind = "auto",
    label: int | None = None,
    level: float | None = None,
    scale: float | None = None,
    unknown: float | None = None,
    hint: str = "",
) -> SdfGrid:
    """Make a grid from an array of signed distances, or of other values with a surface.

    Parameters that are not given are inferred.

    Parameters
    ----------
    values : (nx, ny, nz) array_like
        Signed distances in world units; i runs along x, j along y, k along z. Or a mask, labels,
        densities, or another field. Samples far from the surface may be NaN or infinite: unknown.
        A ``DataArray`` of xarray has the dimensions x, y and z, in any order, further dimensions
        of length 1, and evenly spaced coordinates, increasing or decreasing, or none.
    spacing : number or three, optional
        World distance between neighbouring samples. Default: from the coordinates of a
        ``DataArray``, else estimated from the gradient.
    origin : number or three, optional
        World position of sample (0, 0, 0). Default: the lowest coordinates of a ``DataArray``, else
        0, 0, 0.
    direction : (3, 3) array_like or nine numbers, optional
        The columns are unit vectors, the world directions of the array's axes; orthogonal for
        distances, mirrored or not. Default: i runs along x, j along y, k along z.
    inside : {"auto", "negative", "positive"}
        Sign of the values inside the solid; "auto" takes the border of the grid as outside.
    field : {"auto", "distance", "noisy", "mask", "smooth"}
        The kind of the values; "auto" recognises the kind. Of a mask only the signs are used; a
        smooth field has the surface of its cubic spline, without a network.
    label : int, optional
        The samples with this value are the solid; from -2^63 to 2^64 - 1.
    level : number, optional
        The values are densities, and this value is on the surface; larger values are inside, unless
        ``inside`` is "negative".
    scale : number, optional
        World units per unit of the values, if values and spacing have different units.
    unknown : number, optional
        Samples with this value are unknown, like NaN.
    hint : {"", "labels", "density", "distance"}
        The kind of values that a file states; overruled by ``field``, ``label`` and ``level``.

    Returns
    -------
    SdfGrid
        The grid, negative inside; its ``notes`` say what was inferred.

    Raises
    ------
    GridError
        If the values have no surface, or contradict the spacing; if the dimensions or coordinates
        of a ``DataArray`` are not as described.
    OptionError
        If ``inside`` or ``field`` is not one of these values, or another option is not a number.
    """
    told: dict[str, Any] = {"label": label, "level": level, "scale": scale, "unknown": unknown}
    wanted = Options(inside=inside, field=field, **told)
    samples, spacing, origin = placed(values, spacing, origin)
    taken = interpret(samples, wanted, spacing, hint)
    if origin is None:
        taken["notes"] += ("origin not given: sample (0, 0, 0) is at 0, 0, 0",)
        origin = 0.0
    return SdfGrid.trusted(origin=origin, direction=direction, **taken)


def as_grid(grid: Any, **told: Any) -> SdfGrid:
    """Return a grid, of which nothing is told, or that which ``make_grid`` makes of an array."""
    if grid is None or isinstance(grid, (str, PathLike)):
        make = "make one with make_grid(values, spacing=...) or read_grid(path)"
        raise OptionTypeError(f"grid is {seen(grid)}: {make}")
    if not isinstance(grid, SdfGrid):
        return make_grid(grid, **told)
    for name, value in told.items():
        if not (value is None or (isinstance(value, str) and value == "auto")):
            raise OptionError(f"{name} is for arrays: a grid or function has its own, leave it out")
    return grid


def with_fields(grid: SdfGrid, **fields: Any) -> SdfGrid:
    """Return a grid with other fields, taken as they are."""
    other = copy(grid)
    vars(other).update(fields)
    return other


def crop(grid: SdfGrid, low: Index, high: Index) -> SdfGrid:
    """Return the samples from index ``low`` (3,) to before ``high`` as a grid at their place.

    What the values are stays decided, and so do their extremes.
    """
    unseen = grid.field.unseen
    unseen = None if unseen is None else cropped(unseen, low, high)
    field, origin = replace(grid.field, unseen=unseen), as_triple(grid.to_world(low), "origin")
    return with_fields(grid, samples=cropped(grid.samples, low, high), origin=origin, field=field)


def describe_place(grid: SdfGrid) -> dict[str, Any]:
    """Return where the samples of a grid lie, for JSON."""
    names = ("shape", "spacing", "origin", "direction", "space")
    return {name: getattr(grid, name) for name in names}


def volume_of_samples(grid: SdfGrid, offset: float = 0.0) -> float:
    """Return the volume of the samples inside, each of which counts as a box."""
    inside = sum(int(np.count_nonzero(plane <= offset)) for plane in grid.samples)
    return inside * mean_spacing(grid) ** 3


def mean_spacing(grid: SdfGrid) -> float:
    """Return the edge of a cube with the volume of a box round a sample."""
    return float((np.prod(grid.spacing) * abs(np.linalg.det(grid.direction))) ** (1 / 3))


def cubic_grid(grid: SdfGrid, offset: float = 0.0) -> SdfGrid:
    """Return a grid on the lattice that is refined: itself if cubic or on its ``own_lattice``.

    Of others, the coarser axes are resampled to the finest spacing when planes are read. Only
    values near the offset of the surface are as accurate as they can be. Masks, and fields that are
    meshed by their spline, need no cubes: the mesh gets their spacings at the end. GridError if
    there is an offset, and the values are no distances.
    """
    if offset and grid.field.own_lattice:
        each = ", ".join(f"{h:g}" for h in grid.spacing)
        raise GridError(
            f"offset {offset:g}: the values are taken as {grid.field.kind}, and with the spacing "
            f"{each} they are no distances by which an offset surface could be found; mesh the "
            "solid itself (--offset 0), sample the mesh (super-sdf sample), and mesh that grid "
            "with the offset"
        )
    if grid.is_cubic or grid.field.own_lattice:
        return grid
    if grid.field.unseen is not None:
        raise GridError(
            "samples beside the surface are unknown, and the spacing differs between axes: mesh "
            "the spline of the values (--field smooth)"
        )
    from .derived import Resampled  # imported here, as few need it

    samples, h, steps, coarser = grid.samples, grid.voxel_size, list(grid.spacing), list[str]()
    for axis in np.argsort(steps, kind="stable").tolist():  # finer axes bound the coarser ones
        if steps[axis] > h * (1 + EQUAL_SPACING):
            coarser.append(f"{AXES[axis]} from {steps[axis]:.6g}")
            samples = Resampled(samples, as_triple(steps, "spacing"), axis, h, offset)
            steps[axis] = h
    along, shape = " and ".join(sorted(coarser)), " x ".join(map(str, samples.shape))
    note = (
        f"the spacing differs between axes: the values are resampled along {along} to {h:.6g}, the "
        f"finest, to {shape} samples"
    )
    more = {"spacing": as_triple(steps, "spacing"), "flagged": (*grid.flagged, note)}
    return with_fields(grid, samples=samples, is_resampled=True, **more)
