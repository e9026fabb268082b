"""Values that are refused: what they may be instead, and the one option to try next.

They may be labels, densities, unsigned distances, distances in another unit, or a field of another
slope. Values without a sample inside are the hardest: thin solids, and what only looks like one.

A wall thinner than the spacing may pass between the samples, which are then all outside. Their
distances still show it: the sphere of each sample touches the wall and contains none of it. Other
fields have no inside either: unsigned distances to a thick solid, and values that stay above 0.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, Triple
from ..errors import GridError
from ..threads import chunks_of
from ..arrays import CENTRE, NEIGHBOURHOOD, STRIDES
from .census import CUT_OFF, Census
from .planes import SampleArray, changed, spread_planes

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

PLANES = 12  # that are looked at, spread evenly
MOST_NAMED = 8  # labels that a message lists
ALIKE = 1.1  # ratio up to which the spacings that the axes show are one unit's
SNAP = 0.02  # a scale or spacing this close to a usual one is replaced by it
NEAR = 0.25  # of a step from the lowest value: there unsigned distances rise to both sides
VANISHING = 1e-6  # of the largest value: as good as 0
CLOSE = 0.95  # share of the full range that values reach, if it is theirs
FULL = (1, 255, 2**16 - 1)  # largest values of densities and images: the level is half of it
ROUNDS, FEW = 20, 1 << 16  # of the search for a level; samples of a plane

FAR = "every wall is nearer to some sample than that, so there is no surface"
BEYOND = "only samples on the border of the grid are near 0, so no surface lies in it"
UNSIGNED = "unsigned distances have no inside"


def find_fault(census: Census, spacing: Triple) -> str:
    """Return why values on one side of 0 are no distances to a thin solid; empty if they can be."""
    extremes, values = census.extremes, census.samples
    steps = np.array(spacing) / max(spacing)
    scale = (1 if extremes[0] >= 0 else -1) / max(spacing)
    if min(map(abs, extremes)) * abs(scale) > reach(steps):
        return FAR
    patches, total, thin, coarse = _look_near_walls(values, scale, steps)
    if not len(patches):
        return BEYOND
    change = np.abs(patches - patches[:, CENTRE, None])
    most = LIPSCHITZ * np.linalg.norm(NEIGHBOURHOOD * steps, axis=1) + NO_THICKNESS
    are_distances = (change <= most).all(1).mean() >= LIPSCHITZ_SHARE
    if not (are_distances and _touch_walls(patches, steps)):
        return UNSIGNED
    if len(thin) > UNSIGNED_SHARE * total:
        beyond = max(-float(np.quantile(thin, LEAST_THICKNESS)), 0.0)
        if _is_cut_off(coarse, steps, FREE + beyond):
            return UNSIGNED
    return ""


def reach(steps: Floats) -> float:
    """Return how far a point is from the nearest sample at most, with a margin."""
    return float(np.linalg.norm(steps)) / 2 * MARGIN


def _look_near_walls(
    values: SampleArray, scale: float, steps: Floats
) -> tuple[Floats, int, Floats, Floats]:
    """Return what lies near 0, reading each plane once; ``scale`` makes outside positive.

    Distances round some of the inner samples, (n, 27); how many walls pass between samples, of all
    lines along the axes; how thick those are that hardly have a thickness, less than 0 if a
    constant was added; and every n-th sample along each axis, in n spacings.
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
    return chosen, count, np.concatenate(thin), np.array(coarse) / nth


def _patches_near(slab: Floats, limit: float) -> list[Floats]:
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


