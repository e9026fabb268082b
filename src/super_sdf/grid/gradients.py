"""How a field changes from sample to sample next to its surface.

Wherever a distance field is smooth its gradient has length 1, so in units of samples the length is
the spacing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import GridError
from .planes import Samples

# Values are clipped here, so that squares of their differences do not overflow.
FARTHEST = 1e150
ENOUGH = 30  # samples for a statement
STRAIGHT = 0.3  # bend (see surface_gradients) below which a field is linear enough to measure
BENT = 0.6  # bend beyond which lengths may agree by chance, as those of a distance to a mask do
# Gradients are consistent if nine in ten of the straighter ones agree within 5 %.
AGREEING, AGREEMENT = 0.9, 0.05
UNEQUAL = 1.3  # ratio of the spacings along two axes that the values themselves show


def surface_gradients(values: Samples) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return index-space gradients at samples next to the surface, and how bent the field is there.

    Returns
    -------
    (n, 3) and (n,) float64
        Central differences; and the sum of the second differences over the gradient's length. At
        most 64 planes are looked at.
    """
    planes = np.unique(np.linspace(0, len(values) - 1, 64).astype(int))
    found = [_plane_gradients(values, int(i)) for i in planes]
    gradients, bend = (np.concatenate(parts) for parts in zip(*found))
    return gradients, bend


def _plane_gradients(values: Samples, i: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return gradients (n, 3) and their relative change (n,) next to the surface in plane i."""
    first = max(i - 1, 0)
    slab = values[first : i + 2].astype(np.float64)
    np.clip(slab, -FARTHEST, FARTHEST, out=slab)
    inside = slab <= 0
    near = np.zeros(slab.shape, bool)
    bend = np.zeros(slab.shape)
    for axis in range(3):
        s, d, n, b = (np.moveaxis(a, axis, 0) for a in (inside, slab, near, bend))
        crossed = s[1:] != s[:-1]
        n[1:] |= crossed
        n[:-1] |= crossed
        b[1:-1] += np.abs(d[2:] - 2 * d[1:-1] + d[:-2])
    chosen = near[i - first]
    gradient = np.asarray(np.gradient(slab))[:, i - first][:, chosen].T
    turn, length = bend[i - first][chosen], lengths(gradient)
    relative = np.full(len(length), np.inf)  # where opposite neighbours are equal, or nearly
    np.divide(turn, length, out=relative, where=length > 1e-9 * turn)
    return gradient, relative


def typical_length(gradients: NDArray[np.float64], bend: NDArray[np.float64]) -> float:
    """Return the length round which the gradients (n, 3) cluster: their half-sample mode.

    Only the straighter samples count (``_straighter``).
    Reference: Bickel and Frühwirth, "On a fast, robust estimator of the mode", 2006.
    """
    if not len(gradients):
        raise GridError("all values are on one side of the surface: give --spacing")
    length: NDArray[np.float64] = np.sort(lengths(gradients[_straighter(bend)]))
    while len(length) > 2:
        half = (len(length) + 1) // 2
        width = length[half - 1 :] - length[: len(length) - half + 1]
        start = int(width.argmin())
        length = length[start : start + half]
    return float(length.mean())


def lengths(gradients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths of gradients (n, 3)."""
    length: NDArray[np.float64] = np.sqrt((gradients**2).sum(1))
    return length


def _straighter(bend: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Say which samples are in the straighter half, and straight indeed if that are enough.

    Thin walls, edges and noise bend the field, and make its gradient too small or too large.
    """
    limit = float(np.median(bend))
    if (bend < STRAIGHT).sum() >= ENOUGH:
        limit = min(limit, STRAIGHT)
    return bend <= limit


def are_consistent(
    measured: float, gradients: NDArray[np.float64], bend: NDArray[np.float64]
) -> bool:
    """Say whether the straighter samples agree on what is measured: it is no matter of noise."""
    straighter = _straighter(bend) & (bend <= BENT)
    length = lengths(gradients[straighter])
    agreeing = np.abs(length - measured) <= AGREEMENT * measured
    return len(length) >= ENOUGH and bool(agreeing.mean() >= AGREEING)


def check_equal_axes(gradients: NDArray[np.float64], bend: NDArray[np.float64]) -> None:
    """Raise if the values themselves show different spacings along the axes."""
    length = lengths(gradients)
    found: dict[str, float] = {}
    for axis, name in enumerate("xyz"):
        along = (np.abs(gradients[:, axis]) > 0.95 * length) & (bend < STRAIGHT)
        if along.sum() >= ENOUGH:
            found[name] = typical_length(gradients[along], bend[along])
    if found and max(found.values()) > UNEQUAL * min(found.values()):
        steps = ", ".join(f"{step:.4g} along {name}" for name, step in found.items())
        raise GridError(
            f"the values change by {steps} from sample to sample: the method needs cubic voxels; "
            "resample the grid to one spacing on all axes"
        )
