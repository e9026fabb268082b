"""How good the surfaces are: super-sdf beside its baselines and its bound.

    python -m benchmarks.quality --meshes DIR --sizes 32 64 --out report/

prints a Markdown table a size and writes OUT/per_shape.md. Every figure is kept in
OUT/results.jsonl, a line for each shape, size and method, and is not measured again. The lines of
``ours`` belong to one network file and one state of the package's code: another of either is
measured anew. Every seed comes from the shape's name, so two runs give the same figures.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import sys
import time
import traceback
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from skimage.measure import marching_cubes

import super_sdf
from benchmarks import metrics
from export.sampling import TriMesh, distance, is_inside, load_mesh, sample_grid, unit_grid
from super_sdf import SdfGrid, load_network, reconstruct
from super_sdf.band import find_band, gather_patches, neighbour_table, rescale
from super_sdf.network import DEFAULT_MODEL, shipped_models
from super_sdf.nodes import (
    average_shared,
    block_ijk,
    block_offsets,
    keep_samples,
    number_shared_nodes,
)
from super_sdf.pipeline import Decoder

Row = dict[str, Any]
Key = tuple[Any, ...]

PROTOCOL = 1  # count up when a figure changes its meaning: the lines kept so far are then void
NUDGE = np.float32(1e-9)  # what an exact zero becomes: a vertex on a node can open the surface
EMPTY = TriMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
FLOOR = "floor"
LABELS = {
    "mc": "MC",
    "trilinear": "trilinear + MC",
    "bspline": "B-spline + MC",
    "ours": "ours",
    "bound": "bound: true distance at the nodes",
    FLOOR: "floor: the reference against itself",
}
COLUMNS = (  # title, key, scale, digits
    ("CD x1e5", "cd", 1e5, 3),
    ("excess CD x1e5", "excess_cd", 1e5, 3),
    ("F1", "f1", 1, 3),
    ("NC", "nc", 1, 3),
    ("signed NC", "signed_nc", 1, 3),
    ("p2s x1e4", "p2s", 1e4, 2),
    ("ref to res", "p2s_there", 1e4, 2),
    ("res to ref", "p2s_back", 1e4, 2),
    ("p99 x1e4", "p99", 1e4, 1),
    ("max x1e4", "max", 1e4, 0),
    ("ECD x1e5", "ecd", 1e5, 2),
    ("EF1", "ef1", 1, 3),
    ("field MSE x1e6", "field_mse", 1e6, 2),
    ("field MAE x1e4", "field_mae", 1e4, 2),
)
GAPS = (
    ("F1", "f1"),
    ("NC", "nc"),
    ("excess CD", "excess_cd"),
    ("point-to-surface", "p2s"),
    ("result to reference only", "p2s_back"),  # one-sided: thin parts that are lost do not count
)


# The shape, its coarse grid, and the truth on the fine lattice


class Shape:
    """A reference mesh in the frame, and what is drawn from it once for all methods."""

    def __init__(self, path: Path) -> None:
        self.name = path.stem
        self.mesh = metrics.normalise(load_mesh(str(path)))
        self.drawn = metrics.sample_surface(self.mesh, self.seed(0))
        self.sharp = metrics.sharp_edges(self.mesh)
        self.sharp_drawn = metrics.sample_edges(self.mesh.vertices, self.sharp, self.seed(1))

    def seed(self, stream: int) -> tuple[int, int]:
        """Return the seed of a stream of random numbers: the shape's name and the stream."""
        return zlib.crc32(self.name.encode()), stream


class Case:
    """A shape sampled on the coarse grid of one size; ``fine`` is the spacing of the nodes."""

    def __init__(self, shape: Shape, size: int, factor: int) -> None:
        self.shape, self.size, self.factor = shape, size, factor
        grid_shape, self.spacing, self.origin = unit_grid(size)
        self.coarse = sample_grid(shape.mesh, grid_shape, self.spacing, self.origin)
        self.grid = SdfGrid(self.coarse, (self.spacing,) * 3, tuple(self.origin))
        self.fine = self.spacing / factor

    @cached_property
    def voxels(self) -> np.ndarray:
        """The band (Eq. 2), (V, 3)."""
        return find_band(rescale(self.grid))

    @cached_property
    def band(self) -> np.ndarray:
        """Which fine nodes lie in the blocks of the band, faces included (bool)."""
        active = np.zeros(self.coarse.shape, bool)
        active[tuple(self.voxels.T)] = True
        return spread_to_nodes(active, self.factor)

    @cached_property
    def truth(self) -> np.ndarray:
        """The exact distance at the nodes of the band and of every cell that can be crossed."""
        return exact_field(self)


