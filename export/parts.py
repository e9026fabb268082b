"""Procedural CAD parts to measure edges on: chamfers, fillets, drillings, ribs and pockets.

    python -m export.parts OUT [--count 24] [--seed 0] [--detail usual]
    python -m lab figures --shapes FOLDER --parts OUT --only edges

Writes closed meshes, PLY, with a box diagonal of 1. Part n is of kind n modulo 6, its measures
drawn from a generator seeded by (seed, n): the same seed gives the same files. None of the kinds is
one of ``shapes``, which trains the network. With the detail "usual" a grid of 32^3 resolves every
feature: see ``usual_parts``; with "fine" it does not: see ``fine_parts``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from manifold3d import Manifold

from export import fine_parts, usual_parts
from export.shapes.draws import unit_sized
from super_sdf import Mesh, write_mesh

COUNT = 24
TOLERANCE = 2e-6  # of the diagonal: shorter edges are removed

Part = Callable[[np.random.Generator], Manifold]
DETAILS: dict[str, tuple[Part, ...]] = {"usual": usual_parts.KINDS, "fine": fine_parts.KINDS}


def draw_part(number: int, seed: int = 0, detail: str = "usual") -> tuple[str, Mesh]:
    """Return the name and the mesh of a part, its box centred and of diagonal 1."""
    kinds = DETAILS[detail]
    kind = kinds[number % len(kinds)]
    solid = unit_sized(kind(np.random.default_rng((seed, number)))).simplify(TOLERANCE)
    drawn = unit_sized(solid).to_mesh64()
    mesh = Mesh(drawn.vert_properties[:, :3], drawn.tri_verts.astype(np.int32))
    return f"part-{number:02d}-{kind.__name__}", mesh


def write_parts(out: Path, count: int = COUNT, seed: int = 0, detail: str = "usual") -> list[Path]:
    """Write parts into a folder, which is made if it is missing; return their paths."""
    out.mkdir(parents=True, exist_ok=True)
    parts = [draw_part(number, seed, detail) for number in range(count)]
    paths = [out / f"{name}.ply" for name, _ in parts]
    for path, (_, mesh) in zip(paths, parts):
        write_mesh(mesh, path)
    return paths


def main(words: Sequence[str] | None = None) -> None:
    """Write the parts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("out", type=Path, help="folder")
    parser.add_argument("--count", type=int, default=COUNT, help="number of parts (default: 24)")
    parser.add_argument("--seed", type=int, default=0, help="seed of all measures (default: 0)")
    parser.add_argument(
        "--detail",
        choices=DETAILS,
        default="usual",
        help="smallest features: a tenth of the diagonal (usual, the default) or a fiftieth (fine)",
    )
    options = parser.parse_args(words)
    paths = write_parts(options.out, options.count, options.seed, options.detail)
    print(f"{len(paths)} parts in {options.out}")


if __name__ == "__main__":
    main()
