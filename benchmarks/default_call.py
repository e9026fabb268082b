"""The default call on exact, noisy, thin and unsigned grids: closed meshes, and the right refusals.

    python -m benchmarks.default_call FOLDER
    python -m benchmarks.default_call FOLDER --sizes 16 32 64 --count 63

FOLDER holds meshes of solids. Each is sampled exactly, and ``super-sdf upsample GRID.npy OUT.ply
--spacing H`` is run on these grids:

    exact      the distances, and what the values are taken for
    transposed the same with the axes in another order and no --spacing: is the estimate off?
    noisy      the distances with uniform noise of a tenth of a voxel (at 32^3 only)
    squeezed   the first 30 solids, squeezed until no sample lies inside
    unsigned   the absolute distances of the first 10 solids that are thick: to be refused
    far        the distances of the first 10 solids, all of them too large for a surface: refused

A mesh is closed if each edge has two triangles. Needs the extra eval.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from numpy.typing import NDArray

from super_sdf import make_grid
from super_sdf.cli.main import cli
from super_sdf.errors import GridError
from super_sdf.evaluation.metrics import normalise
from super_sdf.mesh import Mesh
from super_sdf.truth.mesh_files import read_mesh
from super_sdf.truth.sampling import sample_grid, unit_layout
from super_sdf.truth.solid import Solid

Values = NDArray[np.floating]

NOISY_SIZE, NOISE = 32, 0.1  # samples along an axis; voxels
SQUEEZED, REFUSED = 30, 10  # grids
THICK = 1.5  # voxels that a sample lies deep in a solid, from which on it is thick
SHIFT = 1.0  # voxels that are added to distances, so that no wall is near enough to a sample
SAME_SPACING = 1e-3
HEIGHT = 0.9  # voxels, of squeezed solids


def sample(mesh: Mesh, size: int) -> tuple[Values, float]:
    """Return exact distances of a mesh in a cube of side 1, and their spacing."""
    layout = unit_layout(size)
    return sample_grid(Solid(mesh), layout), layout[1]


def squeezed(mesh: Mesh, size: int) -> tuple[Values, float]:
    """Return distances of a mesh that is squeezed along z, between two planes of samples."""
    height = float(np.ptp(mesh.vertices[:, 2])) * size
    scale = min(HEIGHT / height, 1.0)
    return sample(mesh.transformed(np.diag([1, 1, scale]), np.zeros(3)), size)


class Call:
    """The command, run in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.grid, self.mesh = folder / "grid.npy", folder / "mesh.ply"

    def __call__(self, values: Values, *options: str) -> tuple[str, str]:
        """Return "closed", "open" or "refused", and what the values are, or the message."""
        np.save(self.grid, values)
        self.mesh.unlink(missing_ok=True)
        arguments = ["upsample", str(self.grid), str(self.mesh), "--json", *options]
        result = CliRunner().invoke(cli, arguments)
        if result.exit_code:
            return "refused", result.stderr.strip().splitlines()[-1]
        closed = read_mesh(self.mesh).is_closed()
        return "closed" if closed else "open", json.loads(result.stdout)["field"]["kind"]


Rows = Iterator[tuple[str, str, tuple[str, str]]]


def with_surface(call: Call, meshes: dict[str, Mesh], sizes: list[int]) -> Rows:
    """Yield the kind of grid, the shape and the outcome of grids that have a surface."""
    random = np.random.default_rng(0)
    for size in sizes:
        for name, mesh in meshes.items():
            values, h = sample(mesh, size)
            yield f"exact, {size}^3", name, call(values, "--spacing", repr(h))
            yield f"transposed, {size}^3", name, estimate(values.T, h)
            if size == NOISY_SIZE:
                noise = random.uniform(-NOISE, NOISE, values.shape) * h
                yield f"noisy, {size}^3", name, call(values + noise, "--spacing", repr(h))
        for name, mesh in list(meshes.items())[:SQUEEZED]:
            values, h = squeezed(mesh, size)
            if values.min() > 0:
                yield f"squeezed, {size}^3", name, call(values, "--spacing", repr(h))


def estimate(values: Values, h: float) -> tuple[str, str]:
    """Return whether the estimated spacing is within a thousandth of the true one."""
    try:
        found = make_grid(np.ascontiguousarray(values)).spacing
    except GridError as error:
        return "refused", str(error)
    off = float(np.abs(np.array(found) / h - 1).max())
    return ("right", "") if off < SAME_SPACING else ("off", f"by {off:.1%}")


def without_surface(call: Call, meshes: dict[str, Mesh], sizes: list[int]) -> Rows:
    """Yield the kind of grid, the shape and the outcome of grids that have no surface."""
    for size in sizes:
        grids = [(name, *sample(mesh, size)) for name, mesh in meshes.items()]
        thick = [one for one in grids if one[1].min() < -THICK * one[2]][:REFUSED]
        for name, values, h in thick:
            yield f"unsigned, {size}^3", name, call(np.abs(values), "--spacing", repr(h))
        for name, values, h in grids[:REFUSED]:
            yield (
                f"far, {size}^3",
                name,
                call(values - values.min() + SHIFT * h, "--spacing", repr(h)),
            )


def main() -> None:
    """Run the command on all grids; print what is not as it should be, and a table of counts."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="folder of meshes")
    parser.add_argument("--sizes", type=int, nargs="+", default=[16, 32, 64])
    parser.add_argument("--count", type=int, help="take the first ones only")
    options = parser.parse_args()
    files = sorted(options.folder.glob("*.ply"))[: options.count]
    meshes = {path.stem: normalise(read_mesh(path)) for path in files}
    found: dict[str, Counter[tuple[str, str]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        call = Call(Path(folder))
        for rows in (with_surface, without_surface):
            for grid, name, (outcome, taken) in rows(call, meshes, options.sizes):
                print(f"{grid:20} {name:24} {outcome:8} {taken}", flush=True)
                short = taken if outcome != "refused" else ""
                found.setdefault(grid, Counter())[outcome, short] += 1
    print("\n| grids | outcome |\n| --- | --- |")
    for grid, counts in found.items():
        parts = ", ".join(f"{n} {a} {b}".strip() for (a, b), n in counts.most_common())
        print(f"| {grid} | {parts} |")


if __name__ == "__main__":
    main()
