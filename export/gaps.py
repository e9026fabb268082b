"""The gap closed on each half of the validation shapes, from the measurements of ``evaluate``.

    python -m lab evaluate FOLDER --sizes 32 64 128 --out report/
    python -m export.gaps FOLDER report/

Prints a row for each size and half (``choice``): the means of F1, NC and the distance from result
to reference, and the share of the gap between B-spline and the bound that each closes. Of several
reports the first that has a measurement counts, so a network measured with ``--methods ours`` is
compared by the report of another: ``python -m export.gaps FOLDER report/best report/base``.
Within a report the last measurement counts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from export.arguments import Parser
from lab.evaluate import ROWS
from lab.methods import OURS
from lab.rows import Row, Rows
from lab.shapes import Setting, draw_halves, find_meshes
from lab.tables import Column, gap_closed, markdown, mean_of, percent
from super_sdf.errors import FileError

FIGURES = (
    Column("F1", "f1", digits=4),
    Column("NC", "nc", digits=4),
    Column("result to reference x1e4", "p2s_back", 1e4, 4),
)
COMPARED = (OURS, "bspline", "bound")
SIZES = (32, 64, 128)


def read_rows(reports: Sequence[Path], size: int) -> dict[str, dict[str, Row]]:
    """Return the measurements at a size, by method and shape; the first report that has one counts.

    Only exact samples of whole shapes, refined once by 4: not those of experiments.
    """
    setting = asdict(Setting(size)).items()
    found: dict[str, dict[str, Row]] = {method: {} for method in COMPARED}
    for report in reversed(reports):
        if not (report / ROWS).is_file():
            raise FileError(f"{report} has no {ROWS}: give the --out of python -m lab evaluate")
        for row in Rows(report / ROWS):
            if row["method"] in found and setting <= row.items() and row["error"] is None:
                found[row["method"]][row["shape"]] = row
    return found


def gap_row(found: dict[str, dict[str, Row]], names: Sequence[str]) -> list[str]:
    """Return the cells of the shapes that all methods were measured on."""
    common = [name for name in names if all(name in rows for rows in found.values())]
    ours, base, bound = ([found[method][name] for name in common] for method in COMPARED)
    cells = [str(len(common))]
    for column in FIGURES:
        cells.append(column.cell(mean_of(ours, column.key)))
        cells.append(percent(gap_closed(ours, base, bound, column.key), digits=1))
    return cells


def gap_rows(meshes: Sequence[Path], reports: Sequence[Path]) -> Iterator[list[str]]:
    """Yield the rows of the table: all shapes and each half, at each size that was measured."""
    names = [path.stem for path in meshes]
    halves = {"all": names, **draw_halves(names)}
    for size in SIZES:
        found = read_rows(reports, size)
        if all(found.values()):
            for half, some in halves.items():
                yield [f"{size}^3", half, *gap_row(found, some)]


def main() -> None:
    """Print the table."""
    parser = Parser(description=__doc__.split("\n")[0])
    parser.add_argument("meshes", type=Path, help="folder of the shapes")
    parser.add_argument("reports", nargs="+", type=Path, help="folders of python -m lab evaluate")
    options = parser.parse_args()
    titles = ["grid", "half", "shapes"]
    for column in FIGURES:
        titles += [column.title, "gap closed"]
    with parser.one_line_errors():
        rows = list(gap_rows(find_meshes([options.meshes]), options.reports))
    if not rows:
        parser.error("no report has ours, bspline and bound at 32, 64 or 128: measure them first")
    print(markdown(titles, rows))


if __name__ == "__main__":
    main()
