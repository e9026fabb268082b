"""All cases, and samples of them that have something of each theme."""

from __future__ import annotations

from . import (
    archives,
    fields,
    grids,
    ledgers,
    manifests,
    members,
    meshes,
    models,
    options,
    scales,
    special,
)
from .case import Case

THEMES = (
    *(grids, archives, members, fields, scales, options, manifests, ledgers),
    *(models, meshes, special),
)


def make_cases(seed: int = 0) -> list[Case]:
    """Return the whole corpus; the same for the same seed."""
    return [case for theme in THEMES for case in theme.cases(seed)]


def spread(cases: list[Case], count: int, seed: int = 0) -> list[Case]:
    """Return so many of the cases, evenly over the list; the seed says where it begins."""
    step = max(1.0, len(cases) / count)
    first = (seed * 0.618) % 1 * step
    return [cases[int(first + k * step)] for k in range(min(count, len(cases)))]
