"""The coarse input: a regular grid of signed distances and its position in the world."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import NEIGHBOURHOOD, BoolArray, IntArray, Triple
from ..errors import GridError, OptionTypeError, seen
from ..options import FieldKind, Inside, Options
from .interpret import NONE_EXACT, Field, check_size, interpret
from .look import Extremes, Look, border_share, look_at, typical_slope
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

NO_MASK = "a mask holds no distances; make a grid of it with make_grid or read_grid"
MOST_RISE = 1.25  # spacings by which distances change from sample to sample; at most 1


@dataclass(frozen=True, eq=False, init=False, repr=False)
class SdfGrid:
    """Signed distances at the points ``world = origin + direction @ (spacing * (i, j, k))``.

    The constructor expects values that are negative inside and a known spacing, and refuses values
    that contradict either. ``make_grid`` infers the sign, and the spacing if it is not given.

    Parameters
    ----------
    values : (nx, ny, nz) array_like
        Signed distances in world units, negative inside; i runs along x, j along y, k along z
        unless there is a direction. A memory-mapped array or ``SamplePlanes`` are not loaded.
        Of a ``DataArray`` of xarray, the dimensions are x, y and z, in any order.
    spacing : float or three floats
        World distance between neighbouring samples, along each axis of the array.
    origin : float or three floats, optional
        World position of sample (0, 0, 0). Default: 0, 0, 0, or the lowest coordinates of a
        ``DataArray``.
    direction : (3, 3) array_like or nine numbers, optional
        The columns are the world directions of the array's axes: unit vectors, mirrored or not, of
        distances at right angles. Default: i runs along x, j along y, k along z.

    Attributes
    ----------
    values : (nx, ny, nz) array
        All samples, negative inside. Those of a file, or made of others, are loaded on first use
        and stay in memory; ``planes`` reads some of them without that.
    low, high : float
        The smallest and the largest sample, negative inside.
    notes : tuple of str
        Sentences that say what was inferred rather than given.
    field : Field
        What the values are, and which of them can be exact.
    space : str or None
        The anatomical space of the world, "RAS" or "LPS", if a file states one.

    Raises
    ------
    GridError
        If the array is no finite grid of at least 2 samples along each of three axes; if most of
        its border is negative; if the spacing is not positive, the direction no unit vectors, or
        the values change by more than the spacing.
    """

    samples: SampleArray
    spacing: Triple
    origin: Triple
    direction: Direction
    notes: tuple[str, ...]
    low: float
    high: float
    field: Field
    space: str | None = None
    on_sample: tuple[BoolArray, ...] | None = (
        None  # of each axis, if resampled: which planes are samples
    )

    def __init__(
        self,
        values: ArrayLike | SamplePlanes,
        spacing: ArrayLike,
        origin: ArrayLike | None = None,
        direction: ArrayLike | None = None,
    ) -> None:
        samples, _, origin = placed(values, spacing, origin)
        h, look = max(check_spacing(spacing)), _look_at_finite(samples)
        if look.is_two and min(look.shape) > 2:
            raise GridError(f"the only values are {look.low:.6g} and {look.high:.6g}: {NO_MASK}")
        below = border_share(look, lambda x: x < 0)
        if below > 0.5:
            raise GridError(
                f"{below:.0%} of the grid's border is negative, which is inside: make the grid "
                "with make_grid(values, spacing=..., inside='positive'), or inside='negative' if "
                "the solid does run out of the grid there"
            )
        rise = typical_slope(look, np.ones(3))
        if rise > MOST_RISE * h:
            said = f"the values change by {rise:.6g} from sample to sample, but spacing is {h:.6g}"
            raise GridError(f"{said}: give distances in its unit, or use make_grid")
        extremes = look.low, look.high
        grid = self.trusted(samples, spacing, origin, extremes=extremes, direction=direction)
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

        With ``extremes``, the smallest and the largest sample, they are not searched for. Values
        are taken as exact distances unless ``field`` says what they are.
        """
        steps, axes, field = check_spacing(spacing), check_direction(direction), field or Field()
        is_sheared = np.abs(np.transpose(axes) @ np.array(axes) - np.eye(3)).max() > 2 * SKEW
        are_distances = field.kind in ("distance", "noisy")
        if is_sheared and are_distances and not field.own_lattice:
            raise GridError(
                f"direction is {in_rows(axes)}: its axes are not at right angles, and there "
                "distances are not refined; resample the grid, or mesh the spline of the "
                "values (--field smooth)"
            )
        if (is_sheared or not is_cubic(steps)) and not are_distances:
            field = replace(field, own_lattice=True, exact=NONE_EXACT)
        if extremes is None:
            look = _look_at_finite(samples)
            extremes = look.low, look.high
        low, high = extremes
        grid = object.__new__(cls)
        vars(grid).update(
            samples=samples,
            spacing=steps,
            origin=as_triple(0.0 if origin is None else origin, "origin"),
            direction=axes,
            notes=notes,
            low=low,
            high=high,
            field=field,
        )
        return grid

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.shape))
        spacing, origin = (", ".join(f"{x:.6g}" for x in at) for at in (self.spacing, self.origin))
        turned = "" if self.is_straight else f", direction {in_rows(self.direction)}"
        return (
            f"SdfGrid({shape} {self.samples.dtype}, spacing {spacing}, origin {origin}{turned}, "
            f"values {self.low:.6g} to {self.high:.6g})"
        )

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


