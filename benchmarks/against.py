"""Compare super-sdf with dense upsampling and marching cubes, in the same run.

    python -m benchmarks.against MESH.ply --sizes 64 128 [--rfta 32] [-- --max-memory 145M]

Whole processes, one after the other: read an .npy file, refine it four times, write a PLY file.
Baselines: SciPy's ``zoom`` of the whole grid, cubic or trilinear, to the same fine nodes with
scikit-image's marching cubes, and Reach for the Arcs (extra ``peers``) at the sizes of ``--rfta``,
since it takes minutes. Options after ``--`` are passed to ``super-sdf`` for an additional row.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.options import parse
from benchmarks.stages import sample
from super_sdf.errors import SuperSdfError
from super_sdf.evaluation.timing import describe_machine, run_python

ORDERS = {"SciPy zoom, cubic": 3, "SciPy zoom, trilinear": 1}
RFTA = "Reach for the Arcs"


def convert_densely(source: str, target: str, factor: int, order: int) -> None:
    """Refine a grid with SciPy and mesh it with scikit-image, as a short script would."""
    from scipy.ndimage import zoom
    from skimage.measure import marching_cubes

    from super_sdf import Mesh, write_mesh

    values = np.load(source)
    nodes = [factor * n + 1 for n in values.shape]
    scale = [m / n for m, n in zip(nodes, values.shape)]
    fine = zoom(values, scale, order=order, mode="nearest", grid_mode=True)
    vertices, faces, _, _ = marching_cubes(fine, 0.0)
    write_mesh(Mesh(vertices, faces.astype(np.int32)), target, force=True)


def convert_by_rfta(source: str, target: str) -> None:
    """Mesh a grid with Reach for the Arcs and its defaults."""
    from gpytoolbox import reach_for_the_arcs

    from super_sdf import Mesh, write_mesh

    values = np.load(source)
    points = np.argwhere(np.ones(values.shape)).astype(np.float64) / len(values)
    vertices, faces = reach_for_the_arcs(points, values.ravel().astype(np.float64))
    write_mesh(Mesh(np.asarray(vertices), np.asarray(faces, np.int32)), target, force=True)


def convert_by_peer(source: str, target: str, factor: str, order: str) -> None:
    """Convert a grid with a baseline method, in a worker process."""
    if order == "rfta":
        convert_by_rfta(source, target)
    else:
        convert_densely(source, target, int(factor), int(order))


def commands(grid: Path, factor: int, options: list[str]) -> dict[str, list[str]]:
    """Return the arguments of Python for each method; ours also with ``options``."""
    target = str(grid.with_suffix(".ply"))
    words = ["upsample", str(grid), target, "--force", "--quiet", "--inside", "negative"]
    words += ["--spacing", str(1 / int(grid.stem)), "--origin", "0", "--factor", str(factor)]
    ours = ["-m", "super_sdf", *words]
    dense = ["-m", "benchmarks.against", "--worker", str(grid), target, str(factor)]
    variants = [[], ["--precision", "int8"], ["--quality", "fast"], options]
    return {
        **{" ".join(["super-sdf", *more]): [*ours, *more] for more in variants},
        **{name: [*dense, str(order)] for name, order in ORDERS.items()},
    }


def median_of(words: list[str], runs: int) -> tuple[float, float] | None:
    """Return the median of the seconds and the largest peak in MB; None if the command fails."""
    try:
        done = [run_python(words)[:2] for _ in range(runs)]
    except SuperSdfError:
        return None
    seconds, peaks = zip(*done)
    return statistics.median(seconds), max(peaks)


def print_rows(size: int, found: dict[str, tuple[float, float] | None]) -> None:
    """Print the rows of a size: seconds and memory, also relative to ours."""
    ours = found["super-sdf"]
    for name, figures in found.items():
        if figures is None or ours is None:
            print(f"| {size}^3 | {name} | failed | | | |", flush=True)
            continue
        seconds, peak = figures
        over = f"{seconds / ours[0]:.1f} | {peak / ours[1]:.1f}"
        print(f"| {size}^3 | {name} | {seconds:.2f} | {peak:,.0f} | {over} |", flush=True)


def main() -> None:
    """Print the machine and a Markdown table; with ``--worker``, run one method."""
    if sys.argv[1:2] == ["--worker"]:
        convert_by_peer(*sys.argv[2:])
        return
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64, 128])
    parser.add_argument("--rfta", type=int, nargs="*", default=[], help="sizes for that method")
    parser.add_argument("--factor", type=int, default=4)
    parser.add_argument("--runs", type=int, default=3)
    arguments, options = parse(parser)
    print(f"{describe_machine()}; {arguments.mesh.stem}, factor {arguments.factor}\n")
    print("| grid | method | s | peak MB | time over ours | memory over ours |")
    print("| --- | --- | ---: | ---: | ---: | ---: |")
    with tempfile.TemporaryDirectory() as name:
        for size in sorted({*arguments.sizes, *arguments.rfta}):
            grid = sample(arguments.mesh, size, Path(name))
            methods = commands(grid, arguments.factor, options)
            found = {method: median_of(words, arguments.runs) for method, words in methods.items()}
            if size in arguments.rfta:
                found[RFTA] = median_of([*methods["SciPy zoom, cubic"][:-1], "rfta"], 1)
            print_rows(size, found)


if __name__ == "__main__":
    main()
