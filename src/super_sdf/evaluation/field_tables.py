"""The tables of grids that are not exact distances: a row for each kind of grid and method."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .cases import Setting
from .field_kinds import KINDS, Kind, kinds_at
from .measuring import Measurement
from .names import FIELD_METHOD_LABELS, OURS, on_kind
from .results import Results
from .tables import F1, NC, markdown, mean_of, title_of

FURTHER = 0.02  # share by which a result further from the truth than marching cubes is named
COUNTS = ("closed", "refused", "taken as", "further than MC")
FIGURES = ("mean distance", "largest", F1.title, NC.title, "volume off %", "at most %", "pieces")
FIELD_LINES = """\
Each kind is made from the exact samples of the shapes, and every method is given the same values.
Distances are point-to-surface, the mean of both directions, in voxels (of the coarsest spacing):
their mean over the grids, and the largest. The volume is compared with that of the reference;
pieces are connected components, of all meshes together. "Refused" counts the grids that super-sdf
did not take; they are left out of the rows of that kind for all methods. "Taken as" is what
super-sdf took the values for, "told" how often only after `--field scaled`. The last column counts
the grids on which super-sdf is more than 2 % further from the truth than marching cubes."""


@dataclass(frozen=True)
class OnKind:
    """The measurements on the kinds of one title, on the grids that no method failed on.

    Attributes
    ----------
    title : str
    by_method : dict of lists
        Measurements of each method, in the same order of grids, without the refused ones.
    refused : list
        Measurements of super-sdf on the grids that it refused.
    is_cubic : bool
        Whether the spacing is the same on all axes.
    """

    title: str
    by_method: dict[str, list[Measurement]]
    refused: list[Measurement]
    is_cubic: bool


def field_section(results: Results) -> str:
    """Return the section on grids that are not exact distances, with a table for each size."""
    sizes = results.scope.sizes
    title = title_of("Grids that are not exact distances", results.scope.experiment_paths())
    parts = [size_part(results, size) for size in sizes]
    return "\n\n".join([title, FIELD_LINES, *parts])


def size_part(results: Results, size: int) -> str:
    """Return the table of one size, and the names of the grids that need a look."""
    found = measured_on_kinds(results, size)
    rows = [
        [one.title, *method_row(one, method, size)] for one in found for method in one.by_method
    ]
    titles = ["values", "method", "grids", *FIGURES, *COUNTS]
    lines = [*reference_line(found), *equal_spacing_lines(found)]
    lines += [line for one in found for line in lines_of(one, size)]
    return "\n\n".join([f"**{size}^3**", markdown(titles, rows), *lines])


def measured_on_kinds(results: Results, size: int) -> list[OnKind]:
    """Return the measurements of one size, by the titles of the kinds."""
    names = kinds_at(size, results.scope.sizes, results.scope.kinds)
    found = []
    for title in dict.fromkeys(KINDS[name].title for name in names):
        alike = [name for name in names if KINDS[name].title == title]
        grids = [grid for name in alike for grid in measured_on(results, Setting(size), name)]
        found.append(on_kind_of(KINDS[alike[0]], grids))
    return found


def measured_on(results: Results, setting: Setting, kind: str) -> list[dict[str, Measurement]]:
    """Return the measurements by method on each shape on which none of them failed."""
    paths, methods = results.scope.experiment_paths(), KINDS[kind].methods
    rows = {
        method: {row["shape"]: row for row in results.rows(setting, on_kind(method, kind), paths)}
        for method in methods
    }
    shapes = [name for name in results.names(paths) if all(name in rows[m] for m in methods)]
    return [{method: rows[method][name] for method in methods} for name in shapes]


def on_kind_of(kind: Kind, grids: Sequence[dict[str, Measurement]]) -> OnKind:
    """Return measurements by method, those of refused grids apart."""
    refused = [grid[OURS] for grid in grids if grid[OURS].get("refused")]
    taken = [grid for grid in grids if not grid[OURS].get("refused")]
    by_method = {method: [grid[method] for grid in taken] for method in kind.methods}
    return OnKind(kind.title, by_method, refused, kind.is_cubic)


def method_row(one: OnKind, method: str, size: int) -> list[str]:
    """Return the cells of a method on a kind, from its name on."""
    rows = one.by_method[method]
    far = [size * row["p2s"] for row in rows]
    off = [100 * abs(row["volume_off"]) for row in rows]
    figures = [
        *(f"{pick(far):.4f}" if far else "-" for pick in (np.mean, max)),
        *(column.cell(mean_of(rows, column.key)) for column in (F1, NC)),
        *(f"{pick(off):.1f}" if off else "-" for pick in (np.mean, max)),
        str(sum(row["pieces"] for row in rows)),
        f"{sum(row['closed'] for row in rows)} of {len(rows)}",
    ]
    own = ours_cells(one) if method == OURS else ["-"] * 3
    return [FIELD_METHOD_LABELS[method], str(len(rows)), *figures, *own]


def ours_cells(one: OnKind) -> list[str]:
    """Return how many grids were refused, what the others were taken as, and how many are worse."""
    rows = one.by_method[OURS]
    kinds = Counter(row["taken_as"] for row in rows)
    told = sum(bool(row.get("told")) for row in rows)
    words = [f"{kind} {count}" for kind, count in kinds.most_common()]
    words += [f"told {told}"] if told else []
    worse = f"{len(further(one))} of {len(rows)}"
    return [str(len(one.refused)), ", ".join(words) or "-", worse]


def further(one: OnKind) -> list[tuple[Measurement, Measurement]]:
    """Return the measurements of ours and of marching cubes where ours is further by a share."""
    pairs = zip(one.by_method[OURS], one.by_method["mc"])
    return [(mine, mc) for mine, mc in pairs if mine["p2s"] > (1 + FURTHER) * mc["p2s"]]


def lines_of(one: OnKind, size: int) -> list[str]:
    """Return lines that name the grids that are worse than marching cubes, or refused."""
    worse = [
        f"{mine['shape']} ({size * mine['p2s']:.4f}, MC {size * mc['p2s']:.4f})"
        for mine, mc in further(one)
    ]
    lines = [f"Further from the truth than MC, {one.title}: {', '.join(worse)}."] if worse else []
    reasons: dict[str, list[str]] = {}
    for row in one.refused:
        reasons.setdefault(row["refused"], []).append(row["shape"])
    return lines + [
        f"Refused, {one.title}: {', '.join(shapes)}: {reason}."
        for reason, shapes in reasons.items()
    ]


def equal_spacing_lines(found: Sequence[OnKind]) -> list[str]:
    """Return lines that compare unequal spacings with the coarsest one on all axes.

    That grid has fewer samples, so a larger error than there is a loss.
    """
    base = {
        row["shape"]: row["p2s"]
        for one in found
        for row in one.by_method[OURS]
        if one.title == "exact" and row["p2s"] > 0
    }
    lines = []
    for one in found if base else ():
        worst = "; ".join(worst_ratio(one, method, base) for method in one.by_method)
        if not one.is_cubic and one.by_method[OURS]:
            what = "error over that of super-sdf with the coarsest spacing on all axes"
            lines.append(f"{one.title}, {what}, at most: {worst}.")
    return lines


def worst_ratio(one: OnKind, method: str, base: Mapping[str, float]) -> str:
    """Return the largest error of a method over that of the same shape in ``base``, and where."""
    ratios = [
        (row["p2s"] / base[row["shape"]], row["shape"])
        for row in one.by_method[method]
        if row["shape"] in base
    ]
    ratio, shape = max(ratios, default=(float("nan"), "-"))
    return f"{FIELD_METHOD_LABELS[method]} {ratio:.2f} ({shape})"


def reference_line(found: Sequence[OnKind]) -> list[str]:
    """Return a line on the pieces of the references, if any were measured."""
    pieces = {
        row["shape"]: row["pieces_of_reference"]
        for one in found
        for row in (*one.by_method[OURS], *one.refused)
    }
    if not pieces:
        return []
    return [f"Pieces of the references, of {len(pieces)} shapes together: {sum(pieces.values())}."]