def spread_to_nodes(voxels: np.ndarray, factor: int) -> np.ndarray:
    """Return which fine nodes lie in the blocks of the given voxels, faces included (bool)."""
    for axis in range(3):
        source = np.moveaxis(voxels, axis, 0)
        target = np.zeros((factor * len(source) + 1, *source.shape[1:]), bool)
        for offset in range(factor + 1):
            target[offset : offset + factor * (len(source) - 1) + 1 : factor] |= source
        voxels = np.moveaxis(target, 0, axis)
    return voxels


def exact_field(case: Case) -> np.ndarray:
    """Return the signed distance, float32, at the fine nodes of the band and of crossing cells.

    A node of a crossing cell is within sqrt(3) h/K of the surface, so its block's sample within
    sqrt(3) (1/2 + 1/K) h. Elsewhere stands the nearest sample, which has the right sign.
    """
    reach = 3**0.5 * (0.5 + 1 / case.factor) * case.spacing
    nearest = np.minimum(np.arange(case.factor * case.size + 1) // case.factor, case.size - 1)
    field = case.coarse.astype(np.float32)[np.ix_(nearest, nearest, nearest)]
    nodes = np.argwhere(case.band | spread_to_nodes(np.abs(case.coarse) < reach, case.factor))
    samples = nearest[nodes]
    apart = np.linalg.norm(nodes - (case.factor * samples + case.factor / 2), axis=1) * case.fine
    points = nodes * case.fine - 0.5
    field[tuple(nodes.T)] = signed_from_samples(
        case.shape.mesh, points, case.coarse[tuple(samples.T)], apart
    )
    return field


def signed_from_samples(
    mesh: TriMesh, points: np.ndarray, known: np.ndarray, apart: np.ndarray
) -> np.ndarray:
    """Return the signed distance of points (n, 3), each ``apart`` from one where it is known.

    If the balls round the two points that hold no surface overlap, the two have one sign. The
    winding number, three times as slow as the distance, is asked for the others only.
    """
    found = distance(mesh, points)
    inside = known < 0
    unsure = found + np.abs(known) < apart * (1 + 1e-6)
    inside[unsure] = is_inside(mesh, points[unsure])
    return np.where(inside, -found, found)


# The methods: each makes a mesh of a case, and a dense fine field where it has one


def isosurface(field: np.ndarray, spacing: float, origin: np.ndarray | float) -> TriMesh:
    """Mesh a dense field, float32, zeros nudged in place; empty if it has one sign only."""
    field[field == 0] = NUDGE
    if not field.min() < 0 < field.max():
        return EMPTY
    vertices, faces, _, _ = marching_cubes(field, 0.0, method="lorensen")
    return TriMesh(vertices.astype(np.float64) * spacing + origin, faces.astype(np.int64))


def upsample(coarse: np.ndarray, factor: int, order: int) -> np.ndarray:
    """Return SciPy's spline interpolation of that order at the fine nodes, (K n + 1)^3 float32."""
    field = coarse.astype(np.float32)
    for _ in range(3):  # takes the first axis and puts its nodes last: three times, all in place
        field = np.tensordot(field, lattice_weights(field.shape[0], factor, order), (0, 1))
    return field


@lru_cache(maxsize=8)
def lattice_weights(n: int, factor: int, order: int) -> np.ndarray:
    """Return the weights of n samples in the K n + 1 nodes of one axis, (K n + 1, n) float32.

    A spline is linear in the samples and a product over the axes, so this is the interpolation of
    a whole grid, without the 3 GB of coordinates of a 513^3 lattice. Beyond the outer samples,
    half a voxel on each side, it continues the last one ("nearest").
    """
    position = [np.arange(factor * n + 1) / factor - 0.5]
    columns = [
        ndimage.map_coordinates(unit, position, order=order, mode="nearest") for unit in np.eye(n)
    ]
    return np.stack(columns, axis=1).astype(np.float32)


def coarse_surface(case: Case) -> tuple[TriMesh, np.ndarray | None]:
    """Mesh the coarse grid as it is."""
    return isosurface(case.coarse.astype(np.float32), case.spacing, case.origin), None


def upsampled_surface(case: Case, order: int) -> tuple[TriMesh, np.ndarray | None]:
    """Mesh the spline interpolation of the coarse grid at the fine nodes."""
    field = upsample(case.coarse, case.factor, order)
    return isosurface(field, case.fine, -0.5), field


def bound_surface(case: Case) -> tuple[TriMesh, np.ndarray | None]:
    """Mesh the true distance at the fine nodes: what no upsampling to them can beat."""
    return isosurface(case.truth.copy(), case.fine, -0.5), None


def our_surface(case: Case, model: str) -> tuple[TriMesh, np.ndarray | None]:
    """Mesh the coarse grid with super-sdf.

    Capped, as one would ask who wants solids: tm-round ends a fifth of a voxel from the frame's
    border at 64^3. Where no surface leaves the grid the cap changes nothing.
    """
    network = load_once(model)
    mesh = reconstruct(case.grid, network, factor=case.factor, cap=True)
    found = TriMesh(mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64))
    return found, our_field(case, network)


