"""Training samples: windows of coarse grids with exact distances at fine query points.

    python -m export.dataset --meshes DIR --procedural 0.3 --out training/store --count 5000
    python -m export.dataset --smooth --slices 6 --margin 10 --out training/masks --count 400

A sample is one shape in one pose at one resolution. It holds a window of the coarse grid and, for
each voxel that can hold the surface, the exact distance at a set of query offsets that is drawn
anew for every sample: ``CORNERS`` nodes of the K = 4 lattice, each followed by the next node along
x, y and z (the loss takes the gradient from their differences), then some nodes of the K = 16
lattice (which includes those of 2 and 8), then some points anywhere in the voxel. Values are
rescaled (half voxels, Eqs. 4 and 5).

Samples are stored in shards as concatenated flat arrays: ``windows`` (float32) with
``window_shape``, ``offsets`` (n, Q, 3), ``voxel_ijk`` (D, 3) and ``targets`` (D, Q) float16 with
``voxel_count``. With ``margin`` a window has samples more to each side. Each mesh is used once
before any is repeated, but simple prisms are a sixth.
"""

from __future__ import annotations

import argparse
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import igl
import numpy as np
from scipy.spatial.transform import Rotation

from export.arguments import Parser, at_least, positive, share
from export.shapes.draws import draw_sway, log_uniform
from export.shapes.smooth import RADII, Field, draw_smooth, foot_points, length, settle
from export.shapes.solid import FAMILIES, random_solid
from super_sdf import Mesh
from super_sdf.errors import FileError
from super_sdf.grid.derived import BLURRED
from super_sdf.refine import band, nodes
from super_sdf.truth import Solid, read_mesh, sample_solid

CORNERS, FINE_NODES, ANYWHERE = 5, 4, 4  # queries: 4 per corner, 28 in all
SIZES = 7.0, 100.0  # voxels along a shape's diagonal
SWAYED = 0.3  # share of the meshes that are bent
THIN = -0.2, 0.6  # range of the lowest sample of a thin solid, in spacings
SLICED = 0.4  # share of samples in thick slices, if any are
WINDOW = 32  # samples along each axis: a whole shape at 32^3, a piece of it at 64^3
NEAR_MASKS = 4.0  # voxels from the surface up to which samples with a margin are exact
EDGE = 4  # samples from the border of a window of a smooth body within which none has targets
SETTLED_WITHIN = 2.5  # voxels from a smooth surface within which distances are exact ...
UNSETTLED = 0.003  # ... to so much; a window with worse ones is drawn again, as is one with ...
FEWEST = 50  # ... fewer voxels with targets
SHARD = 50  # samples per file


@dataclass(frozen=True, eq=False)
class Sample:
    """One window (nx, ny, nz), its query offsets (Q, 3), voxels (D, 3) and targets (D, Q)."""

    window: np.ndarray
    offsets: np.ndarray
    voxel_ijk: np.ndarray  # counted from the margin on
    targets: np.ndarray
    margin: int = 0  # samples beside the window, on every side, from which masks are made

    def cropped(self) -> Sample:
        """Return the sample without the margin."""
        inner = tuple(slice(self.margin, n - self.margin) for n in self.window.shape)
        return replace(self, window=self.window[inner], margin=0)


def draw_pose(
    rng: np.random.Generator, mesh: Mesh, sizes: tuple[float, float] = SIZES, slices: float = 1.0
) -> Mesh:
    """Place a shape in index space, its diagonal within ``sizes`` voxels; half of them turned.

    Some are in slices that are up to ``slices`` times as thick as a sample is wide.
    """
    turn = Rotation.random(rng=rng).as_matrix() if rng.random() < 0.5 else np.eye(3)
    size = np.exp(rng.uniform(*np.log(sizes)))
    diagonal = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    if slices > 1 and rng.random() < SLICED:
        turn = np.diag(rng.permutation([1, 1, 1 / log_uniform(rng, 1, slices)])) @ turn
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
    fine = rng.permutation(nodes.block_offsets(16))[:FINE_NODES]
    anywhere = rng.uniform(-1, 1, (ANYWHERE, 3))
    return np.concatenate([quadruples, fine, anywhere]).astype(np.float32)


