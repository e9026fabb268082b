"""Which kinds of shapes, at which sizes, the error of a network comes from.

    python -m export.kinds src/super_sdf/models/base.onnx --each 8
    python -m export.kinds src/super_sdf/models/base.onnx --each 8 --meshes FOLDER_OF_PLY

Draws as many windows of every procedural family, and of meshes, in each of three ranges of the
diagonal, and prints a table: the mean error of the values near the surface, in hundredths of a
voxel, and 1 - cosine of the gradients there, in hundredths. The last column is the part of the sum
of errors that a kind has if all kinds are drawn equally often.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from export.arguments import Parser, at_least
from export.augment import prepare
from export.dataset import Sample, draw_mesh, find_meshes, make_sample
from export.recipe import Errors, measure
from export.shapes.draws import unit_sized
from export.shapes.solid import FAMILIES, Family, is_usable, mesh_of
from export.to_onnx import read_network
from super_sdf import Mesh

RANGES = ((7.0, 17.0), (17.0, 41.0), (41.0, 100.0))  # voxels along the diagonal
Draw = Callable[[np.random.Generator], Mesh]


def drawn_from(family: Family) -> Draw:
    """Return a function that draws plain solids of a family, without features or bends."""

    def draw(rng: np.random.Generator) -> Mesh:
        solid = unit_sized(family(rng))
        while not is_usable(solid):
            solid = unit_sized(family(rng))
        return mesh_of(solid)

    return draw


def draw_windows(
    rng: np.random.Generator, draw: Draw, sizes: tuple[float, float], count: int
) -> list[Sample]:
    windows: list[Sample] = []
    while len(windows) < count:
        sample = make_sample(rng, draw(rng), sizes=sizes)
        windows += [sample] if sample else []
    return windows


def format_table(rows: dict[str, list[Errors]]) -> str:
    """Return the table, kinds with the largest errors first."""
    means = {kind: np.mean([errors.near for errors in row]) for kind, row in rows.items()}
    columns = [f"{low:g} to {high:g}" for low, high in RANGES]
    lines = [f"| kind | {' | '.join(columns)} | part of all |", "| --- " + "| ---: " * 4 + "|"]
    for kind in sorted(rows, key=lambda kind: -means[kind]):
        cells = [f"{100 * errors.near:.2f}, {100 * errors.normal:.1f}" for errors in rows[kind]]
        part = means[kind] / sum(means.values())
        lines.append(f"| {kind} | {' | '.join(cells)} | {100 * part:.1f} % |")
    return "\n".join(lines)


def main() -> None:
    """Print the table of a network."""
    parser = Parser(description=__doc__.split("\n")[0])
    parser.add_argument("model", type=Path, help="an .onnx file of export.to_onnx")
    parser.add_argument("--meshes", type=Path, help="folder of closed .ply meshes, one kind more")
    parser.add_argument("--each", type=at_least(1), default=8, help="windows of a kind and size")
    parser.add_argument("--seed", type=at_least(0), default=0)
    options = parser.parse_args()
    with parser.one_line_errors():
        print(format_table(measure_kinds(options)))


def measure_kinds(options: argparse.Namespace) -> dict[str, list[Errors]]:
    net = read_network(options.model)
    kinds = {name: drawn_from(family) for name, family in FAMILIES.items()}
    if options.meshes:
        files = find_meshes(options.meshes)[1]
        kinds["meshes"] = lambda rng: draw_mesh(rng, files[rng.integers(len(files))])
    rows: dict[str, list[Errors]] = {}
    for number, (kind, draw) in enumerate(kinds.items()):
        rng = np.random.default_rng([options.seed, number])
        drawn = [draw_windows(rng, draw, sizes, options.each) for sizes in RANGES]
        rows[kind] = [measure(net, [prepare(sample) for sample in some]) for some in drawn]
    return rows


if __name__ == "__main__":
    main()
