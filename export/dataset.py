"""Training samples: windows of coarse grids with exact distances at fine query points.

    python -m export.dataset --meshes DIR --procedural 0.3 --out training/store --count 5000
    python -m export.dataset --families sculpture creature --out training/store --seed 9

A sample is one shape in one pose at one resolution. It holds a window of the coarse grid and, for
each voxel that can hold the surface, the exact distance at a set of query offsets that is drawn
anew for every sample: ``CORNERS`` nodes of the K = 4 lattice, each followed by the next node along
x, y and z (the loss takes the gradient from their differences), then some nodes of the K = 16
lattice (which includes those of 2 and 8), then some points anywhere in the voxel. Values are
rescaled (half voxels, Eqs. 4 and 5).

Samples are stored in shards, ``shard-<seed>-<number>.npz``, as concatenated flat arrays:
``windows`` (float32) with ``window_shape``, ``offsets`` (n, Q, 3), ``voxel_ijk`` (D, 3) and
``targets`` (D, Q) float16 with ``voxel_count``. Without ``--meshes`` all shapes are procedural.
With it, each mesh is used once before any is repeated, except that simple prisms are limited to a
sixth, and ``--procedural`` is the share of procedural shapes among them. A share ``--thin`` of the
samples are of solids so thin that hardly any sample lies inside.
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
from export.shapes.draws import draw_sway
from export.shapes.solid import FAMILIES, random_solid
from super_sdf import Mesh, SdfGrid
from super_sdf.errors import FileError
from super_sdf.files.regular import check_regular_file
from super_sdf.refine.band import DECODE_LIMIT, find_band, rescale
from super_sdf.refine.nodes import block_offsets
from super_sdf.truth.mesh_files import read_mesh
from super_sdf.truth.sampling import sample_grid
from super_sdf.truth.solid import Solid

CORNERS, FINE_NODES, ANYWHERE = 5, 4, 4  # queries: 4 per corner, 28 in all
SIZES = 7.0, 100.0  # voxels along a shape's diagonal
SWAYED = 0.3  # share of the meshes that are bent
THIN = -0.2, 0.6  # range of the lowest sample of a thin solid, in spacings
WINDOW = 32  # samples along each axis: a whole shape at 32^3, a piece of it at 64^3
SHARD = 50  # samples per file


@dataclass(frozen=True, eq=False)
class Sample:
    """One window (nx, ny, nz), its query offsets (Q, 3), voxels (D, 3) and targets (D, Q)."""

    window: np.ndarray
    offsets: np.ndarray
    voxel_ijk: np.ndarray
    targets: np.ndarray


def draw_pose(rng: np.random.Generator, mesh: Mesh, sizes: tuple[float, float] = SIZES) -> Mesh:
    """Place a shape in index space, its diagonal within ``sizes`` voxels; half of them turned."""
    turn = Rotation.random(rng=rng).as_matrix() if rng.random() < 0.5 else np.eye(3)
    size = np.exp(rng.uniform(*np.log(sizes)))
    diagonal = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    posed = mesh.transformed(turn * size / diagonal, np.zeros(3))
    low = posed.vertices.min(0)
    return posed.transformed(np.eye(3), rng.uniform(2, 3, 3) - low)


def draw_window(rng: np.random.Generator, mesh: Mesh) -> tuple[tuple[int, int, int], np.ndarray]:
    """Return shape and first sample of a window: the whole shape, or a piece around a vertex."""
    whole = np.ceil(mesh.vertices.max(0)).astype(int) + 3
    shape = np.minimum(whole, WINDOW)
    middle = mesh.vertices[rng.integers(len(mesh.vertices))]
    first = np.clip(np.floor(middle - shape / 2), 0, whole - shape)
    return tuple(int(n) for n in shape), first


def draw_offsets(rng: np.random.Generator) -> np.ndarray:
    """Return the query offsets of a sample, (Q, 3) in [-1, 1]: see the module's docstring."""
    corners = rng.integers(0, 4, (CORNERS, 3)) / 2 - 1
    steps = np.concatenate([np.zeros((1, 3)), np.eye(3)]) / 2
    quadruples = (corners[:, None] + steps).reshape(-1, 3)
    fine = rng.permutation(block_offsets(16))[:FINE_NODES]
    anywhere = rng.uniform(-1, 1, (ANYWHERE, 3))
    return np.concatenate([quadruples, fine, anywhere]).astype(np.float32)


def make_sample(
    rng: np.random.Generator,
    mesh: Mesh,
    lowest: tuple[float, float] = (-np.inf, np.inf),
    sizes: tuple[float, float] = SIZES,
) -> Sample | None:
    """Sample a shape; return None if no sample is near the surface, or all are inside.

    Also None if the lowest sample is not between the bounds ``lowest`` (in spacings). A shape so
    thin that no sample lies inside is kept: its distances reveal it.
    """
    posed = draw_pose(rng, mesh, sizes)
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
    """Return the signed distance, (n,), of points (n, 3).

    The nearest triangle gives the sign quickly, but wrongly on meshes that intersect themselves.
    So it is checked at 2,000 points by winding number; if any differs, the winding number is used
    for all points.
    """
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    distances = igl.signed_distance(points, solid.mesh.vertices, solid.mesh.faces, kind)[0]
    some = rng.integers(len(points), size=min(len(points), 2000))
    clear = np.abs(distances[some]) > 1e-4  # on the surface either sign is correct
    inside = solid.is_inside(points[some])
    if (inside == (distances[some] < 0))[clear].all():
        return distances
    return np.where(solid.is_inside(points), -np.abs(distances), np.abs(distances))