def make_sample(
    rng: np.random.Generator,
    mesh: Mesh,
    sizes: tuple[float, float] = SIZES,
    slices: float = 1.0,
    lowest: tuple[float, float] = (-np.inf, np.inf),
    margin: int = 0,
) -> Sample | None:
    """Sample a shape; return None if no sample is near the surface, or all are inside.

    Also None if the lowest sample is not between the bounds ``lowest`` (in spacings). A shape so
    thin that no sample lies inside is kept: its distances reveal it.
    """
    posed = draw_pose(rng, mesh, sizes, slices)
    shape, first = draw_window(rng, posed)
    truth = Solid(posed)
    wide = tuple(n + 2 * margin for n in shape)
    exact = NEAR_MASKS if margin else None
    window = 2 * sample_solid(truth, (wide, 1.0, first - margin), band=exact).values
    inner = window[tuple(slice(margin, margin + n) for n in shape)]
    voxel_ijk = np.argwhere(np.abs(inner) <= band.DECODE_LIMIT)
    if not lowest[0] < inner.min() / 2 < lowest[1] or not len(voxel_ijk) or (inner < 0).all():
        return None
    offsets = draw_offsets(rng)
    points = (voxel_ijk[:, None] + first + offsets / 2).reshape(-1, 3)
    targets = 2 * signed_distance(rng, truth, points).reshape(len(voxel_ijk), -1)
    return Sample(window, offsets, voxel_ijk.astype(np.uint8), targets.astype(np.float16), margin)


def make_smooth_sample(rng: np.random.Generator, slices: float, margin: int = 0) -> Sample:
    """Sample a smooth body, half of them inverted, round a point of its surface."""
    sample = None
    while sample is None:
        field = draw_smooth(rng, slices)
        middle = foot_points(field, rng.normal(size=(1, 3)) * log_uniform(rng, *RADII))
        low = middle - WINDOW * rng.uniform(0.3, 0.7, (1, 3))
        sample = sample_field(rng, field, low, WINDOW, margin)
    if rng.random() < 0.5:
        return replace(sample, window=-sample.window, targets=-sample.targets)
    return sample


def sample_field(
    rng: np.random.Generator, field: Field, low: np.ndarray, size: int, margin: int = 0
) -> Sample | None:
    """Sample the exact distance to the zero of a field in a cube from ``low`` on.

    Samples near the border have no targets: a mask is not known beyond it. None if foot points are
    not certain, or hardly any sample is near the surface.
    """
    first = np.floor(low)
    wide = size + 2 * margin
    points = np.indices((wide,) * 3).reshape(3, -1).T + (first - margin)
    values, gradients = field(points)
    values /= np.maximum(length(gradients), 1e-6)
    near = np.abs(values) < SETTLED_WITHIN
    values[near], off = settle(field, points[near])
    window = 2 * values.reshape((wide,) * 3).astype(np.float32)
    inner = window[(slice(margin, margin + size),) * 3]
    voxel_ijk = np.argwhere(np.abs(inner) <= band.DECODE_LIMIT)
    voxel_ijk = voxel_ijk[(np.abs(voxel_ijk - (size - 1) / 2) < size / 2 - EDGE).all(1)]
    if len(voxel_ijk) < FEWEST or off.max() > UNSETTLED:
        return None
    offsets = draw_offsets(rng)
    targets, off = settle(field, (voxel_ijk[:, None] + first + offsets / 2).reshape(-1, 3))
    if off.max() > UNSETTLED:
        return None
    targets = 2 * targets.reshape(len(voxel_ijk), -1).astype(np.float16)
    return Sample(window, offsets, voxel_ijk.astype(np.uint8), targets, margin)


def signed_distance(rng: np.random.Generator, truth: Solid, points: np.ndarray) -> np.ndarray:
    """Return the signed distance, (n,), of points (n, 3).

    The nearest triangle gives the sign quickly, but wrongly on meshes that intersect themselves.
    So it is checked at 2,000 points by winding number; if any differs, the winding number is used
    for all points.
    """
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    distances = igl.signed_distance(points, truth.mesh.vertices, truth.mesh.faces, kind)[0]
    some = rng.integers(len(points), size=min(len(points), 2000))
    clear = np.abs(distances[some]) > 1e-4  # on the surface either sign is correct
    inside = truth.is_inside(points[some])
    if (inside == (distances[some] < 0))[clear].all():
        return distances
    return np.where(truth.is_inside(points), -np.abs(distances), np.abs(distances))


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
            margin=np.array(samples[0].margin),
        )
    part.rename(path)


def read_shard(path: Path) -> Iterator[Sample]:
    """Yield the samples of a shard; FileError if it is damaged or not a shard."""
    try:
        with np.load(path) as file:
            shard = dict(file)
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise FileError(f"{path} is not a shard: {error}; remove it and make it again") from error
    window_ends = np.cumsum(shard["window_shape"].prod(1))
    voxel_ends = np.cumsum(shard["voxel_count"])
    windows = np.split(shard["windows"], window_ends[:-1])
    voxels = np.split(shard["voxel_ijk"], voxel_ends[:-1])
    targets = np.split(shard["targets"], voxel_ends[:-1])
    margin = int(shard.get("margin", 0))
    for n, shape in enumerate(shard["window_shape"]):
        window = windows[n].reshape(shape)
        yield Sample(window, shard["offsets"][n], voxels[n], targets[n], margin)


