"""Whether a change of the code changes a mesh: the SHA-256 of the mesh file of every grid.

    python -m lab meshes MESHES --sizes 32 64 --out before.json --keep before/
    python -m lab meshes MESHES --sizes 32 64 --against before.json
    python -m lab meshes MESHES --sizes 32 64 --against lab/meshes.json
    python -m lab meshes fandisk.ply --sizes 512 --slabs 1 7 --against lab/meshes.json

Samples every shape at every size, converts it with the network ``base`` to ``.ply``, and prints
which files differ; ``--keep`` keeps them. ``meshes.json`` has the digests of the 63 validation
shapes, of fandisk at 512^3 in 1 and 7 slabs, and of the network; another network gives other
meshes, and is refused. Sums of floats may differ between processors, so on another machine write a
file with the commit to compare with first.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

from super_sdf.convert import convert
from super_sdf.options import Options
from super_sdf.network.network import Network, find_model, load_network
from super_sdf.options import DEFAULT_QUALITY
from super_sdf.slabs import preparing
from super_sdf.slabs.cutting import Slab, cut
from super_sdf.surface.extract import reach_in_voxels
from super_sdf.refine.survey import Band

from . import parser_of
from .processes import write_grid
from .shapes import Shape, find_meshes


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, however large."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 24):
            found.update(block)
    return found.hexdigest()


@contextmanager
def cut_into(slabs: int) -> Iterator[None]:
    """Cut every grid into about as many slabs, whatever the memory."""

    def plan(band: Band, factor: int, reach: int, *others: Any) -> list[Slab]:
        return cut(band, slabs, reach, reach_in_voxels(others[-1], factor))

    with mock.patch.object(preparing, "plan_slabs", plan) if slabs > 1 else nullcontext():
        yield


def write_meshes(
    path: Path, sizes: list[int], slabs: list[int], network: Network
) -> Iterator[tuple[str, Path]]:
    """Yield a name and the mesh file of a shape, for each size and number of slabs."""
    shape, options = Shape.read(path), Options(inside="negative")
    for size in sizes:
        with tempfile.TemporaryDirectory() as name:
            source, target = write_grid(shape, size, Path(name)), Path(name) / "mesh.ply"
            for count in slabs:
                with cut_into(count):
                    convert(source, target, network, options, force=True)
                yield f"{path.stem} {size}" + f" in {count} slabs" * (count > 1), target


def main() -> None:
    """Write the digests, or compare them with those in a file; exit code 1 if any differs."""
    parser = parser_of(__doc__)
    parser.add_argument("meshes", nargs="+", type=Path, help="closed meshes, or folders of them")
    parser.add_argument("--sizes", nargs="+", type=int, default=[32, 64])
    parser.add_argument("--slabs", nargs="+", type=int, default=[1])
    parser.add_argument("--out", type=Path, help="write the digests to this JSON file")
    parser.add_argument("--keep", type=Path, help="keep the mesh files in this folder")
    parser.add_argument("--against", type=Path, help="compare them with this JSON file")
    options, network = parser.parse_args(), digest(find_model(DEFAULT_QUALITY)[0])
    before = json.loads(options.against.read_text()) if options.against else None
    if before and before["network"] != network:
        raise SystemExit(f"{options.against} is of another network: {before['network'][:12]}...")
    loaded = load_network(device="cpu")
    digests, others = {}, []
    for path in find_meshes(options.meshes):
        for name, mesh in write_meshes(path, options.sizes, options.slabs, loaded):
            digests[name] = digest(mesh)
            if options.keep:
                shutil.copy(mesh, options.keep / f"{name.replace(' ', '-')}.ply")
            if before and before["meshes"].get(name) != digests[name]:
                others.append(name)
    if options.out:
        text = json.dumps({"network": network, "meshes": digests}, indent=1)
        options.out.write_text(text + "\n")
    what = "the same bytes" if before else "written"
    print(f"{len(digests) - len(others)} of {len(digests)} meshes are {what}")
    raise SystemExit("\n".join(["Others:", *others]) if others else 0)
