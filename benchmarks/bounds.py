"""Whether a conversion stays within ``--max-memory``: peak memory of the process over the limit.

    python -m benchmarks.bounds --sizes 128 --factors 2 4
    python -m benchmarks.bounds --fields gyroid "wall across x" --precisions int8
    python -m benchmarks.bounds --fields mask truncated spline scaled --sizes 256 --factors 4
    python -m benchmarks.bounds --fields --dense noise gyroid --follow
    python -m benchmarks.bounds --quick
    python -m benchmarks.bounds --mesh fandisk.ply

Every conversion runs in its own process, start, files and libraries included; the system reports
its peak when it has ended. Two limits are tried: a share of what the plan needs without a limit,
and the smallest that the plan accepts. Grids of which most samples are beside the surface, or cut
off, have limits of their own (``DENSE``). These may be too small: then the refusal must hold the
limit, too, and with ``--follow`` what it says to allow is tried. The exit code is 1 if a peak
exceeds 1.05 times its limit.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from super_sdf.evaluation.timing import LAUNCHER, describe_machine, run_command
from super_sdf.steps.mesher_names import DEFAULT_MESHER, MESHERS

FIELDS = ("ball", "gyroid", "wall across x", "wall across z")
KINDS = ("mask", "truncated", "spline", "scaled")  # of a ball, see ``of_kind``
# Shape, type, spacing and limit in bytes of grids with a surface nearly everywhere, or cut off.
DENSE = {
    "noise": ((197, 197, 197), "float32", 4, 400_000_000),
    "checkers": ((300, 300, 300), "float32", 4, 600_000_000),
    "steps": ((476, 476, 476), "int8", 100, 600_000_000),
    "gyroid": ((64, 768, 768), "float32", 1, 500_000_000),
    "sines": ((64, 768, 768), "float32", 1, 500_000_000),
    "cut off at 3": ((256, 256, 256), "float32", 1, 400_000_000),
}
TURN = 2 * np.pi / 24  # radians per sample of the last gyroids
ADVICE = re.compile(r"needs? (?:at least )?([\d.,]+) ([MG])B of memory")
SUFFIXES = (".ply", ".stl", ".obj")
SHARE = 0.6
ALLOWED = 1.05
LARGEST = 4_000_000_000  # bytes; grids whose smallest plan is larger are skipped

# Prints the planned bytes of the whole grid and of its thinnest slabs, in a process that has loaded
# what the command would load.
PLAN = """
import sys
from super_sdf import load_network
from super_sdf.files.grids import read_grid
from super_sdf.network.network import network_for
from super_sdf.machine.resources import allot
from super_sdf.slabs.preparing import find_surface
from super_sdf.slabs.cutting import peak_bytes, ways_to_cut, whole
from super_sdf.steps.meshers import find_mesher

path, factor, precision, name = sys.argv[1:]
network = load_network(precision=precision, device="cpu")
grid = read_grid(path, spacing=1.0)
network = network_for(network, grid.field.kind)
resources = allot(network.threads)
mesher = find_mesher(name)
plan = int(factor), network.receptive_field, resources, network.memory_bytes, mesher
band = find_surface(grid, 0.0, *plan)
beside = mesher.planes_beside(int(factor))
*_, thinnest = ways_to_cut(band, network.receptive_field, beside)
for slabs in ([whole(band)], thinnest):
    print(peak_bytes(band, slabs, int(factor), network.memory_bytes, resources.threads, mesher))
"""


@dataclass(frozen=True)
class Case:
    """A conversion: the grid and the options."""

    field: str
    size: int
    factor: int
    precision: str
    suffix: str
    source: str
    mesher: str = DEFAULT_MESHER


@dataclass(frozen=True)
class Run:
    """The result of a conversion: seconds and bytes, or why it was refused."""

    seconds: float
    peak: int
    report: dict[str, int]
    refusal: str = ""


def values_of(field: str, n: int) -> Iterator[NDArray[np.float32]]:
    """Yield the planes of a field of n samples along each axis, spacing 1."""
    at = np.arange(n) - n / 2 + 0.63
    y, z = at[:, None], at[None, :]
    for x in at:
        if field == "ball" or field in KINDS:
            plane = of_kind(field, np.sqrt(x**2 + y**2 + z**2) - 0.4 * n, n)
        elif field == "gyroid":
            plane = gyroid(x, y, z, 8 * np.pi / n)
        elif field == "wall across x":
            plane = np.full((n, n), abs(x) - 1.7)
        else:
            plane = np.broadcast_to(np.abs(z) - 1.7, (n, n))
        yield plane.astype(np.float32)


def of_kind(kind: str, distance: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Return distances as values of another kind, or as they are."""
    if kind == "mask":
        return np.where(distance < 0, 1.0, 0.0)
    if kind == "scaled":
        return distance * (1 + distance / (3 * n))
    limit = {"truncated": 1.0, "spline": 0.5}.get(kind, np.inf)
    return np.clip(distance, -limit, limit)


