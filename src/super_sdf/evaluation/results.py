"""The rows of a scope as the tables want them: by setting and method, in the order of the shapes.

A failure is no score, and methods are compared on the same shapes: a shape of which a method could
not be measured in a setting is left out of that setting's tables for all methods, and named.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from .cases import Setting
from .measuring import NO_SETTING, Measurement, Task
from .names import FLOOR
from .runner import LeftOut
from .scope import Scope
from .store import Store


class Results:
    """The rows of a scope, shape by shape.

    Attributes
    ----------
    left_out : shapes that could not be measured at all, and those that failed somewhere
    floors : the row of the reference against itself, by shape; only shapes that have it count
    """

    def __init__(
        self, scope: Scope, tasks: Sequence[Task], store: Store, left_out: Sequence[LeftOut]
    ) -> None:
        self.scope, self.tasks, self.store = scope, tasks, store
        failures = list(self._failures(tasks))
        self.left_out = [*left_out, *(LeftOut(task.path.stem, said) for task, said in failures)]
        self.failed: dict[Setting, set[str]] = {}
        for task, _ in (pair for pair in failures if pair[0].limit is None):  # no peer's
            self.failed.setdefault(task.setting, set()).add(task.path.stem)
        found = [store.get(task, FLOOR) for task in tasks if FLOOR in task.methods]
        self.floors = {row["shape"]: row for row in found if row and row["error"] is None}

    def _failures(self, tasks: Sequence[Task]) -> Iterator[tuple[Task, str]]:
        """Yield what failed of each task, and why; what ran out of time is in the peers' table."""
        for task in tasks:
            methods: dict[str, list[str]] = {}
            for method in task.methods:
                row = self.store.get(task, method)
                if row and row["error"] is not None and row.get("limit") is None:
                    methods.setdefault(row["error"], []).append(method)
            for reason, names in methods.items():
                yield task, f"{', '.join(names)} ({task.setting}): {reason}"

    def names(self, paths: Sequence[Path]) -> list[str]:
        """Return the names of those shapes among the paths that were measured."""
        return [path.stem for path in paths if path.stem in self.floors]

    def rows(self, setting: Setting, method: str, paths: Sequence[Path] = ()) -> list[Measurement]:
        """Return a method's rows, in the order of the paths (all shapes unless given).

        With the excess CD: what CD is above that of two perfect samplings of the reference.
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
        """Return the rows of a method that its limit ended."""
        rows = self._rows(setting, method, self.names(paths))
        return [row for row in rows if row["error"] is not None and row.get("limit") is not None]

    def _rows(self, setting: Setting, method: str, names: Sequence[str]) -> list[Measurement]:
        """Return the rows of the shapes named that are in the store."""
        tasks = {
            task.path.stem: task
            for task in self.tasks
            if task.setting == setting and method in task.methods
        }
        found = [self.store.get(tasks[name], method) for name in names if name in tasks]
        return [row for row in found if row is not None]

    def by_method(self, setting: Setting) -> dict[str, list[Measurement]]:
        """Return the rows of each method of the main table, the floor last."""
        return {name: self.rows(setting, name) for name in (*self.scope.methods, FLOOR)}