def _look_at_finite(samples: SampleArray) -> Look:
    """Look at samples; GridError unless they are finite numbers."""
    look = look_at(samples)
    if samples.dtype == np.bool_:
        raise GridError(f"values are true or false: {NO_MASK}")
    if not look.is_finite:
        bad = (np.argwhere(~np.isfinite(plane)) for plane in samples)
        i, (j, k) = next((i, places[0]) for i, places in enumerate(bad) if len(places))
        raise GridError(
            f"values[{i}, {j}, {k}] is {samples[i][j, k]!s}: every sample must be finite; "
            "replace unknown far samples by a large distance of the right sign"
        )
    check_size(look)
    return look


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

    What is not given is inferred.

    Parameters
    ----------
    values : (nx, ny, nz) array_like
        Signed distances in world units; i runs along x, j along y, k along z. Or a mask, labels,
        densities, or another field. Samples far from the surface may be NaN or infinite: unknown.
        A ``DataArray`` of xarray has the dimensions x, y and z, in any order, and evenly spaced
        coordinates, increasing or decreasing, or none; others of length 1 are left out.
    spacing : number or three, optional
        World distance between neighbouring samples. Default: that of the coordinates of a
        ``DataArray``, else estimated from the gradient.
    origin : number or three, optional
        World position of sample (0, 0, 0). Default: the lowest coordinates of a ``DataArray``, else
        0, 0, 0.
    direction : (3, 3) array_like or nine numbers, optional
        The columns are the world directions of the array's axes; see ``SdfGrid``.
    inside : {"auto", "negative", "positive"}
        Sign of the values inside the solid; "auto" takes the border of the grid as outside.
    field : {"auto", "distance", "noisy", "mask", "smooth"}
        What the values are; "auto" goes by what the samples show. Of a mask only the sides of the
        samples are known; a smooth field has the surface of its cubic spline, without a network.
    label : int, optional
        The samples with this value are the solid; from -2^63 to 2^64 - 1.
    level : number, optional
        The values are densities, and the surface is where they have this value; what is above is
        inside, unless ``inside`` is "negative".
    scale : number, optional
        World units per unit of the values, if they have another unit than the spacing.
    unknown : number, optional
        Samples with this value are unknown, as those that are NaN.
    hint : {"", "labels", "density", "distance"}
        What a file says that the values are; "field", "label" and "level" win over it.

    Returns
    -------
    SdfGrid
        The grid, negative inside; its ``notes`` say what was inferred.

    Raises
    ------
    GridError
        If the values have no surface, or contradict the spacing; if the dimensions or coordinates
        of a ``DataArray`` are not as above.
    OptionError
        If ``inside`` or ``field`` is not one of these, or another option is no number.
    """
    told: dict[str, Any] = {"label": label, "level": level, "scale": scale, "unknown": unknown}
    wanted = Options(inside=inside, field=field, **told)
    samples, spacing, origin = placed(values, spacing, origin)
    taken = interpret(samples, wanted, spacing, hint)
    if origin is None:
        taken["notes"] += ("origin not given: sample (0, 0, 0) is at 0, 0, 0",)
        origin = 0.0
    return SdfGrid.trusted(origin=origin, direction=direction, **taken)


def check_grid(grid: Any) -> SdfGrid:
    """Return a grid; OptionTypeError if it is no ``SdfGrid``, but an array or a path, say."""
    if not isinstance(grid, SdfGrid):
        what = f"an array of shape {grid.shape}" if isinstance(grid, np.ndarray) else seen(grid)
        raise OptionTypeError(
            f"grid is {what}: make one with make_grid(values, spacing=...) or read_grid(path)"
        )
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
    known = grid.on_sample
    return with_fields(
        grid,
        samples=cropped(grid.samples, low, high),
        origin=as_triple(grid.to_world(low), "origin"),
        field=replace(grid.field, unseen=unseen),
        on_sample=known and tuple(axis[a:b] for axis, a, b in zip(known, low, high)),
    )


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
    volume = np.prod(grid.spacing) * abs(np.linalg.det(grid.direction))
    return float(volume ** (1 / 3))


def cubic_grid(grid: SdfGrid, offset: float = 0.0) -> SdfGrid:
    """Return a grid on the lattice that is refined: itself if cubic or on its ``own_lattice``.

    A grid with the same spacing on all axes is refined as it is. Of others, the coarser axes are
    resampled to the finest spacing, the coarsest last: the finer the others are, the better they
    tell its slopes. Masks, and fields that are meshed by their spline, need no cubes: a solid
    stretched along an axis is as good a solid, and the mesh gets its spacings at the end.

    Other samples are made when they are read. Only values near the offset of the surface are as
    accurate as they can be. GridError if there is an offset, and the values are no distances.
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
    known = [np.ones(count, bool) for count in grid.shape]
    for axis in np.argsort(grid.spacing, kind="stable").tolist():
        if steps[axis] > h * (1 + EQUAL_SPACING):
            coarser.append(f"{AXES[axis]} from {steps[axis]:.6g}")
            samples = Resampled(samples, (steps[0], steps[1], steps[2]), axis, h, offset)
            steps[axis], known[axis] = h, samples.on_sample
    note = (
        "the spacing differs between axes: the values are resampled along "
        f"{' and '.join(sorted(coarser))} to {h:.6g}, the finest, to "
        f"{' x '.join(map(str, samples.shape))} samples"
    )
    more = {"notes": (*grid.notes, note), "on_sample": tuple(known)}
    return with_fields(grid, samples=samples, spacing=(steps[0], steps[1], steps[2]), **more)


def which_sampled(grid: SdfGrid, voxel_ijk: IntArray) -> tuple[BoolArray, NDArray[np.intp]]:
    """Return which values of a cubic grid, at (n, 3) indices, are samples, not interpolated.

    And the places of ``NEIGHBOURHOOD`` round these that hold samples, too: across resampled axes.
    """
    known, across = np.ones(len(voxel_ijk), bool), np.ones(27, bool)
    for axis, is_sample in enumerate(grid.on_sample or ()):
        known &= is_sample[voxel_ijk[:, axis]]
        across &= is_sample.all() | (NEIGHBOURHOOD[:, axis] == 0)
    return known, np.flatnonzero(across)