def our_field(case: Case, network: Decoder) -> np.ndarray:
    """Return the network's distances at all nodes of the band, dense float32, NaN elsewhere.

    The pipeline decodes only the voxels that can hold the surface; the protocol asks for all.
    """
    rescaled, voxels, factor = rescale(case.grid), case.voxels, case.factor
    table = neighbour_table(voxels, case.grid.shape)
    every = np.arange(len(voxels), dtype=np.int32)
    blocks = network(gather_patches(rescaled, voxels), table, every, block_offsets(factor))
    numbers, count = number_shared_nodes(table, factor)
    values = average_shared(blocks, numbers, count)
    keep_samples(values, numbers, rescaled[tuple(voxels.T)])
    nodes = factor * voxels[:, None] + block_ijk(factor)  # (V, Q, 3)
    field = np.full(case.band.shape, np.nan, np.float32)
    field[tuple(np.moveaxis(nodes, 2, 0))] = values[numbers] * np.float32(case.spacing / 2)
    return field


@lru_cache(maxsize=1)
def load_once(model: str) -> Decoder:
    """Return the network of a name or a file."""
    return load_network(model)


Method = Callable[[Case], tuple[TriMesh, np.ndarray | None]]


def make_method(name: str, model: str) -> Method:
    """Return the function that makes a method's surface."""
    methods: dict[str, Method] = {
        "mc": coarse_surface,
        "trilinear": partial(upsampled_surface, order=1),
        "bspline": partial(upsampled_surface, order=3),
        "ours": partial(our_surface, model=model),
        "bound": bound_surface,
    }
    return methods[name]


# Measuring


def measure_surface(shape: Shape, mesh: TriMesh) -> Row:
    """Return every mesh figure of a result; without faces, a dot at the origin is measured."""
    drawn = metrics.sample_surface(mesh, shape.seed(2))
    edge_points = metrics.edge_points(drawn)
    return {
        **metrics.compare_samples(shape.drawn, drawn),
        **metrics.compare_surfaces(shape.mesh, mesh, shape.drawn, drawn),
        **metrics.compare_edges(shape.mesh.vertices, shape.sharp, shape.sharp_drawn, edge_points),
        "closed": metrics.is_closed(mesh.faces),
        "outward": metrics.volume(mesh) > 0,
        "faces": len(mesh.faces),
    }


def measure_field(case: Case, field: np.ndarray | None) -> Row:
    """Return the squared and absolute error at the nodes of the band, each node once."""
    if field is None:
        return {"field_mse": None, "field_mae": None}
    error = field[case.band].astype(np.float64) - case.truth[case.band]
    return {"field_mse": float(np.mean(error**2)), "field_mae": float(np.abs(error).mean())}


def measure_method(case: Case, name: str, model: str) -> Row:
    """Return the figures of a method; if it raises, those of a dot, with the reason in "error"."""
    try:
        mesh, field = make_method(name, model)(case)
        error = None
    except Exception as problem:  # named in the table; the other shapes still count
        traceback.print_exc(file=sys.stderr)
        mesh, field, error = EMPTY, None, f"{type(problem).__name__}: {problem}"
    return {**measure_surface(case.shape, mesh), **measure_field(case, field), "error": error}


@dataclass(frozen=True)
class Task:
    """What is to be measured of one shape, size by size, and the network's name or file."""

    path: Path
    keys: tuple[Key, ...]
    model: str


def measure_shape(task: Task) -> list[Row]:
    """Return a row for each key of a shape."""
    shape = Shape(task.path)
    rows: list[Row] = []
    case: Case | None = None
    for key in task.keys:
        _, size, method, factor, _ = key
        if method == FLOOR:
            figures = {**measure_surface(shape, shape.mesh), "error": None}
        else:
            if case is None or case.size != size:
                case = Case(shape, size, factor)
            figures = measure_method(case, method, task.model)
        rows.append({**dict(zip(KEY_NAMES, key)), "protocol": PROTOCOL, **figures})
    return rows


