"""Fields without a sample inside: thin solids, and what only looks like one.

A wall thinner than the spacing may pass between the samples, which are then all outside. Their
distances still show it: the sphere of each sample touches the wall and contains none of it. Other
fields have no inside either: unsigned distances to a thick solid, and values that stay above 0.
"""

from __future__ import annotations

from collections import deque
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, Triple
from ..machine.resources import chunks_of
from ..neighbourhood import CENTRE, NEIGHBOURHOOD, STRIDES
from .census import Census
from .planes import SampleArray

Floats = NDArray[np.floating[Any]]

# All lengths are in spacings, the coarsest one if they differ between axes.
MARGIN = 1.05  # on half the diagonal of a voxel: so far is the nearest sample at most
# Along a line of samples the field falls towards a wall and rises behind it, both at least so
# steeply: lines that graze the wall do not tell where it is.
STEEP = 0.25
# No wall passes between neighbouring samples whose distances add up to more than their spacing.
# Where walls cut off a region that holds a sample as deep as this, either it is the inside of a
# solid in an unsigned field, and the walls have no thickness, or the walls are thin and enclose it.
FREE, DEEP = 1.001, 0.75
# To unsigned distances a constant may have been added: then most walls are thinner than nothing.
NO_THICKNESS, UNSIGNED_SHARE, LEAST_THICKNESS = 0.03, 0.05, 0.05
MOST_FLOODED = 1 << 21  # samples; of a larger grid every second one, or third, is as exact
CANDIDATES_IN_PLANE, CANDIDATES = 8, 512  # samples near 0 whose neighbours are looked at
LIPSCHITZ, LIPSCHITZ_SHARE = 1.05, 0.9  # distances change by no more, at most samples
# Most samples' spheres touch a point that lies in no other sphere, but for the error in the
# direction to it, and the field rises from there by about 1.
TOUCHING, TOUCHING_SHARE, LEAST_RISE, MOST_RISE = 0.1, 0.5, 0.75, 3**0.5

FAR = "every wall is nearer to some sample than that, so there is no surface"
BEYOND = "only samples on the border of the grid are near 0, so no surface lies in it"
UNSIGNED = "unsigned distances have no inside"


def find_fault(census: Census, spacing: Triple) -> str:
    """Return why values on one side of 0 cannot be distances to a thin solid; empty if they can.

    ``spacing`` is that of each axis; the fault is ``FAR``, ``BEYOND`` or ``UNSIGNED``.
    """
    extremes, values = census.extremes, census.samples
    steps = np.array(spacing) / max(spacing)
    scale = (1 if extremes[0] >= 0 else -1) / max(spacing)
    if min(map(abs, extremes)) * abs(scale) > reach(steps):
        return FAR
    walls = _look_near_walls(values, scale, steps)
    if not len(walls.patches):
        return BEYOND
    if not (_are_distances(walls.patches, steps) and _touch_walls(walls.patches, steps)):
        return UNSIGNED
    if len(walls.thickness) > UNSIGNED_SHARE * walls.total:
        beyond = max(-float(np.quantile(walls.thickness, LEAST_THICKNESS)), 0.0)
        if _is_cut_off(walls.coarse, steps, FREE + beyond):
            return UNSIGNED
    return ""


def reach(steps: Floats) -> float:
    """Return how far a point is from the nearest sample at most, with a margin."""
    return float(np.linalg.norm(steps)) / 2 * MARGIN


class Walls(NamedTuple):
    """What lies near 0 in a grid."""

    patches: Floats  # distances round some of the inner samples near 0, (n, 27)
    total: int  # walls that pass between samples, of all lines along the axes
    thickness: Floats  # of those with less than ``NO_THICKNESS``; below 0 if a constant was added
    coarse: Floats  # every n-th sample along each axis, at most ``MOST_FLOODED``, in n spacings


