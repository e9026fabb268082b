"""Whether a change of the code changes a mesh: the SHA-256 of the mesh file of every grid.

    python -m benchmarks.meshes MESHES --sizes 32 64 --out before.json
    python -m benchmarks.meshes MESHES --sizes 32 64 --against before.json
    python -m benchmarks.meshes MESHES --sizes 32 64 --against benchmarks/meshes.json

Samples every shape at every size, converts it with the network ``base`` to ``.ply``, and prints
which files differ. ``meshes.json`` has the digests of the 63 validation shapes and of the network;
another network gives other meshes, and is refused. Sums of floats may differ between processors, so
on another machine write a file with the earlier commit first.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

from super_sdf.convert import ConvertOptions, convert
from super_sdf.evaluation.cases import Setting, Shape
from super_sdf.evaluation.scope import find_meshes
from super_sdf.evaluation.timing import grid_file
from super_sdf.network.network import DEFAULT_QUALITY, Network, load_network, shipped_models


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def mesh_digests(path: Path, sizes: list[int], network: Network) -> Iterator[tuple[str, str]]:
    """Yield ``name size`` and the digest of the mesh file for a shape at each size."""
    shape, options = Shape.read(path), ConvertOptions(inside="negative")
    for size in sizes:
        with grid_file(shape, Setting(size, options.factor)) as grid:
            target = grid.with_suffix(".ply")
            convert(grid, target, network, options)
            yield f"{path.stem} {size}", digest(target)


def main() -> None:
    """Write the digests, or compare them with those in a file; exit code 1 if any differs."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("meshes", nargs="+", type=Path, help="closed meshes, or folders of them")
    parser.add_argument("--sizes", nargs="+", type=int, default=[32, 64])
    parser.add_argument("--out", type=Path, help="write the digests to this JSON file")
    parser.add_argument("--against", type=Path, help="compare them with this JSON file")
    options = parser.parse_args()
    network = digest(shipped_models()[DEFAULT_QUALITY])
    before = json.loads(options.against.read_text()) if options.against else None
    if before and before["network"] != network:
        parser.error(f"{options.against} is of another network: {before['network'][:12]}...")
    loaded = load_network(device="cpu")
    digests = {}
    for path in find_meshes(options.meshes):
        digests |= mesh_digests(path, options.sizes, loaded)
    if options.out:
        text = json.dumps({"network": network, "meshes": digests}, indent=1)
        options.out.write_text(text + "\n")
    if before:
        known = before["meshes"]
        others = [name for name, value in digests.items() if known.get(name) != value]
        print(f"{len(digests) - len(others)} of {len(digests)} meshes are the same bytes")
        raise SystemExit("\n".join(["Others:", *others]) if others else 0)


if __name__ == "__main__":
    main()
