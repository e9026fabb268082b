"""Figures that no shape and method of ``measuring`` gives: formulas, thick slices, and residuals.

The truth of a formula is marching cubes of itself on a fine grid. Distances are means of both
directions between points on the surfaces, in voxels of the grid, of slices in those of the slices.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.stats import spearmanr

from super_sdf import make_grid, reconstruct
from super_sdf.convert import convert
from super_sdf.options import Options
from super_sdf.errors import GridError
from super_sdf.surface.mesh import Mesh
from super_sdf.network.decoder import Decoder
from super_sdf.truth.solid import Solid

from .forms import FORMS, sample, true_surface
from .kinds import sample_box
from .measuring import network_of
from .metrics import compare_distances, distance, distance_or_dot, sample_surface
from .processes import write_grid
from .rows import Row
from .shapes import RESULT_POINTS, Shape, spread
from .surfaces import EMPTY, closed_isosurface, interpolate_spline

if TYPE_CHECKING:
    from .figures import Bench

Values = NDArray[np.float64]
POINTS = 20_000
FACTOR = 4
SLICES, RATIOS, CUTS = 24, (1.5, 2.5, 5.0), (0.5, 1.0, 2.0)
MOST_PARTS = 4


def ours(values: Values, spacing: Any, low: Any, network: Decoder) -> tuple[Mesh, str]:
    """Return the mesh of super-sdf, and what it took the values for.

    Where values and spacing contradict each other, the user says that this is meant.
    """
    for told in ("auto", "scaled"):
        try:
            grid = make_grid(values, spacing=spacing, origin=low, field=told)
            mesh = reconstruct(grid, network, factor=FACTOR)
        except GridError:
            continue
        return mesh, grid.field.kind if told == "auto" else f"{grid.field.kind}, told"
    return EMPTY, "refused"


def form_rows(bench: Bench) -> list[Row]:
    """Measure closed forms that are no distances."""
    rows = []
    for name, size in product(FORMS, bench.sizes[:2]):
        words = {"set": "forms", "kind": name, "size": size}
        found = bench.kept(words, partial(measure_form, name, size, bench))
        facts = {"taken_as": found["taken_as"]}
        for method in ("mc", "bspline", "ours"):
            rows.append({**words, "method": method, "voxels": found[method], **facts})
    return rows


def measure_form(name: str, size: int, bench: Bench) -> Row:
    """Return the distances of the meshes of a form from the truth."""
    values, h, low = sample(FORMS[name], size)
    truth, network = true_surface(FORMS[name]), network_of(bench.network, "auto", 0)
    spline = interpolate_spline(values, FACTOR, 3)
    mesh, taken_as = ours(values, h, low, network)
    meshes = {
        "mc": closed_isosurface(values, h, low),
        "bspline": closed_isosurface(spline, h / FACTOR, low - h / 2),
        "ours": mesh,
    }
    return {
        **{m: distance(truth, mesh, POINTS) / h for m, mesh in meshes.items()},
        "taken_as": taken_as,
    }


def slice_rows(bench: Bench) -> list[Row]:
    """Measure masks and truncated distances with thick slices, on some turned CAD parts."""
    found: dict[tuple[float, str], list[Row]] = {}
    for path in spread(bench.parts, MOST_PARTS):
        for ratio in RATIOS:
            words = {"set": "slices", "part": path.stem, "size": SLICES, "ratio": ratio}
            row = bench.kept(words, partial(measure_slices, path, ratio, bench))
            for method, figures in row["methods"].items():
                found.setdefault((ratio, method), []).append(figures)
    return [
        {
            **{"set": "slices", "kind": f"{ratio:g}", "method": method, "grids": len(rows)},
            "voxels": float(np.mean([row["distance"] for row in rows])),
            "largest": max(row["distance"] for row in rows),
            "pieces": sum(row["pieces"] for row in rows),
        }
        for (ratio, method), rows in found.items()
    ]


def measure_slices(path: Path, ratio: float, bench: Bench) -> Row:
    """Return the figures of all methods on a part with slices some spacings apart."""
    shape, fine = Shape.read(path, 0), round(SLICES * ratio)
    values = sample_box(shape.solid, (fine, fine, SLICES), 1.0).astype(float)
    spacing = 1 / np.array(values.shape)
    network = network_of(bench.network, "auto", 0)
    found = {}
    for method, mesh in sliced_meshes(values, spacing, network):
        off = distance(shape.mesh, mesh, POINTS) / spacing[2]
        found[method] = {
            "distance": off,
            "pieces": mesh.components()[0],
        }
    return {"methods": found}


def sliced_meshes(values: Values, spacing: Values, network: Decoder) -> Iterator[tuple[str, Mesh]]:
    """Yield the meshes of a mask, and of distances that are cut off.

    "repeated": each slice is repeated to the finest spacing. "between": distances between samples
    are interpolated to it (shape-based interpolation). Both are masks then.
    """
    inside, low, finest = values <= 0, spacing / 2 - 0.5, np.full(3, spacing[0])
    ratio = float(spacing[2] / spacing[0])
    yield "mask: MC", closed_isosurface((0.5 - inside).astype(np.float32), spacing, low)
    repeated = resliced(inside.astype(float), ratio, 0) > 0.5
    yield "mask: repeated", ours(repeated, finest, finest / 2 - 0.5, network)[0]
    out, into = (ndimage.distance_transform_edt(s, sampling=spacing) for s in (~inside, inside))
    between = resliced(out - into, ratio, 1) <= 0
    yield "mask: between", ours(between, finest, finest / 2 - 0.5, network)[0]
    yield "mask: ours", ours(inside, spacing, low, network)[0]
    for cut in (*CUTS, np.inf):
        clipped = np.clip(values, -cut * spacing[2], cut * spacing[2])
        name = f"cut off at {cut:g}" if np.isfinite(cut) else "exact"
        yield f"{name}: MC", closed_isosurface(clipped.astype(np.float32), spacing, low)
        yield f"{name}: ours", ours(clipped, spacing, low, network)[0]


def resliced(values: Values, ratio: float, order: int) -> Values:
    """Return samples interpolated along z to the finest spacing, by splines of an order."""
    z = (np.arange(round(values.shape[2] * ratio)) + 0.5) / ratio - 0.5
    at = np.stack(np.meshgrid(*(np.arange(n) for n in values.shape[:2]), z, indexing="ij"))
    return ndimage.map_coordinates(values, at, order=order, mode="nearest")


def check_rows(bench: Bench) -> list[Row]:
    """Measure how well the residuals of ``super-sdf check`` predict the true error of a mesh.

    By Spearman's rank correlation: over ``shapes``, of the mean residual with the mean error both
    ways; of the ``largest`` of each; over the ``vertices`` of a shape, the median over shapes.
    """
    rows = []
    for size in bench.sizes[:2]:
        found = []
        for path in bench.shapes:
            words = {"check": path.stem, "size": size}
            found.append(bench.kept(words, partial(measure_check, path, size, bench)))
        columns = {key: [row[key] for row in found] for key in found[0]}
        ranks = {
            "shapes": rank(columns["mean"], columns["both_ways"]),
            "largest": rank(columns["largest"], columns["max_error"]),
            "vertices": float(np.median(columns["vertices"])),
        }
        rows.append({"size": size, "grids": len(found), **ranks})
    return rows


def rank(one: Sequence[float], other: Sequence[float]) -> float:
    """Return Spearman's rank correlation; NaN of fewer than two."""
    return float(spearmanr(one, other).statistic) if len(one) > 1 else float("nan")


def measure_check(path: Path, size: int, bench: Bench) -> Row:
    """Return residuals and true errors of a shape's mesh, in voxels."""
    from super_sdf.check.check import check_files

    shape = Shape.read(path)
    with tempfile.TemporaryDirectory() as folder:
        grid = write_grid(shape, size, Path(folder))
        network, options = network_of(bench.network, "auto", 0), Options(inside="negative")
        convert(grid, grid.with_suffix(".ply"), network, options, force=True)
        found = check_files(grid.with_suffix(".ply"), grid, options, intersections=False)
    mesh, summary = found.mesh, found.touching.summary()
    true = shape.solid.distance(mesh.vertices.astype(np.float64))
    said = np.abs(found.residuals_at(mesh.vertices))
    known = np.isfinite(said)
    drawn = sample_surface(mesh, shape.seed(RESULT_POINTS)).points
    there = distance_or_dot(Solid(mesh), shape.drawn.points)
    surfaces = compare_distances(there, distance_or_dot(shape.solid, drawn))
    return {
        **{name: float(summary[name]) for name in ("mean", "largest")},
        "both_ways": surfaces["p2s"] * size,
        "max_error": surfaces["max"] * size,
        "vertices": rank(said[known], true[known]),
    }
