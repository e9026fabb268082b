"""Training samples: windows of coarse grids with exact distances at fine query points.

    python -m export.dataset --meshes DIR --out training/store --count 3000

A sample is one shape in one pose at one resolution. It holds a window of the coarse grid and, for
each voxel that can hold the surface, the exact distance at a set of query offsets that is drawn
anew for every sample: mostly nodes of the K = 4 lattice, some of the K = 16 lattice (which has
those of 2 and 8), some anywhere in the voxel. Values are rescaled (half voxels, Eqs. 4 and 5).

Samples are stored in shards, ``shard-<seed>-<number>.npz``, of flat arrays laid end to end:
``windows`` (float32) with ``window_shape``, ``offsets`` (n, Q, 3), ``voxel_ijk`` (D, 3) and
``targets`` (D, Q) float16 with ``voxel_count``. Without ``--meshes`` all shapes are procedural.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
from scipy.spatial.transform import Rotation

from export.shapes import random_solid
from super_sdf import Mesh, SdfGrid
from super_sdf.band import can_hold_surface, find_band, gather_patches, rescale
from super_sdf.evaluation.sampling import sample_grid
from super_sdf.evaluation.solid import Solid, read_mesh
from super_sdf.nodes import block_offsets

QUERIES = {"factor 4": 24, "factor 16": 8, "anywhere": 8}
WINDOW = 36  # samples along each axis: a whole shape at 32^3, a piece of it at 64^3
SHARD = 50  # samples a file


@dataclass(frozen=True, eq=False)
class Sample:
    """One window (nx, ny, nz), its query offsets (Q, 3), voxels (D, 3) and targets (D, Q)."""

    window: np.ndarray
    offsets: np.ndarray
    voxel_ijk: np.ndarray
    targets: np.ndarray


def draw_mesh(rng: np.random.Generator, prisms: list[Path], others: list[Path]) -> Mesh:
    """Draw a shape: of the files, one in six is a simple prism; a fifth of all is procedural."""
    if not others or rng.random() < 0.2:
        return random_solid(rng)
    few = prisms if prisms and rng.random() < 1 / 6 else others
    return read_mesh(few[rng.integers(len(few))])


def draw_pose(rng: np.random.Generator, mesh: Mesh) -> Mesh:
    """Place a shape in index space: spacing 1/16 to 1/90 of its diagonal, half of them turned."""
    turn = Rotation.random(rng=rng).as_matrix() if rng.random() < 0.5 else np.eye(3)
    size = np.exp(rng.uniform(np.log(16), np.log(90)))
    diagonal = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    posed = mesh.transformed(turn * size / diagonal, np.zeros(3))
    low = posed.vertices.min(0)
    return posed.transformed(np.eye(3), rng.uniform(2, 3, 3) - low)


def draw_window(rng: np.random.Generator, mesh: Mesh) -> tuple[tuple[int, int, int], np.ndarray]:
    """Return shape and first sample of a window: the whole shape, or a piece round a vertex."""
    whole = np.ceil(mesh.vertices.max(0)).astype(int) + 3
    shape = np.minimum(whole, WINDOW)
    middle = mesh.vertices[rng.integers(len(mesh.vertices))]
    first = np.clip(np.floor(middle - shape / 2), 0, whole - shape)
    return tuple(int(n) for n in shape), first


def draw_offsets(rng: np.random.Generator) -> np.ndarray:
    """Return the sample's query offsets, (Q, 3) in [-1, 1]."""
    lattices = [
        rng.permutation(block_offsets(factor))[: QUERIES[f"factor {factor}"]] for factor in (4, 16)
    ]
    anywhere = rng.uniform(-1, 1, (QUERIES["anywhere"], 3))
    return np.concatenate([*lattices, anywhere]).astype(np.float32)


