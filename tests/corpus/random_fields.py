"""Random fields of 2 to 16 samples a side, and whether their meshes are closed manifolds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from unittest import mock

import numpy as np
from conftest import count_fans

from super_sdf import Mesh, SdfGrid, pipeline, reconstruct
from super_sdf.convert import Tally
from super_sdf.surface.mesh import join_meshes
from super_sdf.network.network import Network
from super_sdf.options import DEFAULT_MESHER
from super_sdf.pipeline import Decoder
from super_sdf.progress import Stopwatch
from super_sdf.slabs import preparing
from super_sdf.slabs.cutting import cut, equal_parts
from super_sdf.slabs.preparing import Piece
from super_sdf.surface.marching import CAP_HEIGHT
from super_sdf.refine.survey import look_at_band

from .case import ball, rng_of

MOST_SAMPLES = 300


@dataclass(frozen=True)
class RandomField:
    """A field, and how its surface is asked for."""

    name: str
    values: np.ndarray
    factor: int
    cap: bool


def make_fields(count: int, seed: int = 0) -> Iterator[RandomField]:
    """Yield so many fields; the same for the same seed."""
    for number in range(count):
        rng = rng_of(f"field-{number}", seed)
        shape = _draw_shape(rng)
        kind = list(KINDS)[number % len(KINDS)]
        values = KINDS[kind](rng, shape).astype(np.float32)
        values.flat[0], values.flat[-1] = 1, -1  # both sides, whatever the rest
        factor, cap = (2, 4)[number // 2 % 2], bool(number % 2)
        name = f"{number}: {kind} {shape}, factor {factor}{', cap' * cap}"
        yield RandomField(name, values, factor, cap)


def _draw_shape(rng: np.random.Generator) -> tuple[int, ...]:
    shape = rng.integers(2, 17, 3)
    while shape.prod() > MOST_SAMPLES:
        shape[shape.argmax()] = rng.integers(2, shape.max())
    return tuple(map(int, rng.permutation(shape)))


KINDS = {
    "normal": lambda rng, shape: rng.normal(size=shape),
    "large": lambda rng, shape: rng.normal(size=shape) * 10,
    "clamped": lambda rng, shape: np.clip(rng.normal(size=shape), -0.4, 0.4),
    "half-integer": lambda rng, shape: rng.integers(-3, 4, shape) / 2,
    "exact zeros": lambda rng, shape: rng.normal(size=shape) * (rng.random(shape) < 0.5),
    "mostly zeros": lambda rng, shape: rng.choice([-1, 0, 0, 0, 0, 1], shape),
    "signs": lambda rng, shape: rng.choice([-1.0, 1.0], shape),
    "clamped ball": lambda rng, shape: np.clip(ball(shape, rng.uniform(0.2, 0.6)), -0.5, 0.5),
    "rounded ball": lambda rng, shape: np.round(ball(shape, rng.uniform(0.2, 0.6)) * 2) / 2,
    "noisy ball": lambda rng, shape: ball(shape) + rng.uniform(-0.5, 0.5, shape),
    "facets": lambda rng, shape: facets(rng, shape),
    "clamped facets": lambda rng, shape: np.clip(facets(rng, shape), -0.5, 0.5),
    "rounded facets": lambda rng, shape: np.round(facets(rng, shape) * 2) / 2,
    "denormal": lambda rng, shape: rng.normal(size=shape) * rng.choice([1, 1e-44], shape),
}


def facets(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return a field of planes that meet in edges and corners, convex and concave.

    Inside it is the largest or the smallest of distances to planes: their slope is 1.
    """
    normals = rng.normal(size=(2, 3, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    middle = (np.array(shape) - 1) / 2 + rng.normal(size=3)
    along = normals @ (np.indices(shape).reshape(3, -1) - middle[:, None])
    first, second = (along - rng.uniform(0, 0.3 * max(shape), (2, 3, 1))).max(1)
    return (np.minimum(first, second) if rng.random() < 0.5 else first).reshape(shape)


def faults_of_field(
    field: RandomField, network: Decoder, mesher: str = DEFAULT_MESHER
) -> list[str]:
    """Return what is wrong with a field's mesh: see ``faults_of_mesh``."""
    return faults_of_mesh(field, mesh_of_field(field, network, mesher))


def mesh_of_field(field: RandomField, network: Decoder, mesher: str) -> Mesh:
    """Return a field's mesh."""
    grid = SdfGrid.trusted(field.values, 1.0)  # they are no distances, and need not be
    return reconstruct(grid, network, field.factor, cap=field.cap, mesher=mesher)


def faults_of_pieces(
    field: RandomField, network: Network, mesher: str, parts: int, whole: Mesh
) -> list[str]:
    """Return what is wrong with a field's mesh that is made in slabs, and in bricks.

    The running count of open edges must agree with that of the ``whole`` mesh, which both are.
    """
    faults = []
    for made_in, make in (("slabs", in_slabs), ("bricks", in_bricks)):
        tally = Tally(field.cap)
        mesh = join_meshes(list(tally.count(make(field, network, mesher, parts), Stopwatch())))
        if not np.array_equal(mesh.faces, whole.faces):
            faults.append(f"{parts} {made_in} make another mesh")
        if 2 * len(tally.edges) != mesh.open_edges():  # which counts each from both sides
            faults.append(f"{len(tally.edges)} open edges in {parts} {made_in}: miscounted")
    return [f"{field.name}: {fault}" for fault in faults]


def in_slabs(field: RandomField, network: Network, mesher: str, parts: int) -> Iterator[Piece]:
    """Yield a field's mesh in at most ``parts`` slabs."""

    def plan(band, factor, reach, resources, needed, mesher):
        return cut(band, parts, reach, mesher.planes_beside(factor))

    grid = SdfGrid.trusted(field.values, 1.0)
    with mock.patch.object(preparing, "plan_slabs", plan):
        yield from pipeline.reconstruct_slabs(
            grid, network, field.factor, cap=field.cap, mesher=mesher
        )


def in_bricks(field: RandomField, network: Network, mesher: str, parts: int) -> Iterator[Piece]:
    """Yield a field's mesh in at most ``parts`` bricks, as a cluster puts them together."""
    grid = SdfGrid.trusted(field.values, 1.0)
    seen = look_at_band(grid, 0.0)
    bricks = (
        pipeline.reconstruct_planes(
            grid, network, field.factor, planes, whole=seen.summary, cap=field.cap, mesher=mesher
        )
        for planes in equal_parts(np.append(0, np.cumsum(seen.decoded)), parts)
    )
    yield from joined((Meshed(list(brick), "here:1", None, None) for brick in bricks), seen)


def faults_of_mesh(field: RandomField, mesh: Mesh) -> list[str]:
    """Return what is wrong with a mesh: holes, edges or vertices of two surfaces, no numbers."""
    faults = []
    if not np.isfinite(mesh.vertices).all():
        faults.append("vertices are not finite")
    if len(np.unique(mesh.vertices, axis=0)) < len(mesh.vertices):
        faults.append("vertices at the same position")
    if len(np.unique(np.sort(mesh.faces, axis=1), axis=0)) < len(mesh.faces):
        faults.append("triangles with the same corners")
    beyond = np.maximum(-0.5 - mesh.vertices, mesh.vertices - np.array(field.values.shape) + 0.5)
    if beyond.max() > CAP_HEIGHT / field.factor + 1e-4:
        faults.append(f"vertices are {beyond.max():.3f} samples outside the grid")
    inner, border = open_edges(mesh, field.values.shape)
    if inner or (field.cap and border):
        faults.append(f"{inner} open edges within the grid, {border} at its border")
    elif not border and (count_fans(mesh.faces) != 1).any():
        faults.append("surfaces share a vertex")
    return [f"{field.name}: {fault}" for fault in faults]


def open_edges(mesh: Mesh, shape: tuple[int, ...]) -> tuple[int, int]:
    """Count edges without a partner: within the grid's box, and in its faces.

    The fine lattice ends half a voxel beyond the outer samples; there a surface may run out.
    """
    size = len(mesh.vertices)
    start, end = mesh.faces.ravel().astype(np.int64), np.roll(mesh.faces, -1, axis=1).ravel()
    lonely = np.setxor1d(start * size + end, end * size + start)
    ends = mesh.vertices[np.stack([lonely // size, lonely % size])]
    in_face = (np.abs(ends + 0.5) < 1e-3) | (np.abs(ends - np.array(shape) + 0.5) < 1e-3)
    at_border = in_face.all(0).any(1)
    return int((~at_border).sum()), int(at_border.sum())
