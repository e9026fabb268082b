"""Fit the rule that tells edges from rounded ground: see ``super_sdf.steps.sharp.features``.

    python -m export.edges --meshes FOLDER_OF_PLY --procedural 0.4 --count 200 --out edges.npz

Shapes for training are sampled on a grid and refined by the shipped network. For every candidate
of the mesher the two surfaces there, with the vertex on the edge and without it, are compared with
the true one. The rule is a logistic regression of which is better on the evidence, weighted by by
how much. The rows are kept in ``--out``; with ``--fit`` alone they are fitted again.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from export.arguments import Parser, at_least, share
from export.dataset import draw_mesh, find_meshes
from export.shapes.solid import random_solid
from lab.metrics import face_vectors
from lab.shapes import Case, Setting, Shape
from super_sdf.errors import SuperSdfError
from super_sdf.grid.sdf_grid import SdfGrid
from super_sdf.network.network import Network, load_network
from super_sdf.pipeline import upsample
from super_sdf.steps.cap import close_at_border
from super_sdf.steps.field import FineField
from super_sdf.steps.marching import find_crossings, to_world
from super_sdf.steps.sharp.features import Candidates, Rule, find_candidates, move_beside
from super_sdf.steps.sharp.patches import (
    Patches,
    Placed,
    fan_triangles,
    find_patches,
    flat_triangles,
    unfolded,
)
from super_sdf.steps.sharp.planes import Planes, planes_at_crossings
from super_sdf.truth.solid import Solid

SIZES = (24, 32, 32, 48)  # drawn from, samples along an axis
FACTOR = 4
DISTANCE, TURN = 0.01, 0.05  # gains that count alike: coarse voxels, and 1 - cosine of normals
MOST = 5.0  # such gains that one candidate counts for
MOST_OF_SHAPE = 2000  # candidates that one shape counts for
AT = np.array([[0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.2, 0.2, 0.6]])  # points of a triangle
PENALTY = 1.0  # of the squares of the weights of the standardised evidence
STEPS = 30  # of Newton's method


Triangles = tuple[np.ndarray, np.ndarray]
"""The patch of each triangle, (t,), and its corners in fine spacings, (t, 3, 3)."""
Rows = dict[str, np.ndarray]
"""The ``shape`` of each candidate, (n,), its ``evidence``, (n, e), and its ``gain``, (n, 2).

A gain is by how much nearer the surface is with a vertex on the edge, in coarse voxels, and by how
much 1 - cosine of its normals is less.
"""


def draw_case(rng: np.random.Generator, paths: list[Path], procedural: float, number: int) -> Case:
    """Return a shape for training, turned at random, sampled on a grid."""
    drawn = not paths or rng.random() < procedural
    mesh = random_solid(rng) if drawn else draw_mesh(rng, paths[rng.integers(len(paths))])
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    shape = Shape(f"drawn-{number}", mesh.transformed(rotation, np.zeros(3)))
    return Case(shape, Setting(int(rng.choice(SIZES)), FACTOR))


def rows_of(case: Case, network: Network) -> tuple[np.ndarray, np.ndarray]:
    """Return the evidence (f, e) and the gain (f, 2) of all candidates of a case."""
    field = close_at_border(upsample(case.grid, network, FACTOR))
    every = np.ones(len(field.voxel_ijk), bool)
    crossings = find_crossings(field, slice(0, len(every)))
    patches, used = find_patches(field, crossings, every)
    own = planes_at_crossings(field, crossings, used)
    candidates = find_candidates(patches, own, every, field)
    if not len(candidates.patch):
        return candidates.evidence, np.empty((0, 2))
    without, with_all = surfaces(patches, own, candidates)
    before, after = (
        np.stack(errors_of(case.shape.solid, some, len(patches.row), field, case.grid), 1)
        for some in (without, with_all)
    )
    return candidates.evidence, (before - after)[candidates.patch]


def surfaces(patches: Patches, own: Planes, candidates: Candidates) -> tuple[Triangles, Triangles]:
    """Return the triangles of all candidates without a vertex on the edge, and with one."""
    chosen = np.zeros(len(patches.row), bool)
    chosen[candidates.patch] = True
    patch, corners = flat_triangles(patches, chosen)
    flat = patch, own.point[corners]
    moved = move_beside(patches, own, candidates, np.ones(len(candidates.patch), bool))
    placed = Placed(moved, candidates.planes.normal, candidates.patch, candidates.vertex)
    placed = unfolded(patches, placed)
    patches_of, corners_of = zip(*fan_triangles(patches, placed))
    return flat, (np.concatenate(patches_of), placed.points[np.concatenate(corners_of)])


def errors_of(
    solid: Solid, triangles: Triangles, count: int, field: FineField, grid: SdfGrid
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean distance to the true surface of each of ``count`` patches, and 1 - cosine.

    Distances are in coarse voxels. Patches without triangles have 0.
    """
    patch, corners = triangles
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(area, 1e-12)[:, None]
    points = np.einsum("pk,tkd->ptd", AT, corners).reshape(-1, 3)
    world = to_world(points.T, field, grid).astype(np.float64)
    distance = solid.distance(world).reshape(len(AT), -1).mean(0) / grid.spacing[0]
    true = face_vectors(solid.mesh)[solid.nearest_face(world)]
    true /= np.maximum(np.linalg.norm(true, axis=1), 1e-15)[:, None]
    turned = 1 - np.einsum("ptd,td->pt", true.reshape(len(AT), -1, 3), normal).mean(0)
    total = np.maximum(np.bincount(patch, area, count), 1e-12)
    return tuple(np.bincount(patch, area * error, count) / total for error in (distance, turned))


