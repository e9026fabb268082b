"""Closed forms and neural fields that are no distances: super-sdf beside what people do today.

    python -m benchmarks.fields
    python -m benchmarks.fields --size 64
    python -m benchmarks.fields --neural    # trains neural fields as well; needs PyTorch

Fields that are made from the distances of meshes are measured by
``super-sdf evaluate MESHES --experiments fields``. Here the truth is marching cubes of the form
itself on a fine grid. Distances are means of both directions between points on the surfaces, in
voxels of the grid. Needs the extra eval.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np

from benchmarks.field_forms import FORMS, sample, true_surface
from super_sdf import Mesh, load_network, make_grid, reconstruct
from super_sdf.errors import GridError
from super_sdf.evaluation import metrics
from super_sdf.evaluation.field_methods import closed_isosurface
from super_sdf.evaluation.methods import EMPTY, interpolate_spline
from super_sdf.network.decoder import Decoder
from super_sdf.truth.solid import Solid

POINTS = 20_000
FACTOR = 4
METHODS = ("marching cubes", "B-spline", "super-sdf")


def distance(truth: Mesh, mesh: Mesh, spacing: float) -> float:
    """Return the mean distance between two surfaces, both ways, in voxels; NaN without a mesh."""
    if not len(mesh.faces):
        return float("nan")
    there = metrics.sample_surface(truth, (1, 1), POINTS).points
    back = metrics.sample_surface(mesh, (1, 2), POINTS).points
    far = Solid(mesh).distance(there).mean() + Solid(truth).distance(back).mean()
    return float(far) / 2 / spacing


def ours(values: np.ndarray, spacing: float, low: float, network: Decoder) -> tuple[Mesh, str]:
    """Return the mesh of super-sdf, and what it took the values for.

    Where values and spacing contradict each other, the user says that this is meant.
    """
    for told in ("auto", "scaled"):
        try:
            grid = make_grid(values, spacing=spacing, origin=low, field=told)
            mesh = reconstruct(grid, network, FACTOR, cap=True)
            return mesh, grid.field.kind if told == "auto" else f"{grid.field.kind}, told"
        except GridError as error:
            print(f"  refused: {error}", flush=True)
    return EMPTY, "refused"


def meshes(
    values: np.ndarray, spacing: float, low: float, network: Decoder
) -> Iterator[tuple[Mesh, str]]:
    """Yield the mesh of each of ``METHODS``, and what super-sdf took the values for."""
    yield closed_isosurface(values, spacing, low), ""
    spline = interpolate_spline(values, FACTOR, 3)
    yield closed_isosurface(spline, spacing / FACTOR, low - spacing / 2), ""
    yield ours(values, spacing, low, network)


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, default=32)
    parser.add_argument("--model", default="base")
    parser.add_argument("--neural", action="store_true", help="train neural fields, too")
    options = parser.parse_args()
    network, forms = load_network(options.model, device="cpu"), dict(FORMS)
    if options.neural:
        from benchmarks.neural_fields import neural_forms

        forms |= neural_forms()
    rows = []
    for name, form in forms.items():
        values, spacing, low = sample(form, options.size)
        truth = true_surface(form)
        found = [
            (distance(truth, mesh, spacing), taken)
            for mesh, taken in meshes(values, spacing, low, network)
        ]
        rows.append(f"| {name} | {' | '.join(f'{far:.4f}' for far, _ in found)} | {found[-1][1]} |")
    print(f"\n| {options.size}^3 | {' | '.join(METHODS)} | taken as |")
    print("| --- | ---: | ---: | ---: | ---: |", *rows, sep="\n")


if __name__ == "__main__":
    main()
