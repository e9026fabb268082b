"""Grids that are not exact distances: super-sdf beside what people do today, against the truth.

    python -m benchmarks.fields validation/ --kinds mask --size 32 --shapes 10
    python -m benchmarks.fields validation/ --kinds truncated noisy exact
    python -m benchmarks.fields --kinds scaled                      # closed forms and neural fields
    python -m benchmarks.fields parts/ --kinds mask --shapes 24 --turned 0

Distances are means of both directions between points on the surfaces, in voxels of the grid. For
masks there are also the volume over the true one, and the pieces. Needs the extra eval, and for
neural fields PyTorch (``--neural``).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from super_sdf import Mesh, load_network, make_grid, reconstruct
from super_sdf.errors import SuperSdfError
from super_sdf.evaluation import metrics
from super_sdf.evaluation.cases import Case, Setting, Shape
from super_sdf.evaluation.methods import EMPTY, interpolate_spline, isosurface
from super_sdf.network.decoder import Decoder
from super_sdf.truth.solid import Solid

POINTS = 20_000
WIDTHS = (0.5, 0.8, 1.2)  # of the Gaussians by which masks are smoothed, in voxels
CUTS = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0)  # voxels
NOISES = (0.1, 0.25)  # amplitudes, voxels
FACTOR = 4


@dataclass(frozen=True)
class Score:
    """How far a mesh is from the truth, in voxels; its volume over the true one; its pieces."""

    distance: float
    volume: float
    pieces: int


def score(truth: Mesh, mesh: Mesh, spacing: float) -> Score:
    """Compare a mesh with the true surface."""
    if not len(mesh.faces):
        return Score(float("nan"), 0.0, 0)
    there = metrics.sample_surface(truth, (1, 1), POINTS).points
    back = metrics.sample_surface(mesh, (1, 2), POINTS).points
    far = (
        np.abs(Solid(mesh).nearest(there)[0]).mean() + np.abs(Solid(truth).nearest(back)[0]).mean()
    )
    return Score(float(far) / 2 / spacing, mesh.volume() / truth.volume(), count_pieces(mesh))


def count_pieces(mesh: Mesh) -> int:
    """Return the number of connected components."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b, c = mesh.faces.T
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    size = len(mesh.vertices)
    joined = coo_matrix((np.ones(len(ends[0]), bool), ends), (size, size))
    unused = size - len(np.unique(mesh.faces))
    return int(connected_components(joined, directed=False)[0]) - unused


def coarse_mesh(values: np.ndarray, spacing: float, low: float) -> Mesh:
    """Return marching cubes of samples, closed at the border; ``low`` is where the first one is."""
    padded = np.pad(values.astype(np.float32), 1, constant_values=max(float(values.max()), spacing))
    return isosurface(padded, spacing, low - spacing)


def ours(
    values: np.ndarray, spacing: float, low: float, network: Decoder, field: str = "auto"
) -> tuple[Mesh, str]:
    """Return the mesh of super-sdf, and what it took the values for."""
    try:
        grid = make_grid(values, spacing=spacing, origin=low, field=field)
        return reconstruct(grid, network, FACTOR, cap=True), grid.field.kind
    except SuperSdfError as error:
        print(f"  refused: {error}", flush=True)
        return EMPTY, "refused"


def distances_of(inside: np.ndarray) -> np.ndarray:
    """Return SciPy's distances of a mask, in voxels, half a voxel less on either side."""
    out, into = (ndimage.distance_transform_edt(side) for side in (~inside, inside))
    return np.where(inside, 0.5 - into, out - 0.5)


Methods = Iterator[tuple[str, Mesh, str]]
Cases = Iterator[tuple[str, Mesh, float, Methods]]


def mask_methods(case: Case, network: Decoder) -> Methods:
    """Yield the meshes of the mask of a case."""
    h, low = case.spacing, case.low + case.spacing / 2
    inside = np.asarray(case.coarse) <= 0
    mask = inside.astype(np.uint8)
    yield "mask: marching cubes", coarse_mesh(0.5 - mask, h, low), ""
    yield "mask: marching cubes of its distances", coarse_mesh(distances_of(inside), h, low), ""
    for width in WIDTHS:
        smooth = 0.5 - ndimage.gaussian_filter(mask.astype(np.float32), width, mode="nearest")
        yield f"mask: marching cubes, Gaussian {width:g}", coarse_mesh(smooth, h, low), ""
    yield "mask: super-sdf", *ours(mask, h, low, network)


def distance_methods(case: Case, network: Decoder, name: str, values: np.ndarray) -> Methods:
    """Yield the meshes of values that are nearly distances."""
    h, low = case.spacing, case.low + case.spacing / 2
    yield f"{name}: marching cubes", coarse_mesh(values, h, low), ""
    spline = interpolate_spline(values, FACTOR, 3)
    yield f"{name}: B-spline", isosurface(spline, h / FACTOR, case.low), ""
    yield f"{name}: super-sdf", *ours(values, h, low, network)


