"""The measurements of a scope, by setting and method, in the order of the shapes.

A failure is not a score, and methods are compared on the same shapes: if a method failed on a shape
in a setting, the shape is left out of that setting's tables for all methods, and named.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from .cases import Setting
from .field_methods import FIELD_METHODS
from .measuring import NO_SETTING, Measurement, Task
from .names import FLOOR
from .runner import LeftOut
from .scope import Scope
from .store import Store

MOST_NAMED = 8  # methods that a line lists


def shortened(names: Sequence[str]) -> str:
    """Return names with commas; of many the first, and the number of the others."""
    more = len(names) - MOST_NAMED
    return ", ".join([*names[:MOST_NAMED], *([f"{more} more"] if more > 0 else [])])


class Results:
    """The measurements of a scope.

    Attributes
    ----------
    left_out : list of LeftOut
        Shapes that could not be measured at all, or failed in some setting.
    failed : dict of sets
        The names of the shapes that failed, by setting.
    floors : dict of measurements
        The reference against itself, by shape; shapes without it are in no table.
    """

    def __init__(
        self, scope: Scope, tasks: Sequence[Task], store: Store, left_out: Sequence[LeftOut]
    ) -> None:
        self.scope, self.tasks, self.store = scope, tasks, store
        failures = list(self._failures(tasks))
        self.left_out = [*left_out, *(LeftOut(t.path.stem, reason) for t, _, reason in failures)]
        self.failed: dict[Setting, set[str]] = {}
        for task, methods, _ in failures:
            # Not of a peer or a kind of grid: these are compared on the shapes that they finished.
            if task.limit is None and not FIELD_METHODS.keys() >= set(methods):
                self.failed.setdefault(task.setting, set()).add(task.path.stem)
        rows = [store.get(task, FLOOR) for task in tasks if FLOOR in task.methods]
        self.floors = {row["shape"]: row for row in rows if row and row["error"] is None}

    def _failures(self, tasks: Sequence[Task]) -> Iterator[tuple[Task, list[str], str]]:
        """Yield each task with the methods that failed for a reason, and the reason in words.

        What ran out of time is in the peers' table.
        """
        for task in tasks:
            methods: dict[str, list[str]] = {}
            for method in task.methods:
                row = self.store.get(task, method)
                if row and row["error"] is not None and row.get("limit") is None:
                    methods.setdefault(row["error"], []).append(method)
            for reason, names in methods.items():
                yield task, names, f"{shortened(names)} ({task.setting}): {reason}"

    def names(self, paths: Sequence[Path]) -> list[str]:
        """Return the names of the shapes among the paths that were measured."""
        return [path.stem for path in paths if path.stem in self.floors]

    def rows(self, setting: Setting, method: str, paths: Sequence[Path] = ()) -> list[Measurement]:
        """Return the measurements of a method, in the order of the paths (default: all shapes).

        ``excess_cd`` is added: CD less the CD of two samplings of the reference.
        """
        failed = self.failed.get(setting, set())
        names = [name for name in self.names(paths or self.scope.paths) if name not in failed]
        if method == FLOOR:
            setting = NO_SETTING
        return [
            {**row, "excess_cd": row["cd"] - self.floors[row["shape"]]["cd"]}
            for row in self._rows(setting, method, names)
            if row["error"] is None
        ]

    def out_of_time(
        self, setting: Setting, method: str, paths: Sequence[Path]
    ) -> list[Measurement]:
        """Return the measurements of a method that its time limit ended."""
        rows = self._rows(setting, method, self.names(paths))
        return [row for row in rows if row["error"] is not None and row.get("limit") is not None]

    def _rows(self, setting: Setting, method: str, names: Sequence[str]) -> list[Measurement]:
        """Return the measurements of the named shapes that are in the store."""
        tasks = {
            task.path.stem: task
            for task in self.tasks
            if task.setting == setting and method in task.methods
        }
        rows = [self.store.get(tasks[name], method) for name in names if name in tasks]
        return [row for row in rows if row is not None]

    def by_method(self, setting: Setting) -> dict[str, list[Measurement]]:
        """Return the measurements of each method of the main table, the floor last."""
        return {name: self.rows(setting, name) for name in (*self.scope.methods, FLOOR)}
