"""One case from its files to its faults."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from .case import Case
from .judge import Fault, judge, snapshot
from .running import Run


@dataclass(frozen=True)
class Outcome:
    """How a case ended, and what is wrong with that."""

    case: Case
    run: Run
    faults: list[Fault]

    def lines(self) -> list[str]:
        """Return the faults, a line each."""
        return [f"{self.case.name}\t{fault.kind}\t{fault.what}" for fault in self.faults]


def try_case(case: Case, run_words: Callable[[Sequence[str], Path], Run]) -> Outcome:
    """Build a case in an empty folder, run it and judge it."""
    with tempfile.TemporaryDirectory(prefix="corpus-") as name:
        folder = Path(os.path.realpath(name))
        case.build(folder)
        before = snapshot(folder)
        run = run_words(case.words, folder)
        return Outcome(case, run, judge(case, run, folder, before))
