"""What values that are refused may be, and the one option to try next.

All refusals of values end with it, so it is found once, from the values: labels, densities,
unsigned distances, distances in another unit, or a field of another slope.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Triple
from ..errors import GridError
from .gradients import (
    ENOUGH,
    are_consistent,
    spacing_of_axes,
    straight_gradients,
    typical_length,
)
from .one_sided import UNSIGNED, find_walls, is_one_sided
from .planes import SampleArray, changed, over_planes, spread_planes
from .samples import Extremes, find_extremes
from .sides import count_border, is_mostly_negative

PLANES = 12  # that are looked at, spread evenly
MOST_BETWEEN = 0.4  # share of the samples at a boundary of labels that lie between two others
LEAST_JUMP = 0.3  # of the range of labels: so far some neighbours are apart
MOST_NAMED = 8  # labels that a message lists
ALIKE = 1.1  # ratio up to which the spacings that the axes show are one unit's
SNAP = 0.02  # a scale this close to a power of ten, or to the spacing, is replaced by it
NEAR = 0.25  # of a step from the lowest value: there unsigned distances rise to both sides
VANISHING = 1e-6  # of the largest value: as good as 0
CUT_OFF = 0.01  # share of samples at the lowest, and at the highest value, that are cut off
CLOSE = 0.95  # share of the full range that values reach, if it is theirs
FULL = (1, 255, 2**16 - 1)  # largest values of densities and images: the level is half of it
ROUNDS, FEW = 20, 1 << 16  # of the search for a level; samples of a plane


def way_out(samples: SampleArray, spacing: Triple | None = None, fault: str = UNSIGNED) -> str:
    """Return a clause that names the option to try next for values that are refused.

    Parameters
    ----------
    samples : (nx, ny, nz) array or Planes
        Finite values.
    spacing : three floats, optional
        Of each axis, if it is given.
    fault : str
        Of distances on one side of 0; see ``one_sided.find_fault``.
    """
    if are_labels(samples):
        return choose_label(samples)
    extremes, steps = _extremes(samples), _steps(samples)
    if is_one_sided(extremes):
        if steps is None or (fault == UNSIGNED and not _has_walls(samples, extremes, steps.max())):
            return choose_level(samples, extremes)
        unit = _unit(steps, spacing) if spacing is not None else ""
        return unit or (fault if fault != UNSIGNED else _shell(extremes, max(spacing or steps)))
    if spacing is None:
        return "give --spacing X,Y,Z"
    if steps is None and samples.dtype.kind in "iu":
        return _level(samples, 0.0)
    unit = _unit(steps, spacing) if steps is not None else ""
    return unit or "they are distances in no unit: give --field scaled"


def refusal(
    samples: SampleArray, extremes: Extremes, spacing: Triple | None, fault: str = UNSIGNED
) -> GridError:
    """Return the error for values without both sides; ``fault`` is that of ``one_sided``."""
    low, high = extremes
    side, end, at = ("below", "smallest", low) if low >= 0 else ("above", "largest", high)
    advice = way_out(samples, spacing, fault)
    return GridError(f"no value is {side} 0 (the {end} is {at:.6g}): {advice}")


def is_density(samples: SampleArray, extremes: Extremes, spacing: Triple) -> bool:
    """Return whether values on one side of 0 are no distances, or cut off at 0.

    Distances to walls may be rounded so that they show no spacing.
    """
    steps = _steps(samples)
    if _has_walls(samples, extremes, max(spacing if steps is None else steps)):
        return False
    small = VANISHING * max(map(abs, extremes))
    planes = [np.abs(np.asarray(samples[i])) for i in spread_planes(0, len(samples) - 1, PLANES)]
    at_zero = [float((plane <= small).mean()) for plane in planes]
    return steps is None or sum(at_zero) > CUT_OFF * len(at_zero)


def _has_walls(samples: SampleArray, extremes: Extremes, step: float) -> bool:
    """Return whether values rise to both sides where they are next to 0, as unsigned distances."""
    if min(samples.shape) < 4:  # two samples on either side of a wall
        return False
    sign, least = (1, extremes[0]) if extremes[0] >= 0 else (-1, -extremes[1])
    walls = near = 0
    for i in spread_planes(1, len(samples) - 3, PLANES):
        slab = (sign * np.asarray(samples[i - 1 : i + 3], np.float64) - least) / step
        walls += sum(int(find_walls(x)[0].sum()) for x in (slab, slab[1], slab[1].T))
        near += int((slab[1] <= NEAR).sum())
    return 4 * walls > near


def _neighbours(slab: NDArray[Any]) -> list[NDArray[Any]]:
    """Return the six neighbours of the inner samples of the middle one of three planes."""
    inner = slab[1]
    pairs = [slab[0, 1:-1, 1:-1], slab[2, 1:-1, 1:-1], inner[:-2, 1:-1], inner[2:, 1:-1]]
    return [*pairs, inner[1:-1, :-2], inner[1:-1, 2:]]


def _extremes(samples: SampleArray) -> Extremes:
    """Return the smallest and the largest of values that are all finite."""
    extremes = find_extremes(samples)
    assert extremes is not None
    return extremes


def _unit(steps: NDArray[np.float64], spacing: Triple) -> str:
    """Return the advice for distances that show other spacings than those given, if they do."""
    ratio = np.array(spacing) / steps
    if ratio.max() > ALIKE * ratio.min():
        each = ",".join(f"{step:.4g}" for step in steps)
        return f"give the spacing of each axis (they show --spacing {each})"
    if 1 / ALIKE <= ratio.mean() <= ALIKE:
        return ""
    scale = _usual(float(ratio.mean()), spacing[0])
    return f"distances need the unit of the spacing: multiply the values, --scale {scale:.6g}"


def are_labels(samples: SampleArray) -> bool:
    """Return whether values look like labels: whole numbers of which regions jump to others.

    At the boundary of a region, a sample hardly ever lies between a lower and a higher neighbour;
    those of images and distances do.
    """
    if min(samples.shape) < 3:
        return False
    places = spread_planes(1, len(samples) - 2, PLANES)
    ends = list(over_planes(samples, _whole_ends, [(i, i + 1) for i in places]))
    if None in ends:
        return False
    lows, highs = zip(*filter(None, ends))
    low, high = min(lows), max(highs)
    count = partial(_at_boundaries, low, high)
    counts = over_planes(samples, count, [(i - 1, i + 2) for i in places])
    between, among, jumps = zip(*counts)
    if LEAST_JUMP * (high - low) > max(jumps) or sum(among) < ENOUGH:
        return False
    return bool(sum(between) <= MOST_BETWEEN * sum(among))


def _whole_ends(planes: NDArray[Any]) -> Extremes | None:
    """Return the lowest and the highest of some whole numbers; None if some are not whole."""
    if planes.dtype.kind == "f" and (planes != np.rint(planes)).any():
        return None
    return planes.min().item(), planes.max().item()


def _at_boundaries(low: float, high: float, slab: NDArray[Any]) -> tuple[int, int, float]:
    """Count samples between a lower and a higher neighbour, and all with another neighbour.

    Of three planes, inner samples of the middle one count, but for the lowest and the highest. The
    third number is the largest difference between neighbours.
    """
    slab = np.asarray(slab)
    centre, sides = slab[1, 1:-1, 1:-1], _neighbours(slab)
    lower = np.logical_or.reduce([side < centre for side in sides])
    higher = np.logical_or.reduce([side > centre for side in sides])
    amid = (centre > low) & (centre < high)
    jump = max(float(np.abs(np.subtract(x, centre, dtype=np.float64)).max()) for x in sides)
    return int((amid & lower & higher).sum()), int((amid & (lower | higher)).sum()), jump


def choose_label(samples: SampleArray) -> str:
    """Return the advice to choose a label: the most frequent one that is not the border's."""
    counts: dict[Any, int] = {}
    for plane in samples:
        for label, count in zip(*(x.tolist() for x in np.unique(plane, return_counts=True))):
            counts[label] = counts.get(label, 0) + count
    ends = np.concatenate([np.asarray(samples[i]).ravel() for i in (0, -1)])
    most = np.unique(ends, return_counts=True)
    outside = most[0][most[1].argmax()].item()
    best = max((label for label in counts if label != outside), key=lambda x: counts[x])
    return f"they look like labels ({named(counts)}): choose one with --label {int(best)}"


