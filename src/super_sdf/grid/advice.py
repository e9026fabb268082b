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
from .census import CUT_OFF, Census
from .one_sided import UNSIGNED, find_walls
from .planes import SampleArray, changed, spread_planes

PLANES = 12  # that are looked at, spread evenly
MOST_NAMED = 8  # labels that a message lists
ALIKE = 1.1  # ratio up to which the spacings that the axes show are one unit's
SNAP = 0.02  # a scale this close to a power of ten, or to the spacing, is replaced by it
NEAR = 0.25  # of a step from the lowest value: there unsigned distances rise to both sides
VANISHING = 1e-6  # of the largest value: as good as 0
CLOSE = 0.95  # share of the full range that values reach, if it is theirs
FULL = (1, 255, 2**16 - 1)  # largest values of densities and images: the level is half of it
ROUNDS, FEW = 20, 1 << 16  # of the search for a level; samples of a plane


def way_out(census: Census, spacing: Triple | None = None, fault: str = UNSIGNED) -> str:
    """Return a clause that names the option to try next for values that are refused.

    ``spacing`` is that of each axis, if it is given; ``fault`` that of distances on one side of 0,
    see ``one_sided.find_fault``.
    """
    if census.are_labels:
        return choose_label(census.samples)
    steps = _steps(census)
    if census.is_one_sided:
        if steps is None or (fault == UNSIGNED and not _has_walls(census, steps.max())):
            return choose_level(census)
        unit = _unit(steps, spacing) if spacing is not None else ""
        if unit or fault != UNSIGNED:
            return unit or fault
        inside, offset = (
            "negative" if census.numbers.low >= 0 else "positive",
            max(spacing or steps),
        )
        way = f"--inside {inside} --offset {offset:.4g}"
        return f"{UNSIGNED}: mesh the shell round the surface with {way}"
    if spacing is None:
        return "give --spacing X,Y,Z"
    if steps is None and census.samples.dtype.kind in "iu":
        return _level(census.samples, 0.0)
    unit = _unit(steps, spacing) if steps is not None else ""
    return unit or "they are distances in no unit: give --field scaled"


def refusal(census: Census, spacing: Triple | None, fault: str = UNSIGNED) -> GridError:
    """Return the error for values without both sides; ``fault`` is that of ``one_sided``."""
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
    above = 2 * census.numbers.border[0] > census.border_size
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


def _steps(census: Census) -> NDArray[np.float64] | None:
    """Return the spacing of each axis with which values are distances; None if with none."""
    gradients = census.everywhere
    if not len(gradients.bend):
        return None
    if gradients.spacing is not None:
        return gradients.spacing
    step = gradients.typical_length
    return np.full(3, step) if gradients.agree_with(step) else None
