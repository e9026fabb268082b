"""The corpus from the command line: how the cases of each theme ended, and the faults.

python -m lab corpus                       # a seeded sample
python -m lab corpus --whole               # all
python -m lab corpus --only grids/header   # those with this in their names
python -m lab corpus --fields 10000        # random fields: closed manifolds?
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

from . import archives, fields, grids, manifests, meshes, models, options, special
from .case import Case
from .judge import try_case
from .running import Child

THEMES = (grids, archives, fields, options, manifests, models, meshes, special)
ALONE = (models, meshes, special)  # all of them may hang or crash


def make_cases(seed: int = 0) -> list[Case]:
    """Return the whole corpus; the same for the same seed."""
    return [
        replace(case, alone=case.alone or theme in ALONE)
        for theme in THEMES
        for case in theme.cases(seed)
    ]


def spread(cases: list[Case], count: int, seed: int = 0) -> list[Case]:
    """Return ``count`` cases at even steps along the list; the seed decides the first."""
    step = max(1.0, len(cases) / count)
    first = (seed * 0.618) % 1 * step
    return [cases[int(first + k * step)] for k in range(min(count, len(cases)))]


def main() -> int:
    """Run what is asked for and print the faults as they come; 1 if there is any."""
    parser = argparse.ArgumentParser(prog="python -m lab corpus")
    parser.add_argument("--whole", action="store_true", help="All cases, not a sample.")
    parser.add_argument("--only", default="", metavar="TEXT", help="Cases with this in the name.")
    parser.add_argument("--count", type=int, default=500, help="Cases of a sample.")
    parser.add_argument("--fields", type=int, metavar="N", help="Random fields, and no cases.")
    parser.add_argument("--seed", type=int, default=0, help="Of all that is random.")
    asked = parser.parse_args()
    start, count = time.perf_counter(), 0
    for fault in _of_fields(asked) if asked.fields else _of_cases(asked):
        print(fault, flush=True)
        count += 1
    print(f"{count} faults, {time.perf_counter() - start:.0f} s")
    return int(count > 0)


def _of_cases(asked: argparse.Namespace) -> Iterator[str]:
    """Run cases in a child, yield their faults, and print how those of each theme ended."""
    cases = [case for case in make_cases(asked.seed) if asked.only in case.name]
    if not (asked.whole or asked.only):
        cases = spread(cases, asked.count, asked.seed)
    ends: dict[str, Counter[str]] = {}
    child = Child()
    try:
        for case in cases:
            outcome = try_case(case, child.run)
            ends.setdefault(case.theme, Counter())[f"exit {outcome.run.code}"] += 1
            yield from (f"{case.name}\t{fault.kind}\t{fault.what}" for fault in outcome.faults)
    finally:
        child.stop()
    for theme, counts in ends.items():
        print(theme, dict(sorted(counts.items())))


def _of_fields(asked: argparse.Namespace) -> Iterator[str]:
    from super_sdf import load_network

    from .random_fields import faults_of_field, make_fields

    network = load_network("fast", threads=1)
    for field in make_fields(asked.fields, asked.seed):
        yield from faults_of_field(field, network)
