"""Fit the rule that tells edges from rounded ground: see ``super_sdf.surface.sharp.features``.

    python -m export.edges --meshes FOLDER_OF_PLY --procedural 0.4 --count 200 --out edges.npz

Shapes for training are sampled on a grid and refined by the shipped network. For every candidate
of the mesher the surfaces there are compared with the true one, with vertices that go some shares
of the way to the edge. The rule is the linear one of the evidence that loses least in the mean. The
rows are kept in ``--out``; with ``--fit`` alone they are fitted again. ``--write`` puts the rule
into the package.
"""

from __future__ import annotations

import argparse
import json
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
from super_sdf.refine.field import FineField
from super_sdf.surface.cap import close
from super_sdf.surface.extract import to_world
from super_sdf.surface.marching import find_crossings
from super_sdf.surface.sharp.features import RULE, Rule, find_candidates, place
from super_sdf.surface.sharp.patches import Placed, Triangles, find_patches, triangles_of
from super_sdf.surface.sharp.planes import planes_at_crossings
from super_sdf.truth.solid import Solid

SIZES = (24, 32, 32, 48)  # drawn from, samples along an axis
FACTOR = 4
SHARES = np.linspace(0, 1, 5)  # of the way to the edge at which losses are measured
DISTANCE, TURN = 0.01, 0.05  # losses that count alike: coarse voxels, and 1 - cosine of normals
MOST = 5.0  # that one candidate may lose beyond the best share
AT = np.array([[0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.2, 0.2, 0.6]])  # points of a triangle
MOST_OF_SHAPE = 2000  # candidates that one shape counts for
PENALTY = 1e-4  # of the squares of the weights of the standardised evidence
STEPS = 300  # of gradient descent
RATE = 0.02
# Shares that lose least are made 0 and 1 from here on: that costs a twentieth of the gain
# and more edges are whole.
KNEE = 0.3, 0.7

Rows = dict[str, np.ndarray]
"""The ``shape`` of each candidate, (n,), its ``evidence``, (n, e), and its ``loss``, (n, s).

The loss is how far the surface there is from the true one, and turned from it, at ``SHARES``.
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
    """Return the evidence (f, e) and the losses (f, s) of all candidates of a case."""
    field = close(upsample(case.grid, network, FACTOR), cap=True)
    every = np.ones(len(field.voxel_ijk), bool)
    crossings = find_crossings(field)
    border = np.array([(0, 0, 0), field.shape])
    patches, used = find_patches(field, crossings, every)
    own = planes_at_crossings(field, crossings, used, border)
    candidates = find_candidates(patches, own, every, field)
    losses = []
    for way in SHARES:
        placed = place(patches, own, candidates, np.full(len(candidates.patch), way))
        made = triangles_of(patches, placed, np.ones(len(patches.row), bool))
        errors = errors_of(case.shape.solid, made, placed, field, case.grid)
        losses.append((errors[candidates.patch] / (DISTANCE, TURN)).sum(1))
    return candidates.evidence, np.stack(losses, 1)


def errors_of(
    solid: Solid, triangles: Triangles, placed: Placed, field: FineField, grid: SdfGrid
) -> np.ndarray:
    """Return the mean distance to the true surface of each patch, and 1 - cosine, (P, 2).

    Distances are in coarse voxels. Patches without triangles have 0.
    """
    patch, corners = triangles
    corners = placed.points[corners]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(area, 1e-12)[:, None]
    points = np.einsum("pk,tkd->ptd", AT, corners).reshape(-1, 3)
    world = to_world(points.T, field.factor, grid)
    distance = solid.distance(world).reshape(len(AT), -1).mean(0) / grid.spacing[0]
    true = face_vectors(solid.mesh)[solid.nearest_face(world)]
    true /= np.maximum(np.linalg.norm(true, axis=1), 1e-15)[:, None]
    turned = 1 - np.einsum("ptd,td->pt", true.reshape(len(AT), -1, 3), normal).mean(0)
    total = np.maximum(np.bincount(patch, area), 1e-12)
    sums = [np.bincount(patch, area * error) for error in (distance, turned)]
    return np.stack(sums, 1) / total[:, None]


def gather(options: argparse.Namespace) -> Rows:
    """Return the rows of as many shapes as are asked for, leaving out those without a mesh."""
    rng, network = np.random.default_rng(options.seed), load_network(device="cpu", threads=1)
    prisms, others = find_meshes(options.meshes)
    paths = [*prisms[: len(others) // 5], *others]
    parts: list[tuple[np.ndarray, ...]] = []
    while (number := len(parts)) < options.count:
        try:
            case = draw_case(rng, paths, options.procedural, number)
            evidence, loss = rows_of(case, network)
        except SuperSdfError:
            continue
        parts.append((np.full(len(evidence), number), evidence, loss))
        print(f"{number + 1} shapes, {len(evidence)} candidates of the last", flush=True)
    rows = dict(zip(("shape", "evidence", "loss"), map(np.concatenate, zip(*parts))))
    np.savez(options.out, **rows)
    return rows


def fit_rule(rows: Rows) -> Rule:
    """Return the rule of the least loss, by Adam's descent, made steeper at ``KNEE``."""
    mean, spread = rows["evidence"].mean(0), np.maximum(rows["evidence"].std(0), 1e-9)
    design = np.c_[np.ones(len(mean_rows := rows["evidence"])), (mean_rows - mean) / spread]
    weight, loss = weights_of(rows), capped(rows["loss"])
    found, first, second = np.zeros((3, design.shape[1]))
    found[0] = 0.5
    for step in range(1, STEPS + 1):
        share = design @ found
        slope = loss_of(loss, np.clip(share, 0, 1))[1] * ((share > 0) & (share < 1))
        slope = design.T @ (weight * slope) + PENALTY * found
        first, second = 0.9 * first + 0.1 * slope, 0.99 * second + 0.01 * slope**2
        fair = first / (1 - 0.9**step), second / (1 - 0.99**step)
        found -= RATE * (1 - step / STEPS) * fair[0] / (np.sqrt(fair[1]) + 1e-12)
    weights, (low, high) = found[1:] / spread, KNEE
    bias = found[0] - weights @ mean
    return Rule(float(bias - low) / (high - low), tuple((weights / (high - low)).tolist()))