def gather(options: argparse.Namespace) -> Rows:
    """Return the rows of as many shapes as are asked for, leaving out those without a mesh."""
    rng, network = np.random.default_rng(options.seed), load_network(device="cpu", threads=1)
    prisms, others = find_meshes(options.meshes)
    paths = [*prisms[: len(others) // 5], *others]
    parts: list[tuple[np.ndarray, ...]] = []
    while (number := len(parts)) < options.count:
        try:
            case = draw_case(rng, paths, options.procedural, number)
            evidence, gain = rows_of(case, network)
        except SuperSdfError:
            continue
        parts.append((np.full(len(evidence), number), evidence, gain))
        print(f"{number + 1} shapes, {len(evidence)} candidates of the last", flush=True)
    rows = dict(zip(("shape", "evidence", "gain"), map(np.concatenate, zip(*parts))))
    np.savez(options.out, **rows)
    return rows


def fit_rule(rows: Rows, bias: float = 0.0) -> Rule:
    """Return the logistic regression of which surface is better on the evidence.

    A candidate weighs by how much is gained or lost, and less where its shape has many more than
    others. ``bias`` is added to the scores: under 0 it keeps marching cubes where both are close.
    """
    gain = rows["gain"] @ (1 / np.array([DISTANCE, TURN]))
    weight = np.minimum(np.abs(gain), MOST)
    weight *= np.minimum(1, MOST_OF_SHAPE / np.bincount(rows["shape"])[rows["shape"]])
    mean, spread = rows["evidence"].mean(0), np.maximum(rows["evidence"].std(0), 1e-9)
    design = np.c_[np.ones(len(gain)), (rows["evidence"] - mean) / spread]
    found = np.zeros(design.shape[1])
    penalty = PENALTY * np.diag(np.r_[0, np.ones(len(mean))])
    for _ in range(STEPS):
        likely = 1 / (1 + np.exp(-np.clip(design @ found, -30, 30)))
        slope = design.T @ (weight * (likely - (gain > 0))) + penalty @ found
        curve = (design.T * (weight * likely * (1 - likely))) @ design + penalty
        found -= np.linalg.solve(curve, slope)
    weights = found[1:] / spread
    return Rule(float(found[0] - weights @ mean) + bias, tuple(weights.tolist()))


def report(rows: Rows, rule: Rule) -> str:
    """Return the gains of all candidates, of those that a rule keeps, and of the best ones."""
    kept = rule.score(rows["evidence"]) > 0
    best = rows["gain"] @ (1 / np.array([DISTANCE, TURN])) > 0
    lines = [
        f"{name}: {which.sum()} candidates, {rows['gain'][which, 0].sum():.0f} voxels nearer, "
        f"1 - cosine less by {rows['gain'][which, 1].sum():.0f}"
        for name, which in (("all", kept | True), ("kept", kept), ("best", best))
    ]
    return "\n".join(lines)


def main() -> None:
    """Gather rows, or read those of a file, and print the rule."""
    parser = Parser(description=__doc__.split("\n")[0])
    parser.add_argument("--meshes", type=Path, help="folder of closed .ply meshes")
    parser.add_argument("--procedural", type=share, default=0.4, help="share of procedural shapes")
    parser.add_argument("--count", type=at_least(1), default=200, help="shapes to draw")
    parser.add_argument("--out", type=Path, required=True, help="file of the rows, .npz")
    parser.add_argument("--fit", action="store_true", help="fit the rows in --out again")
    parser.add_argument("--bias", type=float, default=0.0, help="added to the scores")
    parser.add_argument("--seed", type=at_least(0), default=0)
    options = parser.parse_args()
    rows = dict(np.load(options.out)) if options.fit else gather(options)
    rule = fit_rule(rows, options.bias)
    print(report(rows, rule))
    print(f"Rule({rule.bias:.3f}, ({', '.join(f'{weight:.3f}' for weight in rule.weights)}))")


if __name__ == "__main__":
    main()
