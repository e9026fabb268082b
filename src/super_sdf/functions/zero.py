"""Vertices put where a function is 0, and onto its edges.

1. A vertex goes along its normal: a Newton step, then a secant step.
2. Where that does not lead to the surface, it goes down the gradient, which changes at an edge.
   Where values are no distances, the sign changes along the normal instead, up to four spacings on.
3. Where triangles turn, the vertex goes to where the planes of the surface beside it meet.

The lattice says how the surface is joined, so triangles stay as they are: but for the second half
of 2, a vertex moves by at most half a fine spacing, and only if it finds the surface.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, Numbers, Vectors, dot, face_normals, length, sums_at, unit
from ..errors import OptionError
from ..grid.sdf_grid import SdfGrid
from ..surface.mesh import Mesh
from ..surface.sharp.folds import intersecting, overlapping_boxes
from .function import DistanceFunction

Value: TypeAlias = Callable[[Vectors], Numbers]

REACH = 0.5  # fine spacings that a vertex may move
STEP = 0.02  # fine spacings in which slopes are measured
GOOD = 1e-4  # fine spacings from the surface at which a vertex needs no other step
HALF_WAY, BACK_ROUNDS = 3, 8  # rounds in which what folds goes half way back, and all
ONE_WAY = 0.1  # least cosine by which a triangle may have turned
IN_PLANE, TOUCHING = 1e-7, 1e-5  # fine spacings off a plane, and by which triangles may overlap
FLAT = 1e-6  # twice the area of triangles, in squared fine spacings, whose vertices may coincide
COMPARED, MOST_OTHER = 1000, 0.25  # samples at which function and grid are compared
FARTHEST, TRIES = 4.0, 12  # fine spacings to a surface that is found by its change of sign
ROUNDS = 4  # of steps along the gradient
REACHED = 0.25  # of the value at the start, above which the surface is not in reach
TURNED = 0.96592  # cosine of 15 degrees: triangles at 30 are half of it from their mean
LEAST_AREA = 0.02  # of triangles whose normals count, in squared fine spacings
STAY = 1e-3  # weight of the vertex itself beside that of a plane, in least squares
EXACT_TO = 2.0  # spacings from the surface: values that are cut off farther away are distances
NEAR = 0.05  # fine spacings from the surface at which the planes' point is taken
MOST_OFF = 0.05  # of vertices not so near: 0 on a torus, .01 to .03 on boxes, .1 to .9 on others


@np.errstate(invalid="ignore", over="ignore", divide="ignore")  # values may be infinite
def put_on_zero(
    mesh: Mesh, function: Callable[[Vectors], Any], grid: SdfGrid, factor: int, offset: float = 0.0
) -> tuple[Mesh, list[str]]:
    """Return a mesh with the vertices moved to where a function is 0, or has an ``offset``.

    And how many did not reach it, in words, if many. On the border of the grid vertices stay.
    OptionError if there is an offset, but no distance.
    """
    if offset and not grid.field.has_exact:
        raise OptionError(f"offset is {offset:g}: the function is no distance, leave it out")
    fine, shape, at = grid.voxel_size / factor, np.array(grid.shape), DistanceFunction(function)
    scale = unit_of(at, grid)
    middle, kind = grid.to_world((shape - 1) / 2), mesh.vertices.dtype

    def value(points: Vectors) -> Numbers:
        """Return values at points, both in fine spacings, so that slopes of distances are 1."""
        return (at(middle + fine * points) / scale - offset) / fine

    def written(points: Vectors) -> NDArray[Any]:
        return (middle + fine * points).astype(kind)

    start = (mesh.vertices - middle) / fine
    from_border = shape / 2 - np.abs(grid.to_index(mesh.vertices) - (shape - 1) / 2)
    free: BoolArray = np.all(from_border > REACH / factor, axis=1)
    exact = np.abs(grid.field.exact).min() > EXACT_TO * grid.voxel_size
    points, near = put_on_surface(value, start, mesh.faces, free, exact=exact)
    at_first, points = points, put_on_edges(value, points, mesh.faces, free)
    points = without_folds(points, start, mesh.faces, lambda p: (written(p) - middle) / fine)
    rows = np.flatnonzero(free & ~(near & (points == at_first).all(1)))
    aside = NEAR * normals_at(points, mesh.faces)[rows]
    off = np.count_nonzero(value(points[rows] + aside) * value(points[rows] - aside) > 0)
    said = f"{off:,} of {len(points):,} vertices did not reach the surface of the function, as on "
    said += "edges that meet others, or if it is no distance: give a finer spacing"
    return Mesh(written(points), mesh.faces), [said] * bool(off > MOST_OFF * len(points))


def unit_of(function: DistanceFunction, grid: SdfGrid) -> float:
    """Return the function's value for a distance of 1, negative inside, at the grid's samples.

    OptionError if it has another side than many of the samples near the surface.
    """
    near = np.argwhere(np.abs(grid.values) < 2 * grid.voxel_size)
    near = near[:: max(len(near) // COMPARED, 1)]
    ratios = function(grid.to_world(near)) / grid.values[tuple(near.T)]
    ratios = ratios[np.isfinite(ratios)]
    ratio = float(np.median(ratios)) if len(ratios) else 1.0
    other = np.count_nonzero(ratios * np.sign(ratio) < 0) / max(len(ratios), 1)
    if other > MOST_OTHER or ratio == 0:
        where = f"at {other:.0%} of the samples near the surface"
        way_out = "give the function that the grid has samples of"
        raise OptionError(f"function has another side than the grid {where}: {way_out}")
    return ratio


def put_on_surface(
    value: Value, start: Vectors, faces: NDArray[Any], free: BoolArray, *, exact: bool
) -> tuple[Vectors, BoolArray]:
    """Return points (n, 3), the ``free`` ones where values are 0, if in reach, and if they are."""
    rows, near = np.flatnonzero(free), np.zeros(len(start), bool)
    normals = normals_at(start, faces)[rows]
    points, start = start.copy(), start[rows]
    before, slope = value(start), np.ones(len(rows))
    if not exact:
        slope = (value(start + STEP * normals) - before) / STEP
    found, off = step_along(value, start, before, normals, slope)
    left = np.abs(off) > GOOD * np.abs(slope)
    if not exact:  # saturated values show from afar to half a spacing only where the surface is
        far = np.abs(off) > REACHED * np.abs(before)
        points[rows[far]] = cross_over(value, start[far], before[far], normals[far])
        left &= ~far
    found[left], off[left] = step_down(value, start[left], before[left])
    reached = np.abs(off) <= REACHED * np.abs(before)
    points[rows[reached]] = found[reached]
    near[rows] = np.abs(off) <= GOOD * np.abs(slope)
    return points, near


def normals_at(points: Vectors, faces: NDArray[Any]) -> Vectors:
    """Return the normals of a surface at its vertices (n, 3)."""
    normals = np.repeat(face_normals(points, faces), 3, axis=0)
    return unit(sums_at(faces.ravel(), normals, len(points)))


def step_along(
    value: Value, start: Vectors, before: Numbers, direction: Vectors, slope: Numbers
) -> tuple[Vectors, Numbers]:
    """Return points (n, 3) nearer to 0 along directions, and the values there, (n,).

    ``before`` are the values at the start. A Newton step with a ``slope`` along the direction, then
    a secant step from both values.
    """
    way = np.clip(np.nan_to_num(-before / slope), -REACH, REACH)
    after = value(start + way[:, None] * direction)
    second = np.clip(np.nan_to_num(way - after * way / (after - before)), -REACH, REACH)
    again = np.flatnonzero(np.abs(after) > GOOD * np.abs(slope))
    last = value(start[again] + second[again, None] * direction[again])
    closer = np.abs(last) < np.abs(after[again])
    way[again[closer]], after[again[closer]] = second[again[closer]], last[closer]
    return start + way[:, None] * direction, after


def cross_over(value: Value, start: Vectors, before: Numbers, normals: Vectors) -> Vectors:
    """Return points (n, 3) where values change sign along normals, those at the start if nowhere.

    The surface is sought in doubled steps, to the side that the sign says, and then by halving.
    """
    ways = -np.sign(before)[:, None] * normals
    low, high = np.zeros(len(start)), np.full(len(start), np.inf)
    for _ in range(TRIES):
        middle = np.minimum((low + high) / 2, np.clip(2 * low, REACH, FARTHEST))
        crossed = value(start + middle[:, None] * ways) * before <= 0
        low, high = np.where(crossed, low, middle), np.where(crossed, middle, high)
    return start + np.where(np.isfinite(high), (low + high) / 2, 0)[:, None] * ways


def step_down(value: Value, start: Vectors, before: Numbers) -> tuple[Vectors, Numbers]:
    """Return points (n, 3) nearer to 0, and the values there, (n,), by steps along the gradient.

    Outside an edge that is the gradient of one face, then of the other.
    """
    at, now = start.copy(), before.copy()
    for _ in range(ROUNDS):
        slopes = gradient(value, at, now)
        way = np.clip(np.nan_to_num(-now / length(slopes)), -REACH, REACH)
        shift = at + way[:, None] * unit(slopes) - start
        new = start + np.minimum(length(shift), REACH)[:, None] * unit(shift)
        there = value(new)
        closer = np.abs(there) < np.abs(now)
        at[closer], now[closer] = new[closer], there[closer]
    return at, now


def put_on_edges(value: Value, points: Vectors, faces: NDArray[Any], free: BoolArray) -> Vectors:
    """Return points (n, 3), ``free`` ones of edges where the planes of points beside them meet."""
    edges = is_on_edge(points, faces)
    one, other = faces.ravel(), np.roll(faces, -1, 1).ravel()
    one, other = np.concatenate([one, other]), np.concatenate([other, one])
    pairs = edges[one] & free[one] & free[other] & ~edges[other]
    rows, at = np.unique(one[pairs], return_inverse=True)
    known, beside = np.unique(other[pairs], return_inverse=True)
    normals = unit(gradient(value, points[known], value(points[known])))[beside]
    heights = dot(normals, points[known][beside] - points[rows][at])
    squares = (normals[:, :, None] * normals[:, None]).reshape(-1, 9)
    matrix = sums_at(at, squares, len(rows)).reshape(-1, 3, 3) + STAY * np.eye(3)
    vector = sums_at(at, heights[:, None] * normals, len(rows))
    shift = np.linalg.solve(matrix, vector[..., None])[..., 0]
    moved, points = points[rows] + shift, points.copy()
    better = (np.abs(value(moved)) < NEAR) & (np.abs(shift).max(1) < REACH)
    points[rows[better]] = moved[better]
    return points


def is_on_edge(points: Vectors, faces: NDArray[Any]) -> BoolArray:
    """Return at which points, (n,), triangles turn by 30 degrees."""
    normals = face_normals(points, faces)
    large = length(normals) > 2 * LEAST_AREA
    corners, normals = faces[large].ravel(), np.repeat(unit(normals[large]), 3, axis=0)
    mean = unit(sums_at(corners, normals, len(points)))
    turned: BoolArray = np.zeros(len(points), bool)
    turned[corners[dot(normals, mean[corners]) < TURNED]] = True
    return turned


def without_folds(
    points: Vectors, before: Vectors, faces: NDArray[Any], rounded: Callable[[Vectors], Vectors]
) -> Vectors:
    """Return points (n, 3), some back where they were before, so that no triangles intersect.

    ``rounded`` returns points as they are written: of those it must hold.
    """
    points, original = points.copy(), unit(face_normals(before, faces))
    suspect = np.any(points != before, axis=1)
    for turn in range(BACK_ROUNDS):
        now = rounded(points)
        normals = face_normals(now, faces)
        folded = faces[(dot(unit(normals), original) < ONE_WAY) | (length(normals) < FLAT)]
        pairs = faces[np.stack(overlapping_boxes(now, faces, suspect))]  # (2, m, 3)
        flat = pairs[:, overlapping_in_plane(now, *pairs)]
        crossed = intersecting(now, *pairs)
        back = np.unique(np.concatenate([each.ravel() for each in (*crossed, flat, folded)]))
        back = back[(points[back] != before[back]).any(1)]
        if not len(back):
            break
        points[back] += (0.5 if turn < HALF_WAY else 1.0) * (before[back] - points[back])
        suspect = np.isin(np.arange(len(points)), back)
    return points


def overlapping_in_plane(points: Vectors, first: NDArray[Any], second: NDArray[Any]) -> BoolArray:
    """Return which pairs of triangles, corners (m, 3) each, lie in one plane and overlap there.

    Two convex shapes do unless a side of one of them separates them.
    """
    both, normals = points[np.stack([first, second])], unit(face_normals(points, first))
    heights = dot(both[1] - both[0, :, :1], normals[:, None])
    overlap: BoolArray = np.abs(heights).max(1, initial=0) < IN_PLANE
    both = both[:, overlap]  # (2, k, 3, 3)
    sides = np.concatenate(both - np.roll(both, 1, axis=2), axis=1)  # (k, 6, 3)
    along = np.cross(normals[overlap, None], sides) @ both.swapaxes(2, 3)  # (2, k, 6, 3)
    beyond = along.max(3).min(0) - along.min(3).max(0)
    overlap[overlap] = (beyond > TOUCHING).all(1)
    return overlap


def gradient(value: Value, points: Vectors, values: Numbers) -> Vectors:
    """Return the gradient at points (n, 3) with values (n,), by forward differences."""
    return np.stack([(value(points + STEP * axis) - values) / STEP for axis in np.eye(3)], 1)