def named(labels: Any) -> str:
    """Return labels in words, the first few in order."""
    ordered = sorted(labels)
    words = ", ".join(f"{x:g}" if x % 1 else str(int(x)) for x in ordered[:MOST_NAMED])
    return words + (", ..." if len(ordered) > MOST_NAMED else "")


def choose_level(samples: SampleArray, extremes: Extremes) -> str:
    """Return the advice to choose a level of densities: half of the full range, or between two."""
    low, high = extremes
    least = 0.5 if samples.dtype.kind in "iu" else CLOSE
    full = next((full for full in FULL if low >= 0 and least * full < high <= full), 0)
    return _level(samples, full / 2 if low < full / 2 and full else _between(samples))


def _level(samples: SampleArray, level: float) -> str:
    """Return the advice to try a level, with what is on the border outside."""
    above = is_mostly_negative(*count_border(changed(samples, partial(np.add, -level))))
    option = f"--level {level:.6g} --inside {'positive' if above else 'negative'}"
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


def _shell(extremes: Extremes, offset: float) -> str:
    """Return the advice for unsigned distances."""
    inside = "negative" if extremes[0] >= 0 else "positive"
    return (
        f"{UNSIGNED}: mesh the shell round the surface with --inside {inside} --offset {offset:.4g}"
    )


def _steps(samples: SampleArray) -> NDArray[np.float64] | None:
    """Return the spacing of each axis with which values are distances; None if with none."""
    gradients = straight_gradients(samples)
    found = spacing_of_axes(*gradients) if len(gradients[0]) else None
    if found is None and len(gradients[0]):
        step = typical_length(*gradients)
        found = np.full(3, step) if are_consistent(step, *gradients) else None
    return found


def _usual(scale: float, step: float) -> float:
    """Return a power of ten or the spacing if that is close to a scale, else the scale."""
    usual = [10.0 ** round(np.log10(scale)), step]
    return next((x for x in usual if abs(scale / x - 1) <= SNAP), scale)
