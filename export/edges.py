"""Fit the rule that tells edges from rounded ground: see ``super_sdf.surface.sharp.features``.

    python -m export.edges --meshes FOLDER_OF_PLY --procedural 0.4 --count 200 --out edges.npz
    python -m export.edges --fit --write --out edges.npz   # into the package

Shapes for training are sampled on a grid and refined by the shipped network. For every candidate
of the mesher the surfaces there are compared with the true one, with vertices that go some shares
of the way to the edge. The rule is the linear one of the evidence that loses least in the mean. The
rows are kept in ``--out``; with ``--fit`` they are fitted again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from export.arguments import Parser, at_least, share
from export.dataset import draw_mesh, mesh_order
from export.shapes.solid import random_solid
from super_sdf import Mesh, load_network, upsample
from super_sdf.arrays import face_normals, unit
from super_sdf.errors import SuperSdfError
from super_sdf.surface import cap, marching
from super_sdf.surface.sharp import features, patches, planes
from super_sdf.truth import Solid, sample_solid

SIZES = (24, 32, 32, 48)  # drawn from, samples along an axis
FACTOR = 4
SHARES = np.linspace(0, 1, 5)  # of the way to the edge at which losses are measured
DISTANCE, TURN = 0.01, 0.05  # losses that count alike: coarse voxels, and 1 - cosine of normals
MOST = 5.0  # that one candidate may lose beyond the best share
AT = np.array([[0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.2, 0.2, 0.6]])  # points of a triangle
MOST_OF_SHAPE = 2000  # candidates that one shape counts for
PENALTY = 1e-4  # of the squares of the weights of the standardised evidence
STEPS, RATE = 300, 0.02  # of gradient descent
# Shares that lose least are made 0 and 1 from here on: that costs a twentieth of the gain
# and more edges are whole.
KNEE = 0.3, 0.7

Rows = dict[str, np.ndarray]
"""The ``shape`` of each candidate, (n,), its ``evidence``, (n, e), and its ``loss``, (n, s).

The loss is how far the surface there is from the true one, and turned from it, at ``SHARES``.
"""


def rows_of(mesh: Mesh, size: int, network: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the evidence (f, e) and the losses (f, s) of all candidates of a shape."""
    truth = Solid(mesh)
    grid = sample_solid(truth, ((size,) * 3, 1 / size, np.full(3, 0.5 / size - 0.5)))
    field = cap.close(upsample(grid, network, FACTOR), cap=True)
    every, crossings = np.ones(len(field.voxel_ijk), bool), marching.find_crossings(field)
    found, used = patches.find_patches(field, crossings, every)
    border = np.array([(0, 0, 0), field.shape])
    own = planes.planes_at_crossings(field, crossings, used, border)
    candidates = features.find_candidates(found, own, every, field)
    losses = []
    for way in SHARES:
        placed = features.place(found, own, candidates, np.full(len(candidates.patch), way))
        patch, corners = patches.triangles_of(found, placed, np.ones(len(found.row), bool))
        points = grid.to_world(placed.points[corners].reshape(-1, 3) / FACTOR - 0.5)
        errors = errors_of(truth, patch, points.reshape(-1, 3, 3), len(found.row))
        losses.append((errors[candidates.patch] / (DISTANCE / size, TURN)).sum(1))
    return candidates.evidence, np.stack(losses, 1)


def errors_of(truth: Solid, patch: np.ndarray, corners: np.ndarray, count: int) -> np.ndarray:
    """Return the mean distance to the true surface of each patch, and 1 - cosine, (count, 2).

    Triangles (t, 3, 3) belong to patches (t,); patches without any have 0.
    """
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(area, 1e-18)[:, None]
    points = np.einsum("pk,tkd->ptd", AT, corners).reshape(-1, 3)
    off, nearest, _ = truth.nearest(points)
    distance = off.reshape(len(AT), -1).mean(0)
    true = unit(face_normals(truth.mesh.vertices, truth.mesh.faces[nearest]))
    turned = 1 - np.einsum("ptd,td->pt", true.reshape(len(AT), -1, 3), normal).mean(0)
    sums = [np.bincount(patch, area * error, count) for error in (distance, turned)]
    return np.stack(sums, 1) / np.maximum(np.bincount(patch, area, count), 1e-18)[:, None]