def make_sample(rng: np.random.Generator, mesh: Mesh) -> Sample | None:
    """Sample a shape; None where its distances are not to be trusted or nothing is in sight."""
    posed = draw_pose(rng, mesh)
    shape, first = draw_window(rng, posed)
    values = sample_grid(Solid(posed), (shape, 1.0, first))
    if not (values < 0).any() or not (values > 0).any():
        return None
    window = rescale(SdfGrid(values, (1.0, 1.0, 1.0)))
    band = find_band(window)
    voxel_ijk = band[can_hold_surface(gather_patches(window, band))]
    offsets = draw_offsets(rng)
    points = (voxel_ijk[:, None] + first + offsets / 2).reshape(-1, 3)
    distances = pseudonormal_distance(posed, points)
    if not signs_agree(rng, posed, points, distances):
        return None
    targets = (2 * distances).reshape(len(voxel_ijk), -1).astype(np.float16)
    return Sample(window, offsets, voxel_ijk.astype(np.uint8), targets)


def pseudonormal_distance(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Return the signed distance, sign by the nearest triangle: wrong on meshes to be refused."""
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    return igl.signed_distance(points, mesh.vertices, mesh.faces, kind)[0]


def signs_agree(
    rng: np.random.Generator, mesh: Mesh, points: np.ndarray, distances: np.ndarray
) -> bool:
    """Check the sign at 2,000 points by winding number: meshes that self-intersect fail."""
    some = rng.integers(len(points), size=min(len(points), 2000))
    clear = np.abs(distances[some]) > 1e-4  # on the surface either sign is right
    inside = Solid(mesh).is_inside(points[some])
    return bool((inside == (distances[some] < 0))[clear].all())


def write_shard(path: Path, samples: list[Sample]) -> None:
    """Write samples end to end; the file appears whole or not at all."""
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez(
            file,
            windows=np.concatenate([s.window.ravel() for s in samples]),
            window_shape=np.array([s.window.shape for s in samples]),
            offsets=np.stack([s.offsets for s in samples]),
            voxel_ijk=np.concatenate([s.voxel_ijk for s in samples]),
            targets=np.concatenate([s.targets for s in samples]),
            voxel_count=np.array([len(s.voxel_ijk) for s in samples]),
        )
    part.rename(path)


def read_shard(path: Path) -> Iterator[Sample]:
    """Yield the samples of a shard."""
    with np.load(path) as file:
        shard = dict(file)
    window_ends = np.cumsum(shard["window_shape"].prod(1))
    voxel_ends = np.cumsum(shard["voxel_count"])
    windows = np.split(shard["windows"], window_ends[:-1])
    voxels = np.split(shard["voxel_ijk"], voxel_ends[:-1])
    targets = np.split(shard["targets"], voxel_ends[:-1])
    for n, shape in enumerate(shard["window_shape"]):
        yield Sample(windows[n].reshape(shape), shard["offsets"][n], voxels[n], targets[n])


def find_meshes(folder: Path | None) -> tuple[list[Path], list[Path]]:
    """Return the files of simple prisms (under 128 faces, by file size) and all others."""
    files = sorted(folder.glob("*.ply")) if folder else []
    prisms = [file for file in files if file.stat().st_size < 3000]
    return prisms, sorted(set(files) - set(prisms))


def main() -> None:
    """Fill a store; a shard that is there already is kept."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--meshes", type=Path, help="folder of closed .ply meshes")
    parser.add_argument("--out", type=Path, required=True, help="folder for the shards")
    parser.add_argument("--count", type=int, default=3000, help="samples to make")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    prisms, others = find_meshes(options.meshes)
    for number in range(-(-options.count // SHARD)):
        path = options.out / f"shard-{options.seed}-{number:04d}.npz"
        if path.exists():
            continue
        rng = np.random.default_rng([options.seed, number])
        samples: list[Sample] = []
        refused = 0
        while len(samples) < SHARD:
            sample = make_sample(rng, draw_mesh(rng, prisms, others))
            samples += [sample] if sample else []
            refused += sample is None
        write_shard(path, samples)
        print(
            f"{path.name}: {sum(len(s.voxel_ijk) for s in samples)} voxels, {refused} refused",
            flush=True,
        )


if __name__ == "__main__":
    main()
