"""Figures that no shape and method of ``measuring`` gives: formulas and thick slices.

The truth of a formula is marching cubes of itself on a fine grid. Distances are means of both
directions between points on the surfaces, in voxels of the grid, of slices in those of the slices.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from super_sdf import make_grid, reconstruct
from super_sdf.check.surface import count_components
from super_sdf.errors import GridError
from super_sdf.surface.mesh import Mesh
from super_sdf.network.decoder import Decoder

from .forms import FORMS, sample, true_surface
from .kinds import sample_box
from .measuring import network_of
from .metrics import distance
from .rows import Row
from .shapes import Shape, spread
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
            "pieces": count_components(mesh.faces, len(mesh.vertices)),
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
