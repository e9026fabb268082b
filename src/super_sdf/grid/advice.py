"""What a refusal names, a label or a level, and which samples have a label."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from ..errors import GridError
from .look import Floats, Look, border_share, different_values
from .samples import SampleArray, changed

LEVELS = 63  # that are tried
AS_GOOD = 0.9  # of the largest mean step of neighbours over a level: as good
ENOUGH = 20  # pairs of neighbours over a level that count
MOST_NAMED = 8  # labels that a message lists


def which_level(look: Look, *, signed: bool = False, shift: float = 0.0, unit: float = 1.0) -> str:
    """Return the advice to give a level: the one over which neighbours differ most.

    It is the shortest number among those that are about as good, and never a value of a sample.
    ``shift`` was taken from all values, which then were multiplied by ``unit``.
    """
    pairs = look.all_pairs * (look.scale / unit) + shift
    low, high = np.sort(pairs, axis=0)
    levels = np.linspace(*np.quantile(pairs, [0.002, 0.998]), LEVELS + 2)[1:-1]
    first, last = np.searchsorted(levels, [low, high])
    sums, counts = np.zeros((2, LEVELS + 1))
    for at, side in ((first, 1), (last, -1)):
        sums += side * np.bincount(at, high - low, LEVELS + 1)
        counts += side * np.bincount(at, None, LEVELS + 1)
    total = np.cumsum(counts)[:-1]
    steps = np.where(total >= ENOUGH, np.cumsum(sums)[:-1] / total.clip(1), 0)
    good = levels[steps >= AS_GOOD * steps.max()]
    level = _short_number(good)
    values = np.unique(pairs)
    at = int(np.searchsorted(values, level))
    if at < len(values) and values[at] == level:
        beside = values[at - 1] if at else values[at + 1]
        level = float(beside + values[at]) / 2
    outside = border_share(look, lambda x: x / unit > level - shift) > 0.5
    option = f"--level {level:.6g} --inside {'negative' if outside else 'positive'}"
    other = "; or --field smooth, if it is at 0" if signed else ""
    return f"they look like densities: give the level of their surface, such as {option}{other}"


def _short_number(good: Floats) -> float:
    middle = float(np.median(good))
    for digits in (1, 2, 3):
        short = float(f"{middle:.{digits}g}")
        if good.min() <= short <= good.max():
            return short
    return middle


def which_label(samples: SampleArray) -> str:
    """Return the advice to choose a label: the most frequent one that is not the border's."""
    found = different_values(samples)
    if found is None:
        return "they are labels: choose one with --label, or some with --labels"
    distinct, counts = found
    ends = np.concatenate([np.asarray(samples[i]).ravel() for i in (0, -1)])
    values, frequent = np.unique(ends, return_counts=True)
    at = np.flatnonzero(distinct != values[frequent.argmax()])
    best = distinct[at[counts[at].argmax()]] if len(at) else distinct[0]
    return (
        f"they look like labels ({named(distinct.tolist())}): choose one with "
        f"--label {int(np.rint(best))}, or mesh all with --labels all"
    )


def named(labels: Any) -> str:
    """Return labels in words, the first eight in order."""
    ordered = sorted(labels)
    words = ", ".join(f"{x:g}" if x % 1 else str(int(x)) for x in ordered[:MOST_NAMED])
    return words + (", ..." if len(ordered) > MOST_NAMED else "")


def labelled(samples: SampleArray, label: int) -> SampleArray:
    """Return which samples have a label; GridError if none or all have."""
    value = as_sample(label, samples.dtype)
    found, others = False, False
    labels: set[Any] = set()
    for plane in samples:
        has = np.asarray(plane == value if value is not None else np.zeros(plane.shape, bool))
        found, others = found or bool(has.any()), others or not has.all()
        if not (found and others):
            labels |= {x.item() for x in np.unique(plane)[:9]}
    if found and others:
        return changed(samples, partial(np.equal, value), np.bool_)
    raise GridError(
        f"{'every' if found else 'no'} sample has the label {label}: the labels are {named(labels)}"
    )


def as_sample(label: int, dtype: np.dtype[Any]) -> Any:
    """Return the sample that is exactly a label, None if the type has none."""
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            value = dtype.type(label)
        return value if np.isfinite(value) and int(value) == label else None
    low, high = (0, 1) if dtype.kind == "b" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    return dtype.type(label) if low <= label <= high else None