def write_shard(path: Path, samples: list[Sample]) -> None:
    """Write a shard; the file is complete or absent."""
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
    """Yield the samples of a shard; FileError if it is damaged or not a shard."""
    try:
        with np.load(check_regular_file(path)) as file:
            shard = dict(file)
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise FileError(f"{path} is not a shard: {error}; remove it and make it again") from error
    window_ends = np.cumsum(shard["window_shape"].prod(1))
    voxel_ends = np.cumsum(shard["voxel_count"])
    windows = np.split(shard["windows"], window_ends[:-1])
    voxels = np.split(shard["voxel_ijk"], voxel_ends[:-1])
    targets = np.split(shard["targets"], voxel_ends[:-1])
    for n, shape in enumerate(shard["window_shape"]):
        yield Sample(windows[n].reshape(shape), shard["offsets"][n], voxels[n], targets[n])


def find_meshes(folder: Path | None) -> tuple[list[Path], list[Path]]:
    """Return the files of simple prisms (under 128 faces, by file size) and all others."""
    if folder is None:
        return [], []
    if not folder.is_dir():
        raise FileError(f"--meshes {folder} is not a folder: give one with closed .ply meshes")
    files = [check_regular_file(file) for file in sorted(folder.glob("*.ply"))]
    if not files:
        raise FileError(f"--meshes {folder} has no .ply file: other formats are not read here")
    prisms = [file for file in files if file.stat().st_size < 3000]
    return prisms, sorted(set(files) - set(prisms))


def mesh_order(seed: int, prisms: list[Path], others: list[Path], count: int) -> list[Path]:
    """Return ``count`` files: each mesh once before any is repeated, a sixth of them prisms.

    If there are only prisms, all files are.
    """
    rng = np.random.default_rng(seed)
    others, prisms = (others, prisms) if others else (prisms, [])
    order: list[Path] = []
    while others and len(order) < count:
        few = rng.permutation(prisms)[: len(others) // 5].tolist()
        order += rng.permutation([*others, *few]).tolist()
    return order


def draw_mesh(rng: np.random.Generator, path: Path) -> Mesh:
    """Read a mesh; some are bent by smooth waves, so that few faces stay flat or parallel."""
    mesh = read_mesh(path)
    if rng.random() >= SWAYED:
        return mesh
    diagonal = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    return Mesh(draw_sway(rng, 0.6)(mesh.vertices / diagonal), mesh.faces)


def make_thin_sample(rng: np.random.Generator, families: Sequence[str] = ()) -> Sample:
    """Squeeze random procedural shapes along their axes until one is thin in its window."""
    sample = None
    while sample is None:
        solid = random_solid(rng, families)
        squeezed = solid.transformed(np.diag(np.exp(rng.normal(0, 1, 3))), np.zeros(3))
        sample = make_sample(rng, squeezed, THIN)
    return sample


def fill_shard(
    rng: np.random.Generator,
    files: Sequence[Path],
    procedural: float,
    thin: float,
    count: int = SHARD,
    families: Sequence[str] = (),
) -> list[Sample]:
    """Make the samples of a shard; a procedural shape replaces a mesh without a usable sample."""
    samples: list[Sample] = []
    for number in range(count):
        if rng.random() < thin:
            samples.append(make_thin_sample(rng, families))
            continue
        drawn = not files or rng.random() < procedural
        sample = make_sample(
            rng, random_solid(rng, families) if drawn else draw_mesh(rng, files[number])
        )
        while sample is None:
            sample = make_sample(rng, random_solid(rng, families))
        samples.append(sample)
    return samples


def main() -> None:
    """Fill a store; existing shards are kept."""
    parser = Parser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("--meshes", type=Path, help="folder of closed .ply meshes")
    add("--procedural", type=share, default=0.3, help="share of procedural shapes beside --meshes")
    named = "families of the procedural shapes; one named twice is drawn twice as often "
    named += f"(default: all, which are {', '.join(FAMILIES)})"
    add("--families", nargs="+", choices=FAMILIES, metavar="NAME", default=(), help=named)
    add("--thin", type=share, default=0.05, help="share of thin solids")
    add("--out", type=Path, required=True, help="folder for the shards")
    add("--count", type=at_least(1), default=5000, help="samples to make")
    add("--seed", type=at_least(0), default=0)
    options = parser.parse_args()
    with parser.one_line_errors():
        fill_store(options)


def fill_store(options: argparse.Namespace) -> None:
    files = mesh_order(options.seed, *find_meshes(options.meshes), options.count + SHARD)
    options.out.mkdir(parents=True, exist_ok=True)
    for number in range(-(-options.count // SHARD)):
        path = options.out / f"shard-{options.seed}-{number:04d}.npz"
        if not path.exists():
            rng = np.random.default_rng([options.seed, number])
            drawn = files[number * SHARD : (number + 1) * SHARD]
            shares = options.procedural, options.thin
            samples = fill_shard(rng, drawn, *shares, families=options.families)
            write_shard(path, samples)
            print(f"{path.name}: {sum(len(s.voxel_ijk) for s in samples)} voxels", flush=True)


if __name__ == "__main__":
    main()
