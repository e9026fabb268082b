"""The corpus from the command line: a table of how the cases of each theme ended, and the faults.

python -m lab corpus                       # a seeded sample
python -m lab corpus --whole               # all
python -m lab corpus --only grids/header   # those with this in their names
python -m lab corpus --fields 10000        # random fields: closed manifolds?
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from . import archives, fields, grids, ledgers, manifests, meshes, models, options, scales, special
from .case import Case
from .judge import Outcome, try_case
from .running import Child

THEMES = (grids, archives, fields, scales, options, manifests, ledgers, models, meshes, special)
ALONE = (models, meshes, special)  # all of them may hang or crash


def make_cases(seed: int = 0) -> list[Case]:
    """Return the whole corpus; the same for the same seed."""
    return [
        replace(case, alone=case.alone or theme in ALONE)
        for theme in THEMES
        for case in theme.cases(seed)
    ]


def spread(cases: list[Case], count: int, seed: int = 0) -> list[Case]:
    """Return so many of the cases, evenly over the list; the seed says where it begins."""
    step = max(1.0, len(cases) / count)
    first = (seed * 0.618) % 1 * step
    return [cases[int(first + k * step)] for k in range(min(count, len(cases)))]


SHOWN = 25  # faults
TELL = 100  # cases between two words on how far it is


def main() -> int:
    """Run what is asked for, print the table and the faults; 1 if there is any."""
    asked = parse()
    start = time.perf_counter()
    lines = try_fields(asked.fields, asked.seed) if asked.fields else try_cases(asked)
    for line in lines[:SHOWN]:
        print(line)
    print(f"{len(lines)} faults, {time.perf_counter() - start:.0f} s")
    return int(bool(lines))


def parse() -> argparse.Namespace:
    """Return what is asked for."""
    parser = argparse.ArgumentParser(prog="python -m lab corpus")
    parser.add_argument("--whole", action="store_true", help="All cases, not a sample.")
    parser.add_argument("--only", default="", metavar="TEXT", help="Cases with this in the name.")
    parser.add_argument("--count", type=int, default=500, help="Cases of a sample.")
    parser.add_argument("--fields", type=int, metavar="N", help="Random fields, and no cases.")
    parser.add_argument("--seed", type=int, default=0, help="Of all that is random.")
    parser.add_argument("--faults", type=Path, metavar="FILE", help="Write all faults there too.")
    return parser.parse_args()


def try_cases(asked: argparse.Namespace) -> list[str]:
    """Run cases, print the table, and return the faults, a line each."""
    cases = [case for case in make_cases(asked.seed) if asked.only in case.name]
    if not (asked.whole or asked.only):
        cases = spread(cases, asked.count, asked.seed)
    outcomes = list(watched(run_all(cases), len(cases), asked.faults))
    print(table(outcomes))
    return [line for outcome in outcomes for line in outcome.lines()]


def try_fields(count: int, seed: int) -> list[str]:
    """Mesh random fields and return the faults."""
    from super_sdf import load_network

    from .random_fields import faults_of_field, make_fields

    network = load_network("fast", threads=1)
    faults: list[str] = []
    for field in make_fields(count, seed):
        faults += faults_of_field(field, network)
    print(f"{count} fields")
    return faults


def run_all(cases: Iterable[Case]) -> Iterator[Outcome]:
    """Run cases in a child, one after another."""
    child = Child()
    try:
        for case in cases:
            yield try_case(case, child.run)
    finally:
        child.stop()


def watched(outcomes: Iterable[Outcome], count: int, faults: Path | None) -> Iterator[Outcome]:
    """Pass outcomes on; write their faults as they come, and say now and then how far it is."""
    with open(faults or os.devnull, "w", encoding="utf-8", errors="replace") as file:
        for number, outcome in enumerate(outcomes, 1):
            file.writelines(f"{line}\n" for line in outcome.lines())
            file.flush()
            if number % TELL == 0:
                print(f"{number} of {count}: {outcome.case.name}", file=sys.stderr, flush=True)
            yield outcome


def table(outcomes: Iterable[Outcome]) -> str:
    """Return how the cases of each theme ended, a line a theme."""
    counts: dict[str, Counter[str]] = {}
    kinds: set[str] = set()
    for outcome in outcomes:
        found = {fault.kind for fault in outcome.faults}
        row = counts.setdefault(outcome.case.theme, Counter())
        row.update(["cases", f"exit {outcome.run.code}", *found])
        kinds |= found
    heads = ["cases", "exit 0", "exit 1", "exit 2", *sorted(kinds)]
    total = sum(counts.values(), Counter())
    rows = {**counts, "all": total}
    lines = [" | ".join(["theme", *heads])]
    lines += [" | ".join([theme, *(str(row[h]) for h in heads)]) for theme, row in rows.items()]
    return "\n".join(lines)
