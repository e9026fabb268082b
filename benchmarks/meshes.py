"""Whether a change of the code changes a mesh: the SHA-256 of the mesh file of every grid.

    python -m benchmarks.meshes MESHES --sizes 32 64 --out before.json --keep before/
    python -m benchmarks.meshes MESHES --sizes 32 64 --against before.json
    python -m benchmarks.meshes MESHES --sizes 32 64 --near before/
    python -m benchmarks.meshes MESHES --sizes 32 64 --against benchmarks/meshes.json
    python -m benchmarks.meshes fandisk.ply --sizes 512 --slabs 1 7 --against benchmarks/meshes.json

Samples every shape at every size, converts it with the network ``base`` to ``.ply``, and prints
which files differ. ``--near`` compares with mesh files that ``--keep`` wrote: the triangles must be
the same, and positions at most 1e-6 coarse spacings and one unit in the last place apart.
``meshes.json`` has the digests of the 63 validation shapes, of fandisk at 512^3 in 1 and 7 slabs,
and of the network; another network gives other meshes, and is refused. Sums of floats may differ
between processors, so on another machine write a file with the earlier commit first.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import trimesh

from super_sdf.convert import ConvertOptions, convert
from super_sdf.evaluation.cases import Shape
from super_sdf.evaluation.scope import find_meshes
from super_sdf.network.names import DEFAULT_QUALITY
from super_sdf.network.network import Network, find_model, load_network
from super_sdf.slabs import preparing
from super_sdf.slabs.cutting import Slab, cut
from super_sdf.steps.survey import Band
from super_sdf.truth.sampling import sample_solid, unit_layout

ALLOWED = 1e-6


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@contextmanager
def cut_into(slabs: int) -> Iterator[None]:
    """Cut every grid into about as many slabs, whatever the memory."""

    def plan(band: Band, factor: int, reach: int, *others: Any) -> list[Slab]:
        return cut(band, slabs, reach, others[-1].planes_beside(factor))

    with mock.patch.object(preparing, "plan_slabs", plan) if slabs > 1 else nullcontext():
        yield


def write_meshes(
    path: Path, sizes: list[int], slabs: list[int], network: Network
) -> Iterator[tuple[str, Path]]:
    """Yield a name and the mesh file of a shape, for each size and number of slabs."""
    shape, options = Shape.read(path), ConvertOptions(inside="negative")
    for size in sizes:
        grid = sample_solid(shape.solid, unit_layout(size))
        with tempfile.TemporaryDirectory() as name:
            source, target = Path(name) / "grid.npz", Path(name) / "mesh.ply"
            np.savez(source, values=grid.values, spacing=grid.spacing, origin=grid.origin)
            for count in slabs:
                with cut_into(count):
                    convert(source, target, network, options, force=True)
                yield f"{path.stem} {size}" + f" in {count} slabs" * (count > 1), target


def distance(path: Path, other: Path, size: int) -> float:
    """Return how far vertices of two meshes lie apart at most, in coarse spacings.

    Differences of one unit in the last place do not count. Infinity if triangles differ.
    """
    (mesh, kept) = (trimesh.load(name, process=False) for name in (path, other))
    if not np.array_equal(mesh.faces, kept.faces):
        return float("inf")
    a, b = (np.asarray(m.vertices, np.float32) for m in (mesh, kept))
    apart = np.abs(a.astype(np.float64) - b)
    return float(np.where(apart <= np.spacing(np.abs(b)), 0, apart).max() * size)


def parse() -> argparse.Namespace:
    """Return the arguments."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("meshes", nargs="+", type=Path, help="closed meshes, or folders of them")
    parser.add_argument("--sizes", nargs="+", type=int, default=[32, 64])
    parser.add_argument("--slabs", nargs="+", type=int, default=[1])
    parser.add_argument("--out", type=Path, help="write the digests to this JSON file")
    parser.add_argument("--keep", type=Path, help="keep the mesh files in this folder")
    parser.add_argument("--against", type=Path, help="compare them with this JSON file")
    parser.add_argument("--near", type=Path, help="compare them with the mesh files in this folder")
    return parser.parse_args()


def main() -> None:
    """Write the digests, or compare them with those in a file; exit code 1 if any differs."""
    options, network = parse(), digest(find_model(DEFAULT_QUALITY)[0])
    before = json.loads(options.against.read_text()) if options.against else None
    if before and before["network"] != network:
        raise SystemExit(f"{options.against} is of another network: {before['network'][:12]}...")
    loaded = load_network(device="cpu")
    digests, others = {}, []
    for path in find_meshes(options.meshes):
        for name, mesh in write_meshes(path, options.sizes, options.slabs, loaded):
            digests[name] = digest(mesh)
            kept = f"{name.replace(' ', '-')}.ply"
            if options.keep:
                shutil.copy(mesh, options.keep / kept)
            if options.near:
                apart = distance(mesh, options.near / kept, int(name.split()[1]))
                others += [f"{name}: {apart:.1e} spacings"] * (apart > ALLOWED)
            if before and before["meshes"].get(name) != digests[name]:
                others.append(name)
    if options.out:
        text = json.dumps({"network": network, "meshes": digests}, indent=1)
        options.out.write_text(text + "\n")
    what = "the same bytes" if before else "near" if options.near else "written"
    print(f"{len(digests) - len(others)} of {len(digests)} meshes are {what}")
    raise SystemExit("\n".join(["Others:", *others]) if others else 0)


if __name__ == "__main__":
    main()