def gather(options: argparse.Namespace) -> Rows:
    """Return the rows of as many shapes as are asked for, leaving out those without a mesh."""
    rng, network = np.random.default_rng(options.seed), load_network(device="cpu", threads=1)
    paths = mesh_order(options.meshes, 1, options.seed)
    parts: list[tuple[np.ndarray, ...]] = []
    while (number := len(parts)) < options.count:
        drawn = not paths or rng.random() < options.procedural
        mesh = random_solid(rng) if drawn else draw_mesh(rng, paths[rng.integers(len(paths))])
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        try:
            box = np.array([end(mesh.vertices @ turn.T, axis=0) for end in (np.min, np.max)])
            size = np.linalg.norm(box[1] - box[0])
            turned = mesh.transformed(turn / size, -box.mean(0) / size)  # of diagonal 1, centred
            evidence, loss = rows_of(turned, int(rng.choice(SIZES)), network)
        except SuperSdfError:
            continue
        parts.append((np.full(len(evidence), number), evidence, loss))
        print(f"{number + 1} shapes, {len(evidence)} candidates of the last", flush=True)
    rows = dict(zip(("shape", "evidence", "loss"), map(np.concatenate, zip(*parts))))
    np.savez(options.out, **rows)
    return rows


def fit_rule(rows: Rows) -> features.Rule:
    """Return the rule of the least loss, by Adam's descent, made steeper at ``KNEE``."""
    evidence, (loss, weight) = rows["evidence"], capped(rows)
    mean, spread = evidence.mean(0), np.maximum(evidence.std(0), 1e-9)
    design = np.c_[np.ones(len(evidence)), (evidence - mean) / spread]
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
    return features.Rule(float(bias - low) / (high - low), tuple((weights / (high - low)).tolist()))


def loss_of(loss: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the loss at a share, (n,), between those at ``SHARES``, and its slope."""
    place = share * (len(SHARES) - 1)
    low = np.clip(place.astype(int), 0, len(SHARES) - 2)
    row = np.arange(len(loss))
    slope = loss[row, low + 1] - loss[row, low]
    return loss[row, low] + (place - low) * slope, slope * (len(SHARES) - 1)


def capped(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Return losses over that of the best share, (n, s), and what candidates count for, (n,).

    None counts for too much, and less where its shape has many more than others.
    """
    loss = np.minimum(rows["loss"] - rows["loss"].min(1, keepdims=True), MOST)
    weight = np.minimum(1, MOST_OF_SHAPE / np.bincount(rows["shape"])[rows["shape"]])
    return loss, weight / weight.sum()


def main(words: Sequence[str] | None = None) -> None:
    """Gather rows, or read those of a file, fit the rule, and print what is lost."""
    parser = Parser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("--meshes", type=Path, help="folder of closed .ply meshes")
    add("--procedural", type=share, default=0.4, help="share of procedural shapes")
    add("--count", type=at_least(1), default=200, help="shapes to draw")
    add("--out", type=Path, required=True, help="file of the rows, .npz")
    add("--fit", action="store_true", help="fit the rows in --out again")
    add("--write", action="store_true", help="write the rule into the package")
    add("--seed", type=at_least(0), default=0)
    options = parser.parse_args(words)
    with parser.one_line_errors():
        rows = dict(np.load(options.out)) if options.fit else gather(options)
    rule, (loss, weight) = fit_rule(rows), capped(rows)
    ways = rule.share(rows["evidence"])
    for name, some in {"middle": 0 * ways, "rule": ways, "edge": 0 * ways + 1}.items():
        print(f"{name}: {weight @ loss_of(loss, some)[0]:.4f}")
    if options.write:
        names = json.loads(features.RULE.read_text())["weights"]
        weights = {name: round(weight, 4) for name, weight in zip(names, rule.weights, strict=True)}
        stored = json.dumps({"bias": round(rule.bias, 4), "weights": weights}, indent=2)
        features.RULE.write_text(stored + "\n")


if __name__ == "__main__":
    main()
