"""Shapes, and cases: a shape sampled on a grid, with the exact distances on the fine lattice.

Shapes are centred on their bounding boxes and scaled to a box diagonal of 1. All lengths are in
that unit.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from super_sdf.arrays import BoolArray, FloatArray, IntArray
from super_sdf.errors import FileError, OptionError, seen
from super_sdf.evaluation import Sampled, frame_of
from super_sdf.files.meshes import MESH_SUFFIXES
from super_sdf.grid.sdf_grid import SdfGrid, make_grid
from super_sdf.options import OPTIONS
from super_sdf.refine.band import is_active, rescale
from super_sdf.surface.mesh import Mesh
from super_sdf.truth import Distances, Solid, load_solid, sample_solid

NOISE, TURN, FIELD_NOISE = 3, 5, 6  # streams of random numbers, beside those of ``Sampled``
LARGEST_SIZE = 100_000  # samples along an axis; a larger grid fits into no memory
SUFFIXES = (*MESH_SUFFIXES, ".gltf")


@dataclass(frozen=True)
class Setting:
    """How a shape is sampled and refined."""

    size: int  # samples along each axis; 0 where nothing is sampled (the floor)
    factor: int = 4
    noise: float = 0.0  # amplitude of the uniform noise on the samples, in half voxels
    scale: float = 0.0  # longest side of the box over the grid's; 0: the grid's is the diagonal

    def check(self) -> None:
        OPTIONS["factor"].check(self.factor)
        if not 4 <= self.size <= LARGEST_SIZE:
            raise OptionError(f"size is {seen(self.size)}: give 4 to {LARGEST_SIZE:,} samples")

    def __str__(self) -> str:
        parts = {"noise": self.noise, "scale": self.scale}
        more = "".join(f", {name} {value:g}" for name, value in parts.items() if value)
        return f"{self.size}^3, factor {self.factor}{more}" if self.size else "reference"


class Shape(Sampled):
    """A reference mesh in its frame, and the points that are drawn from it for all methods."""

    def __init__(self, name: str, mesh: Mesh) -> None:
        self.name = name
        super().__init__(mesh, name_seed(name))
        self.pieces = self.mesh.components()[0]

    @classmethod
    def read(cls, path: Path, turned: int | None = None) -> Shape:
        """Return the shape of a mesh file, named after the file.

        With a seed ``turned`` it is turned at random, the same way for the same seed and name,
        before it is put into the frame.
        """
        mesh = load_solid(path)[0].mesh
        turn = np.eye(3) if turned is None else turn_of(path.stem, turned)
        return cls(path.stem, normalise(mesh.transformed(turn, np.zeros(3))))


def normalise(mesh: Mesh) -> Mesh:
    """Return a mesh, float64, centred on its bounding box and scaled to a box diagonal of 1."""
    return mesh.transformed(*frame_of(mesh))


def name_seed(name: str, *stream: int) -> tuple[int, ...]:
    return zlib.crc32(name.encode(errors="surrogateescape")), *stream


def turn_of(name: str, seed: int) -> NDArray[np.float64]:
    """Return the rotation matrix, (3, 3), by which a seed turns the shape of a name.

    All rotations are equally likely: it is that of a random quaternion.
    """
    quaternion = np.random.default_rng((seed, *name_seed(name, TURN))).normal(size=4)
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


class Case:
    """A shape sampled in a setting.

    The fields of the baselines and the truth are dense, so they must fit into memory.
    """

    def __init__(self, shape: Shape, setting: Setting) -> None:
        self.triangles: dict[str, int] = {}
        self.shape, self.setting, self.factor = shape, setting, setting.factor
        longest = float(np.ptp(shape.mesh.vertices, axis=0).max())
        self.side = longest / setting.scale if setting.scale else 1.0
        self.low = -self.side / 2
        n, origin = setting.size, np.full(3, (0.5 / setting.size - 0.5) * self.side)
        self.spacing = self.side / n
        self.fine = self.spacing / self.factor
        layout = (n, n, n), self.spacing, origin
        self.coarse = sample_solid(shape.solid, layout, band=np.inf).values
        values = self.coarse.astype(np.float32)
        if setting.noise:
            random = np.random.default_rng((*shape.seed, NOISE))
            noise = random.uniform(-1, 1, self.coarse.shape) * setting.noise * self.spacing / 2
            values = (self.coarse + noise).astype(np.float32)
        self.grid = SdfGrid.trusted(values, self.spacing, origin)

    @cached_property
    def recognised(self) -> SdfGrid:
        """The grid as super-sdf takes it from a file of a user: noise is recognised."""
        if not self.setting.noise:
            return self.grid
        values, origin = np.asarray(self.grid.values), self.grid.origin
        return make_grid(values, spacing=self.spacing, origin=origin, inside="negative")

    @cached_property
    def voxels(self) -> IntArray:
        """Voxels of the band of the exact distances (Eq. 2), (V, 3)."""
        rescaled = rescale(SdfGrid.trusted(self.coarse, self.spacing))
        return np.argwhere(is_active(rescaled)).astype(np.int32)

    @cached_property
    def band(self) -> BoolArray:
        """Mask of the fine nodes in the blocks of the band, faces included, (K n + 1)^3."""
        active = np.zeros(self.coarse.shape, bool)
        active[tuple(self.voxels.T)] = True
        return spread_to_nodes(active, self.factor)

    @cached_property
    def truth(self) -> FloatArray:
        """Signed distances at the fine nodes, (K n + 1)^3.

        They are exact in the band and at every cell that the surface may cross: a node of such a
        cell is within sqrt(3) h/K of the surface, so the sample of its block is within sqrt(3)
        (1/2 + 1/K) h. Elsewhere they are the nearest sample, which has the right sign.
        """
        factor, coarse = self.factor, self.coarse
        reach = 3**0.5 * (0.5 + 1 / factor) * self.spacing
        nearest = [np.minimum(np.arange(factor * n + 1) // factor, n - 1) for n in coarse.shape]
        field = coarse[np.ix_(*nearest)]
        nodes = np.argwhere(self.band | spread_to_nodes(np.abs(coarse) < reach, factor))
        samples = np.minimum(nodes // factor, self.setting.size - 1)
        apart = np.linalg.norm(nodes - factor * (samples + 0.5), axis=1) * self.fine
        points, known = nodes * self.fine + self.low, coarse[tuple(samples.T)]
        field[tuple(nodes.T)] = signed_from_samples(self.shape.solid, points, known, apart)
        return field


def spread_to_nodes(voxels: BoolArray, factor: int) -> BoolArray:
    """Return the mask of the fine nodes, (K n + 1)^3, in the blocks of a mask of voxels, n^3."""
    for axis in range(3):
        source = np.moveaxis(voxels, axis, 0)
        target = np.zeros((factor * len(source) + 1, *source.shape[1:]), bool)
        for offset in range(factor + 1):
            target[offset : offset + factor * (len(source) - 1) + 1 : factor] |= source
        voxels = np.moveaxis(target, 0, axis)
    return voxels


def signed_from_samples(
    solid: Solid, points: NDArray[Any], known: FloatArray, apart: NDArray[Any]
) -> Distances:
    """Return the signed distances of points, (n,), negative inside.

    The balls round the two points with their distances as radii hold no surface. If they overlap,
    both points have the same sign. Only for the others the winding number is computed.
    """
    distance = solid.distance(points)
    inside = known < 0
    unsure = distance + np.abs(known) < apart * (1 + 1e-6)
    inside[unsure] = solid.is_inside(points[unsure])
    return np.where(inside, -distance, distance)


def find_meshes(sources: Sequence[Path]) -> tuple[Path, ...]:
    """Return the given mesh files, and those in the given folders, sorted by name."""
    paths: list[Path] = []
    for source in sources:
        inside = [source]
        if source.is_dir():
            inside = sorted(p for p in source.iterdir() if p.suffix.lower() in SUFFIXES)
        if not inside:
            raise FileError(f"{source} holds no mesh: give {', '.join(SUFFIXES)}")
        paths += inside
    names = [path.stem for path in paths]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise FileError(f"two meshes are named {twice!r}: shapes are known by their file names")
    return tuple(paths)


def spread(items: Sequence[Any], count: int) -> tuple[Any, ...]:
    """Return ``count`` of the items, evenly spread over them."""
    count = min(count, len(items))
    return tuple(items[i * len(items) // count] for i in range(count))