def mesh_order(folder: Path | None, count: int, seed: int) -> list[Path]:
    """Return ``count`` files at least, or none: each mesh once before any is repeated.

    A sixth are simple prisms (under 128 faces, by file size), unless there is nothing else.
    """
    if folder is None:
        return []
    if not folder.is_dir():
        raise FileError(f"--meshes {folder} is not a folder: give one with closed .ply meshes")
    files = [file for file in sorted(folder.glob("*.ply")) if file.is_file()]
    if not files:
        raise FileError(f"--meshes {folder} has no .ply file: other formats are not read here")
    prisms = [file for file in files if file.stat().st_size < 3000]
    others = sorted(set(files) - set(prisms)) or prisms
    rng, order = np.random.default_rng(seed), list[Path]()
    while len(order) < count:
        few = [] if others is prisms else rng.permutation(prisms)[: len(others) // 5].tolist()
        order += rng.permutation([*others, *few]).tolist()
    return order


def draw_mesh(rng: np.random.Generator, path: Path) -> Mesh:
    """Read a mesh; some are bent by smooth waves, so that few faces stay flat or parallel."""
    mesh = read_mesh(path)
    if rng.random() >= SWAYED:
        return mesh
    diagonal = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    return Mesh(draw_sway(rng, 0.6)(mesh.vertices / diagonal), mesh.faces)


def fill_shard(
    rng: np.random.Generator, files: Sequence[Path], count: int, options: argparse.Namespace
) -> list[Sample]:
    """Make the samples of a shard; a procedural shape replaces a mesh without a usable sample."""
    samples: list[Sample] = []
    for number in range(count):
        thin = rng.random() < options.thin
        sample, file = None, files[number] if files and not thin else None
        if options.smooth:
            sample = make_smooth_sample(rng, options.slices, options.margin)
        elif file and rng.random() >= options.procedural:
            mesh = draw_mesh(rng, file)
            sample = make_sample(rng, mesh, options.sizes, options.slices, margin=options.margin)
        while sample is None:
            mesh = random_solid(rng, options.families)
            if thin:  # squeezed along its axes until hardly any sample lies inside
                mesh = mesh.transformed(np.diag(np.exp(rng.normal(0, 1, 3))), np.zeros(3))
            lowest = THIN if thin else (-np.inf, np.inf)
            size = options.sizes, options.slices
            sample = make_sample(rng, mesh, *size, lowest, options.margin)
        samples.append(sample)
    return samples


def parser_of_options() -> Parser:
    parser = Parser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("--meshes", type=Path, help="folder of closed .ply meshes")
    add("--procedural", type=share, default=0.3, help="share of procedural shapes beside --meshes")
    named = "families of the procedural shapes; one named twice is drawn twice as often "
    named += f"(default: all, which are {', '.join(FAMILIES)})"
    add("--families", nargs="+", choices=FAMILIES, metavar="NAME", default=(), help=named)
    add("--thin", type=share, default=0.05, help="share of thin solids")
    add("--sizes", type=positive, nargs=2, default=SIZES, help="voxels along a diagonal, from, to")
    thick = f"thickest slices, over the other spacings, of {SLICED:g} of the samples"
    add("--slices", type=positive, default=1.0, help=thick)
    beside = f"samples beside a window, on which distances of masks depend: {BLURRED} for masks"
    add("--margin", type=at_least(0), default=0, help=beside)
    add("--smooth", action="store_true", help="smooth bodies, in shards of their own")
    add("--out", type=Path, required=True, help="folder for the shards")
    add("--count", type=at_least(1), default=5000, help="samples to make")
    add("--seed", type=at_least(0), default=0)
    return parser


def main(words: Sequence[str] | None = None) -> None:
    """Fill a store; existing shards are kept."""
    parser = parser_of_options()
    options = parser.parse_args(words)
    kind = "smooth" if options.smooth else "shard"
    with parser.one_line_errors():
        files = mesh_order(options.meshes, options.count + SHARD, options.seed)
        options.out.mkdir(parents=True, exist_ok=True)
        for start in range(0, options.count, SHARD):
            number, count = start // SHARD, min(SHARD, options.count - start)
            path = options.out / f"{kind}-{options.seed}-{number:04d}.npz"
            if not path.exists():
                rng = np.random.default_rng([options.seed, number])
                write_shard(path, fill_shard(rng, files[start : start + count], count, options))
                print(path.name, flush=True)


if __name__ == "__main__":
    main()
