"""The rows of a plan as the tables want them: by setting and method, in the order of the shapes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .cases import Setting
from .measuring import FLOOR, NO_SETTING, Row, Task
from .plan import Plan
from .runner import LeftOut, Store


class Results:
    """The rows of a plan, shape by shape, without the shapes that could not be measured."""

    def __init__(
        self, plan: Plan, tasks: Sequence[Task], store: Store, left_out: Sequence[LeftOut]
    ) -> None:
        self.plan, self.tasks, self.store, self.left_out = plan, tasks, store, left_out
        self.floors = {
            row["shape"]: row for row in self._rows(NO_SETTING, FLOOR, self.names(plan.paths))
        }

    def names(self, paths: Sequence[Path]) -> list[str]:
        """Return the names of those shapes among the paths that were measured."""
        gone = {entry.shape for entry in self.left_out}
        return [path.stem for path in paths if path.stem not in gone]

    def rows(self, setting: Setting, method: str, paths: Sequence[Path] = ()) -> list[Row]:
        """Return a method's rows, in the order of the paths (all shapes unless given).

        With the excess CD: what CD is above that of two perfect samplings of the reference.
        """
        names = self.names(paths or self.plan.paths)
        if method == FLOOR:
            setting = NO_SETTING
        return [
            {**row, "excess_cd": row["cd"] - self.floors[row["shape"]]["cd"]}
            for row in self._rows(setting, method, names)
        ]

    def _rows(self, setting: Setting, method: str, names: Sequence[str]) -> list[Row]:
        """Return the rows of the shapes named that are in the store."""
        tasks = {
            task.path.stem: task
            for task in self.tasks
            if task.setting == setting and method in task.methods
        }
        found = [self.store.get(tasks[name], method) for name in names if name in tasks]
        return [row for row in found if row is not None]

    def by_method(self, setting: Setting) -> dict[str, list[Row]]:
        """Return the rows of each method of the main table, the floor last."""
        return {name: self.rows(setting, name) for name in (*self.plan.methods, FLOOR)}