def _look_near_walls(values: SampleArray, scale: float, steps: Floats) -> Walls:
    """Return what lies near 0, reading each plane once.

    ``scale`` is the factor of the values to spacings, positive outside; ``steps`` are the spacings
    of the axes, over the coarsest.
    """
    nth = 1
    while np.prod([-(-count // nth) for count in values.shape], dtype=float) > MOST_FLOODED:
        nth += 1
    count, near = 0, reach(steps)
    patches: list[Floats] = []
    thin: list[Floats] = [np.empty(0)]
    coarse: list[Floats] = []
    window: deque[Floats] = deque(maxlen=4)
    for number, plane in enumerate(chain(values, [None])):
        if plane is not None:
            window.append(np.asarray(plane, np.float64) * scale)
            if number % nth == 0:
                coarse.append(window[-1][::nth, ::nth])
        elif len(window) == 4:
            window.popleft()
        if number < 3:
            continue
        slab = np.stack(window)
        if slab[1:3].min() <= near:
            for lines, step in zip((slab, slab[1], slab[1].T), steps):
                for part in chunks_of(lines.shape[1], lines[:, 0].size):  # to save memory
                    thickness = find_walls(lines[:, part] / step)[1]
                    count += len(thickness)
                    thin.append(thickness[thickness < NO_THICKNESS])
            patches += _patches_near(slab[:3], near)
    some = np.unique(np.linspace(0, max(len(patches) - 1, 0), CANDIDATES).astype(int))
    chosen = np.array([patches[n] for n in some] if patches else []).reshape(-1, 27)
    return Walls(chosen, count, np.concatenate(thin), np.array(coarse) / nth)


def _patches_near(slab: Floats, limit: float) -> list[Floats]:
    """Return the patches of some inner samples near 0 of the middle one of three planes."""
    inner = slab[1, 1:-1, 1:-1]
    near = np.flatnonzero(inner <= limit)
    if not len(near):
        return []
    order = np.argsort(inner.ravel()[near])
    spread = np.linspace(0, len(order) - 1, CANDIDATES_IN_PLANE).astype(int)
    chosen = np.union1d(order[:CANDIDATES_IN_PLANE], order[spread])
    at = np.stack(np.unravel_index(near[chosen], inner.shape), 1)
    return [slab[:, j : j + 3, k : k + 3].reshape(27) for j, k in at]


def find_walls(lines: Floats) -> tuple[BoolArray, Floats]:
    """Return where a wall lies between two samples of lines (n, ...), and how thick it is.

    Samples are along the first axis, in spacings and positive. The first result, (n - 3, ...),
    says whether there is one between samples i + 1 and i + 2. The second, (walls,), is what the
    distances on either side leave of the way between the two.
    """
    before, left, right, after = lines[:-3], lines[1:-2], lines[2:-1], lines[3:]
    falling, rising = before - left, after - right
    slope = (falling + rising) / 2
    thickness = slope - left - right
    walls = (falling > STEEP) & (rising > STEEP) & (thickness >= -STEEP * slope)
    return walls, thickness[walls]


def _are_distances(patches: Floats, steps: Floats) -> bool:
    """Return whether most samples change by no more than distances can."""
    change = np.abs(patches - patches[:, CENTRE, None])
    most = LIPSCHITZ * np.linalg.norm(NEIGHBOURHOOD * steps, axis=1) + NO_THICKNESS
    return bool((change <= most).all(1).mean() >= LIPSCHITZ_SHARE)


def _touch_walls(patches: Floats, steps: Floats) -> bool:
    """Return whether most samples' spheres touch a point that lies in none of the others.

    The direction to it is that in which the field falls, measured on the far side of each sample:
    on the near side there may be the wall.
    """
    centre = patches[:, CENTRE, None]
    after, before = patches[:, CENTRE + STRIDES], patches[:, CENTRE - STRIDES]
    rise = np.where(after > before, after - centre, centre - before) / steps
    length = np.maximum(np.linalg.norm(rise, axis=1), np.finfo(float).tiny)[:, None]
    feet = -rise / length * centre
    depth = patches - np.linalg.norm(feet[:, None] - NEIGHBOURHOOD * steps, axis=2)
    deepest = np.delete(depth, CENTRE, axis=1).max(1)
    rises = (length[:, 0] >= LEAST_RISE) & (length[:, 0] <= MOST_RISE)
    return bool((rises & (np.abs(deepest) <= TOUCHING)).mean() >= TOUCHING_SHARE)


def _is_cut_off(coarse: Floats, steps: Floats, free: float) -> bool:
    """Return whether walls cut deep samples off from the farthest sample of the border.

    No wall passes between samples that add up to more than ``free`` times their spacing.
    """
    border = coarse.copy()
    border[1:-1, 1:-1, 1:-1] = -np.inf
    reached = np.zeros(coarse.shape, bool)
    reached.flat[border.argmax()] = True
    before = 0
    while before != (before := int(reached.sum())):
        for axis, step in enumerate(steps):
            _spread(np.moveaxis(reached, axis, 0), np.moveaxis(coarse, axis, 0), free * step)
    return bool((coarse[~reached] >= DEEP).any())


def _spread(reached: BoolArray, samples: Floats, limit: float) -> None:
    """Extend what is reached along the first axis, both ways, where no wall passes between."""
    free = samples[1:] + samples[:-1] > limit
    for i in range(len(free)):
        reached[i + 1] |= reached[i] & free[i]
    for i in range(len(free) - 1, -1, -1):
        reached[i] |= reached[i + 1] & free[i]