def _touch_walls(patches: Floats, steps: Floats) -> bool:
    """Return whether most samples' spheres touch a point that lies in none of the others.

    The field falls towards it, measured on the far side of each sample: on the near side there may
    be the wall.
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


def way_out(census: Census, spacing: Triple | None = None, fault: str = UNSIGNED) -> str:
    """Return a clause that names the option to try next for values that are refused."""
    if census.are_labels:
        return choose_label(census.samples)
    steps = _steps(census)
    if census.is_one_sided:
        if steps is None or (fault == UNSIGNED and not _has_walls(census, steps.max())):
            return choose_level(census)
        unit = _unit(steps, spacing) if spacing is not None else ""
        if unit or fault != UNSIGNED:
            return unit or fault
        inside = "negative" if census.numbers.low >= 0 else "positive"
        way = f"--inside {inside} --offset {max(spacing or steps):.4g}"
        return f"{UNSIGNED}: mesh the shell round the surface with {way}"
    if spacing is None:
        return "give --spacing X,Y,Z"
    if steps is None and census.samples.dtype.kind in "iu":
        return _level(census.samples, 0.0)
    unit = _unit(steps, spacing) if steps is not None else ""
    return unit or "they are distances in no unit: give --field scaled"


def refusal(census: Census, spacing: Triple | None, fault: str = UNSIGNED) -> GridError:
    """Return the error for values without both sides; ``fault`` is that of ``find_fault``."""
    low, high = census.extremes
    side, end, at = ("below", "smallest", low) if low >= 0 else ("above", "largest", high)
    advice = way_out(census, spacing, fault)
    return GridError(f"no value is {side} 0 (the {end} is {at:.6g}): {advice}")


def is_density(census: Census, spacing: Triple) -> bool:
    """Return whether values on one side of 0 are no distances, or cut off at 0.

    Distances to walls may be rounded so that they show no spacing.
    """
    steps, samples = _steps(census), census.samples
    if _has_walls(census, max(spacing if steps is None else steps)):
        return False
    small = VANISHING * max(map(abs, census.extremes))
    planes = [np.abs(np.asarray(samples[i])) for i in spread_planes(0, len(samples) - 1, PLANES)]
    at_zero = [float((plane <= small).mean()) for plane in planes]
    return steps is None or sum(at_zero) > CUT_OFF * len(at_zero)


def _has_walls(census: Census, step: float) -> bool:
    """Return whether values rise to both sides where they are next to 0, as unsigned distances."""
    samples, (low, high) = census.samples, census.extremes
    if min(samples.shape) < 4:  # two samples on either side of a wall
        return False
    sign, least = (1, low) if low >= 0 else (-1, -high)
    walls = near = 0
    for i in spread_planes(1, len(samples) - 3, PLANES):
        slab = (sign * np.asarray(samples[i - 1 : i + 3], np.float64) - least) / step
        walls += sum(int(find_walls(x)[0].sum()) for x in (slab, slab[1], slab[1].T))
        near += int((slab[1] <= NEAR).sum())
    return 4 * walls > near


def _unit(steps: NDArray[np.float64], spacing: Triple) -> str:
    """Return the advice for distances that show other spacings than those given, if they do."""
    ratio = np.array(spacing) / steps
    if ratio.max() > ALIKE * ratio.min():
        each = ",".join(f"{step:.4g}" for step in steps)
        return f"give the spacing of each axis (they show --spacing {each})"
    scale = float(ratio.mean())
    if 1 / ALIKE <= scale <= ALIKE:
        return ""
    usual = (10.0 ** round(np.log10(scale)), spacing[0])
    scale = next((x for x in usual if abs(scale / x - 1) <= SNAP), scale)
    return f"distances need the unit of the spacing: multiply the values, --scale {scale:.6g}"


def choose_label(samples: SampleArray) -> str:
    """Return the advice to choose a label: the most frequent one that is not the border's."""
    counts: dict[Any, int] = {}
    for plane in samples:
        for label, count in zip(*(x.tolist() for x in np.unique(plane, return_counts=True))):
            counts[label] = counts.get(label, 0) + count
    ends = np.concatenate([np.asarray(samples[i]).ravel() for i in (0, -1)])
    values, frequent = np.unique(ends, return_counts=True)
    outside = values[frequent.argmax()].item()
    best = max((label for label in counts if label != outside), key=lambda x: counts[x])
    return f"they look like labels ({named(counts)}): choose one with --label {int(best)}"


def named(labels: Any) -> str:
    """Return labels in words, the first few in order."""
    ordered = sorted(labels)
    words = ", ".join(f"{x:g}" if x % 1 else str(int(x)) for x in ordered[:MOST_NAMED])
    return words + (", ..." if len(ordered) > MOST_NAMED else "")


def choose_level(census: Census) -> str:
    """Return the advice to choose a level of densities: half of the full range, or between two."""
    (low, high), samples = census.extremes, census.samples
    least = 0.5 if samples.dtype.kind in "iu" else CLOSE
    full = next((full for full in FULL if low >= 0 and least * full < high <= full), 0)
    return _level(samples, full / 2 if low < full / 2 and full else _between(samples))


def _level(samples: SampleArray, level: float) -> str:
    """Return the advice to try a level, with what is on the border outside."""
    census = Census(changed(samples, partial(np.add, -level)))
    side = "positive" if census.border_shares()[0] > 0.5 else "negative"
    option = f"--level {level:.6g} --inside {side}"
    return f"they look like densities: give the level of their surface, such as {option}"


def _between(samples: SampleArray) -> float:
    """Return the middle of values that are cut off at both ends, else a level between two groups.

    That is half-way between the means of what is below and above it (Ridler and Calvard).
    """
    planes = [np.ravel(samples[i]) for i in spread_planes(0, len(samples) - 1, PLANES)]
    some = np.concatenate([plane[:: 1 + plane.size // FEW] for plane in planes]).astype(np.float64)
    some = some[np.isfinite(some)]
    ends = float(some.min()), float(some.max())
    if min(float((some == end).mean()) for end in ends) > CUT_OFF:
        return sum(ends) / 2
    level = float(some.mean())
    for _ in range(ROUNDS):
        above = some > level
        if above.all() or not above.any():
            break
        level = float(some[above].mean() + some[~above].mean()) / 2
    return float(f"{level:.3g}")


def _steps(census: Census) -> NDArray[np.float64] | None:
    """Return the spacing of each axis with which values are distances; None if with none."""
    gradients = census.everywhere
    if not len(gradients.bend):
        return None
    if gradients.spacing is not None:
        return gradients.spacing
    step = gradients.typical_length
    return np.full(3, step) if gradients.agree_with(step) else None