# What has been measured already

KEY_NAMES = ("shape", "size", "method", "factor", "digest")


def make_key(shape: str, size: int, method: str, factor: int, digest: str) -> Key:
    """Return what a row is known by. The floor has no size, and only ours depends on the digest."""
    if method == FLOOR:
        size = factor = 0
    return shape, size, method, factor, digest if method == "ours" else ""


def read_rows(path: Path) -> dict[Key, Row]:
    """Return the rows kept so far under this protocol, by key."""
    lines = path.read_text().splitlines() if path.exists() else []
    rows = [row for row in map(json.loads, lines) if row["protocol"] == PROTOCOL]
    return {tuple(row[name] for name in KEY_NAMES): row for row in rows}


def digest_of(model: str) -> str:
    """Return the sha256 of the network file and of the code that runs it."""
    load_once(model)  # says what is wrong with the file, before anything is measured
    code = sorted(Path(super_sdf.__file__).parent.glob("*.py"))
    parts = [path for path in code if path.stem not in ("cli", "io")]
    digest = hashlib.sha256()
    for path in [shipped_models().get(model, Path(model)), *parts]:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def measure_missing(tasks: list[Task], jobs: int) -> Iterator[list[Row]]:
    """Yield the rows of each shape in turn, from as many processes as there are jobs."""
    if jobs == 1:
        yield from map(measure_shape, tasks)
        return
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        yield from pool.imap(measure_shape, tasks)


def complete(
    kept: dict[Key, Row], wanted: dict[Path, list[Key]], store: Path, model: str, jobs: int
) -> None:
    """Measure what is wanted and not kept, and keep it: in the file at once, shape by shape."""
    missing = {  # each key once: the floor is wanted for every size
        path: tuple(key for key in dict.fromkeys(keys) if key not in kept)
        for path, keys in wanted.items()
    }
    tasks = [Task(path, keys, model) for path, keys in missing.items() if keys]
    start = time.perf_counter()
    for done, (task, rows) in enumerate(zip(tasks, measure_missing(tasks, jobs)), 1):
        kept.update(zip(task.keys, rows))
        with store.open("a") as out:  # a row with an error is tried again by the next run
            out.writelines(json.dumps(row) + "\n" for row in rows if row["error"] is None)
        seconds = time.perf_counter() - start
        print(f"{done} of {len(tasks)} {task.path.stem} {seconds:.0f} s", file=sys.stderr)


# Tables


def add_excess(rows: list[Row], floors: dict[str, Row]) -> list[Row]:
    """Return the rows with CD minus the floor's, the CD of two perfect samplings."""
    return [{**row, "excess_cd": row["cd"] - floors[row["shape"]]["cd"]} for row in rows]


def mean_of(rows: list[Row], key: str) -> float | None:
    """Return the plain mean over the shapes that have this figure."""
    figures = [row[key] for row in rows if row.get(key) is not None]
    return float(np.mean(figures)) if figures else None


def format_row(label: str, rows: list[Row]) -> str:
    """Return a table row: the means of these rows, and how many are closed and outward."""
    means = [(mean_of(rows, key), scale, digits) for _, key, scale, digits in COLUMNS]
    cells = ["-" if mean is None else f"{mean * scale:.{digits}f}" for mean, scale, digits in means]
    counts = [f"{sum(row[key] for row in rows)} of {len(rows)}" for key in ("closed", "outward")]
    return f"| {' | '.join([label, *cells, *counts])} |"


def format_table(first: str, labelled: dict[str, list[Row]]) -> str:
    """Return a Markdown table with one row for each label."""
    titles = [first, *(column[0] for column in COLUMNS), "closed", "outward"]
    head = [f"| {' | '.join(titles)} |", "| --- " + "| ---: " * (len(titles) - 1) + "|"]
    return "\n".join(head + [format_row(label, rows) for label, rows in labelled.items()])


def format_failures(by_method: dict[str, list[Row]]) -> list[str]:
    """Return a line for each method that left shapes without a surface, with their names."""
    lines = []
    for method, rows in by_method.items():
        names = [
            row["shape"] + (f" ({row['error']})" if row["error"] else "")
            for row in rows
            if not row["faces"]
        ]
        if names:
            lines.append(f"No surface (a dot stands in), {LABELS[method]}: {', '.join(names)}.")
    return lines


