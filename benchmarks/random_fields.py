"""Faults and self-intersections of the meshes of random fields, with every mesher.

Each field is meshed at once, in 2 to 6 slabs and in as many bricks: all must be the same mesh, and
the running count of open edges must be that of the whole mesh.

    python -m benchmarks.random_fields --count 10000
    python -m benchmarks.random_fields --count 1000 --first 4000    # those from number 4000 on

The fields have 2 to 16 samples a side: noise, clamped, half-integer and exact-zero values, balls,
and planes that meet in edges; half of them are capped. The kinds, and what counts as a fault, are
in ``tests/corpus/random_fields.py``. Vertices at which an open surface has several fans count as
faults, too, and vertices of a mesher further from those of marching cubes than the documented
reach. Needs the extra eval. The exit code is 1 if a mesh has a fault.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from itertools import islice
from pathlib import Path

from scipy.spatial import cKDTree

from super_sdf import Mesh, load_network
from super_sdf.certificate.search import self_intersections
from super_sdf.certificate.surface import examine_surface
from super_sdf.options import MARCHING, MESHERS

# Fine spacings along an axis from a vertex of marching cubes in the same cell: half outside a cell.
REACH = 1.5


def distance_from(plain: Mesh, mesh: Mesh) -> float:
    """Return how far the vertices of a mesh are at most from those of another, along an axis."""
    return float(cKDTree(plain.vertices).query(mesh.vertices, p=float("inf"))[0].max(initial=0))


def print_table(kinds: list[str], fields: Counter[str], pairs: Counter[tuple[str, str]]) -> None:
    """Print the pairs of intersecting triangles of every kind of field as a Markdown table."""
    print(f"| field | fields | {' | '.join(MESHERS)} |\n| --- |" + " ---: |" * (1 + len(MESHERS)))
    for kind in kinds:
        cells = [kind, fields[kind], *(pairs[kind, mesher] for mesher in MESHERS)]
        print(f"| {' | '.join(map(str, cells))} |")
    sums = [sum(pairs[kind, mesher] for kind in kinds) for mesher in MESHERS]
    print(f"| all | {fields.total()} | {' | '.join(map(str, sums))} |")


def main() -> None:
    """Mesh the fields, print their faults and a table of self-intersections."""
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    from corpus.random_fields import (
        KINDS,
        faults_of_mesh,
        faults_of_pieces,
        make_fields,
        mesh_of_field,
    )

    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="number of the first field")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    network, faulty = load_network("fast", threads=1), 0
    fields: Counter[str] = Counter()
    pairs: Counter[tuple[str, str]] = Counter()
    end = options.first + options.count
    for number, field in enumerate(islice(make_fields(end, options.seed), options.first, end)):
        kind = list(KINDS)[(options.first + number) % len(KINDS)]
        fields[kind] += 1
        meshes = {mesher: mesh_of_field(field, network, mesher) for mesher in MESHERS}
        for mesher, mesh in meshes.items():
            found = self_intersections(mesh)
            surface = examine_surface(mesh, found)
            faults = faults_of_mesh(field, mesh)
            faults += faults_of_pieces(field, network, mesher, 2 + fields.total() % 5, mesh)
            if not surface.manifold or surface.edges.flipped_edges:
                faults.append(f"{field.name}: {surface.faults()}")
            far = distance_from(meshes[MARCHING], mesh) * field.factor
            if far > REACH + 1e-3:
                faults.append(f"{field.name}: a vertex is {far:.3f} fine spacings off")
            for fault in faults:
                print(f"{mesher}: {fault}", flush=True)
            faulty += bool(faults)
            pairs[kind, mesher] += found or 0
    print(f"{options.count:,} fields, {faulty} faulty meshes; intersecting pairs of triangles:\n")
    print_table(list(KINDS), fields, pairs)
    raise SystemExit(1 if faulty else 0)


if __name__ == "__main__":
    main()