def truncated_methods(case: Case, network: Decoder) -> Methods:
    """Yield the meshes of a case cut off at several distances, and one cut off unevenly."""
    h, exact = case.spacing, np.asarray(case.coarse)
    for cut in CUTS:
        values = np.clip(exact, -cut * h, cut * h)
        yield from distance_methods(case, network, f"cut off at {cut:g}", values)
    yield from distance_methods(case, network, "cut off at -1 and 2.5", np.clip(exact, -h, 2.5 * h))


def noisy_methods(case: Case, network: Decoder) -> Methods:
    """Yield the meshes of a case with uniform noise."""
    random = np.random.default_rng(0)
    for noise in NOISES:
        shift = random.uniform(-noise, noise, case.coarse.shape) * case.spacing
        values = (case.coarse + shift).astype(np.float32)
        yield from distance_methods(case, network, f"noise of {noise:g}", values)


def exact_methods(case: Case, network: Decoder) -> Methods:
    """Yield the meshes of the exact distances."""
    yield from distance_methods(case, network, "exact", np.asarray(case.coarse))


OF_SHAPES: dict[str, Callable[[Case, Decoder], Methods]] = {
    "mask": mask_methods,
    "truncated": truncated_methods,
    "noisy": noisy_methods,
    "exact": exact_methods,
}


def shape_cases(options: argparse.Namespace, kind: str, network: Decoder) -> Cases:
    """Yield the cases of a folder of meshes."""
    files = sorted(options.folder.glob("*.ply"))
    step = max(len(files) // options.shapes, 1)
    for path in files[step // 3 :: step][: options.shapes]:
        shape = Shape.read(path, options.turned)
        case = Case(shape, Setting(options.size))
        yield path.stem, shape.mesh, case.spacing, OF_SHAPES[kind](case, network)


def scaled_cases(options: argparse.Namespace, network: Decoder) -> Cases:
    """Yield the closed forms of ``benchmarks.field_forms``, and neural fields if wanted."""
    from benchmarks.field_forms import FORMS, sample, true_surface

    forms = dict(FORMS)
    if options.neural:
        from benchmarks.neural_fields import neural_forms

        forms |= neural_forms()
    for name, form in forms.items():
        values, spacing, low = sample(form, options.size)
        yield name, true_surface(form), spacing, scaled_methods(values, spacing, low, network)


def scaled_methods(values: np.ndarray, spacing: float, low: float, network: Decoder) -> Methods:
    """Yield the meshes of a field of another slope."""
    yield "scaled: marching cubes", coarse_mesh(values, spacing, low), ""
    spline = interpolate_spline(values, FACTOR, 3)
    yield "scaled: B-spline", isosurface(spline, spacing / FACTOR, low - spacing / 2), ""
    mesh, kind = ours(values, spacing, low, network)
    if kind == "refused":  # its slope contradicts the spacing: the user says that this is meant
        mesh, kind = ours(values, spacing, low, network, "scaled")
    yield "scaled: super-sdf", mesh, kind


def main() -> None:
    """Measure, and print a line for each mesh and a table of the means."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", help="folder of .ply meshes")
    parser.add_argument("--kinds", nargs="+", choices=[*OF_SHAPES, "scaled"], default=["mask"])
    parser.add_argument("--size", type=int, default=32)
    parser.add_argument("--shapes", type=int, default=10)
    parser.add_argument("--turned", type=int, help="seed by which shapes are turned")
    parser.add_argument("--model", default="base")
    parser.add_argument("--neural", action="store_true", help="train neural fields, too")
    options = parser.parse_args()
    network = load_network(options.model, device="cpu")
    found: dict[str, list[Score]] = {}
    for kind in options.kinds:
        cases = (
            scaled_cases(options, network)
            if kind == "scaled"
            else shape_cases(options, kind, network)
        )
        for shape, truth, spacing, methods in cases:
            for method, mesh, taken in methods:
                one = score(truth, mesh, spacing)
                found.setdefault(method, []).append(one)
                print(
                    f"{shape:24} {method:40} {one.distance:.4f} {one.volume:.4f} {one.pieces} "
                    f"{taken}",
                    flush=True,
                )
    print_table(found)


def print_table(found: dict[str, list[Score]]) -> None:
    """Print means over the shapes as a Markdown table."""
    print("\n| | shapes | mean distance | largest | volume off | off most | pieces |")
    print("| --- |" + " ---: |" * 6)
    for method, scores in found.items():
        far = [one.distance for one in scores]
        off = [100 * abs(one.volume - 1) for one in scores]
        pieces = sum(one.pieces for one in scores)
        print(
            f"| {method} | {len(scores)} | {np.nanmean(far):.4f} | {np.nanmax(far):.4f} | "
            f"{np.mean(off):.1f} % | {np.max(off):.1f} % | {pieces} |"
        )


if __name__ == "__main__":
    main()