def format_gaps(by_method: dict[str, list[Row]]) -> str:
    """Return the share of the way from B-spline to the bound that ours has gone."""
    shares = []
    for title, key in GAPS:
        ours, base, bound = (mean_of(by_method[name], key) for name in ("ours", "bspline", "bound"))
        shares.append(f"{title} {100 * (ours - base) / (bound - base):.0f} %")
    return f"Share of the gap from B-spline to the bound closed by ours: {', '.join(shares)}."


def format_wins(ours: list[Row], base: list[Row]) -> str:
    """Return on how many shapes ours has the better F1, and those on which it has not."""
    pairs = [(mine["shape"], mine["f1"], other["f1"]) for mine, other in zip(ours, base)]
    lost = [
        f"{name} ({mine:.3f}, B-spline {other:.3f})" for name, mine, other in pairs if mine <= other
    ]
    line = f"Ours beats B-spline in F1 on {len(pairs) - len(lost)} of {len(pairs)}."
    return f"{line} Not on: {', '.join(lost)}." if lost else line


def format_size(size: int, by_method: dict[str, list[Row]]) -> str:
    """Return all that is said of one size."""
    count = len(by_method[FLOOR])
    table = format_table("method", {LABELS[name]: rows for name, rows in by_method.items()})
    lines = [f"## {size}^3, {count} shapes\n", table, "", *format_failures(by_method)]
    if "ours" in by_method and "bspline" in by_method:
        lines.append(format_wins(by_method["ours"], by_method["bspline"]))
        if "bound" in by_method:
            lines.append(format_gaps(by_method))
    return "\n".join(lines) + "\n"


def format_shapes(size: int, by_method: dict[str, list[Row]]) -> str:
    """Return the table of one size with a row for each shape and method."""
    labelled = {
        f"{rows[0]['shape']}, {method}": list(rows)
        for shape_rows in zip(*by_method.values())
        for method, rows in zip(by_method, ([row] for row in shape_rows))
    }
    return f"## {size}^3\n\n{format_table('shape, method', labelled)}\n"


# The command


def parse_arguments() -> argparse.Namespace:
    """Return the command's options."""
    parser = argparse.ArgumentParser(prog="benchmarks.quality", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("--meshes", type=Path, required=True, help="folder of closed reference meshes")
    add("--sizes", type=int, nargs="+", default=[32, 64], help="samples along an axis")
    add("--factor", type=int, default=4, help="K, how many times finer; even")
    add("--model", default=DEFAULT_MODEL, help="a shipped network or an .onnx file")
    add("--out", type=Path, required=True, help="folder of results.jsonl and per_shape.md")
    add("--limit", type=int, help="take the first so many shapes only")
    add("--methods", nargs="+", choices=LABELS, default=list(LABELS), help="floor always runs")
    add("--jobs", type=int, default=1, help="processes")
    return parser.parse_args()


def find_meshes(folder: Path, limit: int | None) -> list[Path]:
    """Return the mesh files of a folder by name, the first ``limit`` of them."""
    paths = sorted(path for path in folder.iterdir() if path.suffix in (".ply", ".obj", ".stl"))
    if not paths:
        raise SystemExit(f"{folder} holds no .ply, .obj or .stl file")
    return paths[:limit]


def main() -> None:
    """Measure what is missing, print the tables, write the table by shape."""
    options = parse_arguments()
    paths = find_meshes(options.meshes, options.limit)
    methods = [name for name in LABELS if name in (*options.methods, FLOOR)]
    digest = digest_of(options.model) if "ours" in methods else ""
    key_of = partial(make_key, factor=options.factor, digest=digest)
    wanted = {
        path: [key_of(path.stem, size, name) for size in options.sizes for name in methods]
        for path in paths
    }
    options.out.mkdir(parents=True, exist_ok=True)
    store = options.out / "results.jsonl"
    kept = read_rows(store)
    complete(kept, wanted, store, options.model, options.jobs)
    floors = {path.stem: kept[key_of(path.stem, 0, FLOOR)] for path in paths}
    by_size = {
        size: {
            name: add_excess([kept[key_of(path.stem, size, name)] for path in paths], floors)
            for name in methods
        }
        for size in options.sizes
    }
    print("\n".join(format_size(size, rows) for size, rows in by_size.items()))
    per_shape = "\n".join(format_shapes(size, rows) for size, rows in by_size.items())
    (options.out / "per_shape.md").write_text(per_shape)


if __name__ == "__main__":
    main()
