"""Training samples: windows of coarse grids with exact distances at fine query points.

    python -m export.dataset --meshes DIR --procedural 0.3 --out training/store --count 5000

A sample is one shape in one pose at one resolution. It holds a window of the coarse grid and, for
each voxel that can hold the surface, the exact distance at a set of query offsets that is drawn
anew for every sample: ``CORNERS`` nodes of the K = 4 lattice, each followed by its next nodes along
x, y and z (the differences are what the loss knows of the gradient), then some nodes of the K = 16
lattice (which has those of 2 and 8), then some points anywhere in the voxel. Values are rescaled
(half voxels, Eqs. 4 and 5).

Samples are stored in shards, ``shard-<seed>-<number>.npz``, of flat arrays laid end to end:
``windows`` (float32) with ``window_shape``, ``offsets`` (n, Q, 3), ``voxel_ijk`` (D, 3) and
``targets`` (D, Q) float16 with ``voxel_count``. Without ``--meshes`` all shapes are procedural;
with it, each mesh comes once before any comes again, but only as many of the simple prisms as make
a sixth, and ``--procedural`` says what share is procedural besides. ``--thin`` of the samples are
of solids so thin that hardly a sample lies inside.
"""

from __future__ import annotations

import argparse
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
from scipy.spatial.transform import Rotation

from export.arguments import Parser, at_least, share
from export.shapes import random_solid
from export.shapes.draws import draw_sway
from super_sdf import Mesh, SdfGrid
from super_sdf.errors import FileError
from super_sdf.files.regular import check_regular_file
from super_sdf.steps.band import DECODE_LIMIT, find_band, rescale
from super_sdf.steps.nodes import block_offsets
from super_sdf.truth.mesh_files import read_mesh
from super_sdf.truth.sampling import sample_grid
from super_sdf.truth.solid import Solid

CORNERS, FINE_NODES, ANYWHERE = 5, 4, 4  # queries: 4 a corner, 28 in all
SMALLEST, LARGEST = 7, 100  # voxels along a shape's diagonal
SWAYED = 0.3  # of the meshes
THIN = -0.2, 0.6  # between them, in spacings, is the lowest sample of a thin solid
WINDOW = 32  # samples along each axis: a whole shape at 32^3, a piece of it at 64^3
SHARD = 50  # samples a file


@dataclass(frozen=True, eq=False)
class Sample:
    """One window (nx, ny, nz), its query offsets (Q, 3), voxels (D, 3) and targets (D, Q)."""

    window: np.ndarray
    offsets: np.ndarray
    voxel_ijk: np.ndarray
    targets: np.ndarray


def draw_pose(rng: np.random.Generator, mesh: Mesh) -> Mesh:
    """Place a shape in index space: 7 to 100 voxels along its diagonal, half of them turned."""
    turn = Rotation.random(rng=rng).as_matrix() if rng.random() < 0.5 else np.eye(3)
    size = np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST)))
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
    """Return the sample's query offsets, (Q, 3) in [-1, 1]: see the module."""
    corners = rng.integers(0, 4, (CORNERS, 3)) / 2 - 1
    steps = np.concatenate([np.zeros((1, 3)), np.eye(3)]) / 2
    quadruples = (corners[:, None] + steps).reshape(-1, 3)
    fine = rng.permutation(block_offsets(16))[:FINE_NODES]
    anywhere = rng.uniform(-1, 1, (ANYWHERE, 3))
    return np.concatenate([quadruples, fine, anywhere]).astype(np.float32)


def make_sample(
    rng: np.random.Generator, mesh: Mesh, lowest: tuple[float, float] = (-np.inf, np.inf)
) -> Sample | None:
    """Sample a shape; None where it is not seen: no sample is near it, or all are inside.

    What is so thin that no sample lies inside is kept: it can be told from its distances. None
    also where the lowest sample is not between two bounds (spacings).
    """
    posed = draw_pose(rng, mesh)
    shape, first = draw_window(rng, posed)
    solid = Solid(posed)
    values = sample_grid(solid, (shape, 1.0, first))
    if not lowest[0] < values.min() < lowest[1]:
        return None
    window = rescale(SdfGrid.trusted(values, (1.0, 1.0, 1.0)))
    band = find_band(window)
    voxel_ijk = band[np.abs(window[tuple(band.T)]) <= DECODE_LIMIT]
    if not len(voxel_ijk) or (values < 0).all():
        return None
    offsets = draw_offsets(rng)
    points = (voxel_ijk[:, None] + first + offsets / 2).reshape(-1, 3)
    targets = 2 * signed_distance(rng, solid, points).reshape(len(voxel_ijk), -1)
    return Sample(window, offsets, voxel_ijk.astype(np.uint8), targets.astype(np.float16))