def gyroid(
    x: float, y: NDArray[np.float64], z: NDArray[np.float64], turn: float
) -> NDArray[np.float64]:
    """Return roughly the distance to a gyroid, truncated at 3; ``turn``: radians per sample."""
    sines, cosines = zip(*((np.sin(turn * axis), np.cos(turn * axis)) for axis in (x, y, z)))
    value = sum(sines[a] * cosines[(a + 1) % 3] for a in range(3))
    slopes = [cosines[a] * cosines[(a + 1) % 3] - sines[a - 1] * sines[a] for a in range(3)]
    slope = np.sqrt(sum(slope**2 for slope in slopes))
    distance: NDArray[np.float64] = np.clip(value / (turn * np.maximum(slope, 0.5)), -3, 3)
    return distance


def dense_plane(name: str, i: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return plane ``i`` of a grid of ``DENSE``."""
    rng = np.random.default_rng(i)
    y, z = np.indices(shape[1:]).astype(np.float64)
    if name == "noise":
        return rng.normal(size=shape[1:])
    if name == "checkers":
        return ((i + y + z) % 2 * 2 - 1) * (1 + rng.random(shape[1:]))
    if name == "steps":
        return rng.integers(-100, 101, shape[1:]).astype(np.float64)
    if name == "gyroid":
        return gyroid(i, y, z, TURN)
    if name == "sines":
        x, y, z = TURN * i, TURN * y, TURN * z
        return (np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)) / TURN
    n = shape[0] / 2
    return np.clip(np.sqrt((i - n) ** 2 + (y - n) ** 2 + (z - n) ** 2) - 0.8 * n, -3, 3)


def try_dense(name: str, folder: Path, *, follow: bool) -> list[str]:
    """Print a row for a grid of ``DENSE``, and for what its refusal advises; return bad ones."""
    shape, dtype, spacing, bound = DENSE[name]
    array = np.lib.format.open_memmap(folder / "grid.npy", "w+", np.dtype(dtype), shape)
    for i, plane in enumerate(array):
        plane[:] = dense_plane(name, i, shape)
    array.flush()
    case = Case(name, shape[0], 4, "int8", ".ply", ".npy")
    run = convert(case, folder, bound, spacing)
    print(line := row(case, "given", bound, run), flush=True)
    over = [line] if run.peak > ALLOWED * bound else []
    if not run.refusal or not follow:
        return over
    said = ADVICE.search(run.refusal)
    if said is None:
        return [*over, f"{line} {run.refusal}"]
    bound = int(float(said[1].replace(",", "")) * {"M": 1e6, "G": 1e9}[said[2]])
    run = convert(case, folder, bound, spacing)
    print(line := row(case, "advised", bound, run), flush=True)
    return [*over, line] if run.refusal or run.peak > ALLOWED * bound else over


def write_grids(field: str, n: int, folder: Path) -> None:
    """Write a field as ``.npy`` and ``.npz``."""
    array = np.lib.format.open_memmap(folder / "grid.npy", "w+", np.float32, (n, n, n))
    for plane, values in zip(array, values_of(field, n)):
        plane[:] = values
    array.flush()
    np.savez(folder / "grid.npz", values=array)


def sample_mesh(mesh: Path, n: int, folder: Path) -> None:
    """Write the grids of a mesh, box diagonal 1 in the unit cube, in index units."""
    words = ["sample", str(mesh), str(folder / "cube.npz"), "-n", str(n), "--frame", "unit"]
    run_command([*words, "--force", "--quiet"])
    values = (np.load(folder / "cube.npz")["values"] * n).astype(np.float32)
    np.save(folder / "grid.npy", values)
    np.savez(folder / "grid.npz", values=values)


def run_python(words: list[str]) -> tuple[str, str]:
    """Run Python; return its stdout and stderr."""
    command = [sys.executable, "-c", LAUNCHER, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout.rstrip("\n"), done.stderr


def plan(case: Case, folder: Path) -> tuple[int, int]:
    """Return the planned bytes of the whole grid, and of its thinnest slabs."""
    path = folder / f"grid{case.source}"
    words = ["-c", PLAN, str(path), str(case.factor), case.precision, case.mesher]
    printed, errors = run_python(words)
    whole, thinnest, *_ = printed.splitlines()
    if not whole:
        raise SystemExit(errors)
    return int(whole), int(thinnest)


def convert(case: Case, folder: Path, bound: int, spacing: int = 1) -> Run:
    """Convert with a memory limit in bytes."""
    target = folder / f"mesh{case.suffix}"
    words = ["-m", "super_sdf", "upsample", str(folder / f"grid{case.source}"), str(target)]
    words += ["--spacing", str(spacing), "--force", "--json", "--quiet", "--device", "cpu"]
    words += ["--factor", str(case.factor), "--precision", case.precision]
    words += ["--mesher", case.mesher]
    printed, errors = run_python([*words, "--max-memory", str(bound)])
    printed, _, last = printed.rpartition("\n")
    status, seconds, peak = last.split()
    peak_bytes = int(peak)
    if int(status):
        return Run(float(seconds), peak_bytes, {}, errors.strip().rpartition("\n")[2])
    return Run(float(seconds), peak_bytes, json.loads(printed))


def row(case: Case, name: str, bound: int, run: Run) -> str:
    """Return a row of the table."""
    what = [case.field, f"{case.size}^3", case.factor, case.precision]
    cells = [*what, f"{case.source} to {case.suffix}", name, f"{bound / 1e6:,.0f}"]
    cells += ["refused", ""]
    if not run.refusal:
        cells[-2:] = run.report["slabs"], f"{run.report['planned_bytes'] / 1e6:,.0f}"
    cells += [f"{run.peak / 1e6:,.0f}", f"{run.peak / bound:.2f}", f"{run.seconds:.1f}"]
    return f"| {' | '.join(map(str, cells))} |"


def bounds_of(whole: int, thinnest: int, share: float, names: list[str]) -> dict[str, int]:
    """Return the limits to try, in bytes, by name; plans vary slightly from run to run."""
    least = int(1.02 * thinnest) + 1_000_000
    bounds = {"share": max(int(share * whole), least), "least": least}
    return {name: bounds[name] for name in names}


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--fields", nargs="*", choices=FIELDS + KINDS, default=FIELDS)
    parser.add_argument("--dense", nargs="*", choices=tuple(DENSE), default=tuple(DENSE))
    parser.add_argument("--follow", action="store_true", help="allow what a refusal advises, too")
    parser.add_argument("--mesh", type=Path, nargs="*", default=[], help="files to sample")
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 256])
    parser.add_argument("--factors", type=int, nargs="+", default=[2, 4, 16])
    parser.add_argument("--precisions", nargs="+", default=["float32", "int8"])
    parser.add_argument("--mesher", choices=MESHERS, default=DEFAULT_MESHER)
    parser.add_argument("--suffixes", nargs="+", default=SUFFIXES)
    parser.add_argument("--sources", nargs="+", choices=[".npy", ".npz"], default=[".npy", ".npz"])
    parser.add_argument("--bounds", nargs="+", choices=["share", "least"], default=["share"])
    parser.add_argument("--share", type=float, default=SHARE)
    parser.add_argument("--quick", action="store_true", help="a few small grids, for a check")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.fields, arguments.sizes = ["ball", "wall across x"], [24]
        arguments.factors, arguments.suffixes = [2, 16], [".ply"]
        arguments.sources, arguments.bounds, arguments.dense = [".npy"], ["least"], []
    return arguments


def cases(arguments: argparse.Namespace, field: str, size: int) -> Iterator[Case]:
    """Yield the conversions to try on a grid."""
    for choice in product(
        arguments.factors, arguments.precisions, arguments.suffixes, arguments.sources
    ):
        yield Case(field, size, *choice, arguments.mesher)


def main() -> None:
    """Print the machine and a Markdown table."""
    arguments, over = parse(), []
    print(f"{describe_machine()}; MB\n")
    print(
        "| grid | size | factor | precision | files | bound | MB | slabs | planned | peak | "
        "of the bound | s |\n| --- | ---: | ---: |" + " --- |" * 3 + " ---: |" * 6
    )
    fields = [(name, None) for name in arguments.fields] + [
        (mesh.stem, mesh) for mesh in arguments.mesh
    ]
    for (field, mesh), size in product(fields, arguments.sizes):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            sample_mesh(mesh, size, folder) if mesh else write_grids(field, size, folder)
            for case in cases(arguments, field, size):
                over += try_bounds(case, folder, arguments)
    for field in arguments.dense:
        with tempfile.TemporaryDirectory() as name:
            over += try_dense(field, Path(name), follow=arguments.follow)
    if over:
        raise SystemExit("over the bound:\n" + "\n".join(over))


def try_bounds(case: Case, folder: Path, arguments: argparse.Namespace) -> list[str]:
    """Print a row per limit; return the ones that were exceeded."""
    whole, thinnest = plan(case, folder)
    if thinnest > LARGEST:
        return []
    over = []
    for name, bound in bounds_of(whole, thinnest, arguments.share, arguments.bounds).items():
        run = convert(case, folder, bound)
        line = row(case, name, bound, run)
        print(line, flush=True)
        if run.peak > ALLOWED * bound or (run.refusal and "memory" not in run.refusal):
            over.append(f"{line} {run.refusal}")
    return over


if __name__ == "__main__":
    main()