def write_rule(rule: Rule) -> None:
    """Write the rule into the package; the evidence keeps its names."""
    names = json.loads(RULE.read_text())["weights"]
    weights = {name: round(weight, 4) for name, weight in zip(names, rule.weights)}
    RULE.write_text(json.dumps({"bias": round(rule.bias, 4), "weights": weights}, indent=2) + "\n")


def weights_of(rows: Rows) -> np.ndarray:
    """Return what candidates count for, (n,): less where their shape has many more than others."""
    weight = np.minimum(1, MOST_OF_SHAPE / np.bincount(rows["shape"])[rows["shape"]])
    return weight / weight.sum()


def loss_of(loss: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the loss at a share, (n,), between those at ``SHARES``, and its slope."""
    place = share * (len(SHARES) - 1)
    low = np.clip(place.astype(int), 0, len(SHARES) - 2)
    row = np.arange(len(loss))
    slope = loss[row, low + 1] - loss[row, low]
    return loss[row, low] + (place - low) * slope, slope * (len(SHARES) - 1)


def capped(loss: np.ndarray) -> np.ndarray:
    """Return losses over that of the best share, (n, s), so that none counts for too much."""
    return np.minimum(loss - loss.min(1, keepdims=True), MOST)


def report(rows: Rows, rule: Rule) -> str:
    """Return the mean loss with vertices in the middle, by a rule, and on the edge."""
    share, loss, weight = rule.share(rows["evidence"]), capped(rows["loss"]), weights_of(rows)
    shares = {"middle": 0 * share, "rule": share, "edge": 0 * share + 1}
    return "\n".join(
        f"{name}: {weight @ loss_of(loss, some)[0]:.4f}" for name, some in shares.items()
    )


def main() -> None:
    """Gather rows, or read those of a file, and fit the rule."""
    parser = Parser(description=__doc__.split("\n")[0])
    parser.add_argument("--meshes", type=Path, help="folder of closed .ply meshes")
    parser.add_argument("--procedural", type=share, default=0.4, help="share of procedural shapes")
    parser.add_argument("--count", type=at_least(1), default=200, help="shapes to draw")
    parser.add_argument("--out", type=Path, required=True, help="file of the rows, .npz")
    parser.add_argument("--fit", action="store_true", help="fit the rows in --out again")
    parser.add_argument("--write", action="store_true", help="write the rule into the package")
    parser.add_argument("--seed", type=at_least(0), default=0)
    options = parser.parse_args()
    rows = dict(np.load(options.out)) if options.fit else gather(options)
    rule = fit_rule(rows)
    print(report(rows, rule))
    if options.write:
        write_rule(rule)


if __name__ == "__main__":
    main()