def signed_distance(rng: np.random.Generator, solid: Solid, points: np.ndarray) -> np.ndarray:
    """Return the signed distance of points (n, 3).

    The nearest triangle gives the sign quickly, but wrongly on meshes that intersect themselves.
    So it is checked at 2,000 points by winding number; where any differs, all are asked for it.
    """
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    distances = igl.signed_distance(points, solid.mesh.vertices, solid.mesh.faces, kind)[0]
    some = rng.integers(len(points), size=min(len(points), 2000))
    clear = np.abs(distances[some]) > 1e-4  # on the surface either sign is right
    inside = solid.is_inside(points[some])
    if (inside == (distances[some] < 0))[clear].all():
        return distances
    return np.where(solid.is_inside(points), -np.abs(distances), np.abs(distances))


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
    """Yield the samples of a shard.

    Raises
    ------
    FileError
        If it is damaged, or none.
    """
    try:
        with np.load(check_regular_file(path)) as file:
            shard = dict(file)
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise FileError(f"{path} is no shard: {error}; remove it and make it again") from error
    window_ends = np.cumsum(shard["window_shape"].prod(1))
    voxel_ends = np.cumsum(shard["voxel_count"])
    windows = np.split(shard["windows"], window_ends[:-1])
    voxels = np.split(shard["voxel_ijk"], voxel_ends[:-1])
    targets = np.split(shard["targets"], voxel_ends[:-1])
    for n, shape in enumerate(shard["window_shape"]):
        yield Sample(windows[n].reshape(shape), shard["offsets"][n], voxels[n], targets[n])


def find_meshes(folder: Path | None) -> tuple[list[Path], list[Path]]:
    """Return the files of simple prisms (under 128 faces, by file size) and all others.

    Raises
    ------
    FileError
        If the folder is none or holds no .ply file, or one of them is no regular file.
    """
    if folder is None:
        return [], []
    if not folder.is_dir():
        raise FileError(f"--meshes {folder} is no folder: give one of closed .ply meshes")
    files = [check_regular_file(file) for file in sorted(folder.glob("*.ply"))]
    if not files:
        raise FileError(f"--meshes {folder} holds no .ply file: other formats are not read here")
    prisms = [file for file in files if file.stat().st_size < 3000]
    return prisms, sorted(set(files) - set(prisms))


def mesh_order(seed: int, prisms: list[Path], others: list[Path], count: int) -> list[Path]:
    """Return ``count`` files, all others once before any again, a sixth of them prisms.

    Where there are none but prisms, they are all.
    """
    rng = np.random.default_rng(seed)
    others, prisms = (others, prisms) if others else (prisms, [])
    order: list[Path] = []
    while others and len(order) < count:
        few = rng.permutation(prisms)[: len(others) // 5].tolist()
        order += rng.permutation([*others, *few]).tolist()
    return order


def draw_mesh(rng: np.random.Generator, path: Path) -> Mesh:
    """Read a mesh; some are bent by smooth waves, so that few faces stay flat or in line."""
    mesh = read_mesh(path)
    if rng.random() >= SWAYED:
        return mesh
    diagonal = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    return Mesh(draw_sway(rng, 0.6)(mesh.vertices / diagonal), mesh.faces)


def make_thin_sample(rng: np.random.Generator) -> Sample:
    """Squeeze procedural shapes along their axes until one is thin where it is seen."""
    sample = None
    while sample is None:
        solid = random_solid(rng)
        squeezed = solid.transformed(np.diag(np.exp(rng.normal(0, 1, 3))), np.zeros(3))
        sample = make_sample(rng, squeezed, THIN)
    return sample


def fill_shard(
    rng: np.random.Generator,
    files: Sequence[Path],
    procedural: float,
    thin: float,
    count: int = SHARD,
) -> list[Sample]:
    """Make a shard's samples; a procedural shape stands in for a mesh that shows nothing."""
    samples: list[Sample] = []
    for number in range(count):
        if rng.random() < thin:
            samples.append(make_thin_sample(rng))
            continue
        drawn = not files or rng.random() < procedural
        sample = make_sample(rng, random_solid(rng) if drawn else draw_mesh(rng, files[number]))
        while sample is None:
            sample = make_sample(rng, random_solid(rng))
        samples.append(sample)
    return samples


def main() -> None:
    """Fill a store; a shard that is there already is kept."""
    parser = Parser(description=__doc__.split("\n")[0])
    parser.add_argument("--meshes", type=Path, help="folder of closed .ply meshes")
    parser.add_argument("--procedural", type=share, default=0.3, help="share beside --meshes")
    parser.add_argument("--thin", type=share, default=0.05, help="share of thin solids")
    parser.add_argument("--out", type=Path, required=True, help="folder for the shards")
    parser.add_argument("--count", type=at_least(1), default=5000, help="samples to make")
    parser.add_argument("--seed", type=at_least(0), default=0)
    options = parser.parse_args()
    with parser.one_line_errors():
        fill_store(options)


def fill_store(options: argparse.Namespace) -> None:
    """Make the shards that are not there."""
    files = mesh_order(options.seed, *find_meshes(options.meshes), options.count + SHARD)
    options.out.mkdir(parents=True, exist_ok=True)
    for number in range(-(-options.count // SHARD)):
        path = options.out / f"shard-{options.seed}-{number:04d}.npz"
        if not path.exists():
            rng = np.random.default_rng([options.seed, number])
            drawn = files[number * SHARD : (number + 1) * SHARD]
            samples = fill_shard(rng, drawn, options.procedural, options.thin)
            write_shard(path, samples)
            print(f"{path.name}: {sum(len(s.voxel_ijk) for s in samples)} voxels", flush=True)


if __name__ == "__main__":
    main()
