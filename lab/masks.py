"""Masks and labels beside other tools: scenes, what each tool makes of them, and how near that is.

``PEERS`` is the table of methods. The unit of length is the spacing within a slice.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from super_sdf import Mesh, make_grid, reconstruct
from super_sdf.evaluation import sample_surface
from super_sdf.labels.reconstruct import reconstruct_labels
from super_sdf.options import DEFAULT_QUALITY
from super_sdf.truth import Solid

from .measuring import network_of
from .rows import Row
from .shapes import Shape, name_seed, turn_of
from .surfaces import closed_isosurface, stretched

Array = NDArray[Any]
Meshes = dict[int, Mesh]
Field = Callable[[Array], Array]
Form = tuple[ArrayLike, ArrayLike, ArrayLike]
"""Start and end of a capsule, and its radius, or three. A ball starts and ends at one point."""

RATIOS = (1, 5)  # the distance of slices over the spacing within
RADII, CENTRES = (8, 16, 28), 3  # of the balls, and how many positions each has
SIZE, FEW = 48, 6  # samples along the box diagonal of meshes, and how many parts there are
ORGANIC = ("cow", "os-koala", "os-spot", "p2m-cat", "pmp-bunny", "pmp-elephant")
REACH, NODES = 40, 3_000_000  # of forms from the origin, and of the lattice that finds a surface
POINTS, DEEP = 10_000, 3  # on a surface; how deep, beyond a slice, gaps are searched
PLACE, TURN = 7, 0  # stream of random positions, and the seed of random turns
ZERO = (0, 0, 0)
VESSELS: tuple[Form, ...] = (
    ((0, 0, -26), (0, 0, -4), 3), ((0, 0, -4), (11, 0, 11), 2.4), ((0, 0, -4), (-11, 0, 11), 2.4),
    ((11, 0, 11), (16, 9, 24), 1.9), ((11, 0, 11), (17, -9, 22), 1.9),
    ((-11, 0, 11), (-18, 0, 25), 1.9), ((-11, 0, 11), (-10, 12, 20), 1.5),
)  # fmt: skip
# Later labels take from those before: a body, an organ in it with a lesion, another beside it, two
# vessels, one of which leaves the body, and two organs that touch the body from outside.
LABELS: tuple[Form, ...] = (
    (ZERO, ZERO, (28, 22, 20)), ((-9, 1, 0), (-9, 1, 0), 11), ((-8, 3, 2), (-8, 3, 2), 5),
    ((8, 4, 1), (8, 4, 1), 8), ((-4, -24, -4), (13, 14, 7), 2.5), ((-14, -9, -9), (11, -11, -8), 3),
    ((30, 1, 0), (30, 1, 0), (7, 13, 12)), ((26, 16, 2), (26, 16, 2), 6),
)  # fmt: skip


class Scene(NamedTuple):
    """Surfaces of a set; the first is that of label 1."""

    set: str
    name: str
    surfaces: tuple[Callable[[], Mesh], ...]


def scenes(shapes: Sequence[Path], parts: Sequence[Path]) -> Iterator[Scene]:
    forms = [(f"balls of {radius}", f"ball-{radius}-{n}", union([(ZERO, ZERO, radius)]))
             for radius in RADII for n in range(CENTRES)]  # fmt: skip
    forms += [
        ("ellipsoid, torus", "ellipsoid", union([(ZERO, ZERO, (24, 16, 10))])),
        ("ellipsoid, torus", "torus", lambda p: (
            np.hypot(np.hypot(p[..., 0], p[..., 1]) - 18, p[..., 2]) - 7)),
        ("vessels", "vessels", union(VESSELS)),
    ]  # fmt: skip
    for title, name, form in forms:
        yield Scene(title, name, (partial(surface_of, form),))
    organic = [path for path in shapes if path.stem in ORGANIC]
    for title, paths in (("organic shapes", organic), ("CAD parts", parts[:FEW])):
        for path in paths:
            yield Scene(title, path.stem, (lambda p=path: stretched(Shape.read(p).mesh, SIZE, 0),))
    carved = [union([form], without=LABELS[n:]) for n, form in enumerate(LABELS, 1)]
    yield Scene("labels", "labels", tuple(partial(surface_of, form) for form in carved))


def union(forms: Sequence[Form], without: Sequence[Form] = ()) -> Field:
    """Return a field, 0 on the surface of a union less others and negative in it."""

    def field(points: Array) -> Array:
        outer = np.min([capsule(*form, points) for form in forms], 0)
        return np.max([outer, *(-capsule(*form, points) for form in without)], 0)

    return field


def capsule(start: ArrayLike, end: ArrayLike, radius: ArrayLike, points: Array) -> Array:
    along, apart = np.subtract(end, start) / radius, np.subtract(points, start) / radius
    share = np.clip(apart @ along / (along @ along or 1), 0, 1)
    off = np.linalg.norm(apart - share[..., None] * along, axis=-1) - 1
    return off * np.min(radius)


def surface_of(field: Field) -> Mesh:
    """Return the true surface, by marching cubes of a fine lattice in its box."""
    coarse = np.stack(np.indices([REACH] * 3), -1) * 2.0 - REACH
    near = coarse[field(coarse) < 2]
    low, high = near.min(0) - 2, near.max(0) + 2
    step = float((high - low).prod() / NODES) ** (1 / 3)
    x, y, z = (np.arange(*ends, step) for ends in zip(low, high))
    values = field(np.stack(np.meshgrid(x, y, z, indexing="ij"), -1))
    return closed_isosurface(values.astype(np.float32), step, low)


@lru_cache(maxsize=1)
def solids_of(scene: Scene) -> list[Solid]:
    """Return the solids of a scene, turned at random."""
    turn = turn_of(scene.name, TURN)
    return [Solid(make().transformed(turn, np.zeros(3))) for make in scene.surfaces]


@lru_cache(maxsize=1)
def image_of(scene: Scene, ratio: float) -> tuple[Array, Array, Array]:
    """Return the labels of samples, their spacing, and the position of sample (0, 0, 0)."""
    vertices = np.concatenate([solid.mesh.vertices for solid in solids_of(scene)])
    spacing = np.array([1, 1, ratio], float)
    random = np.random.default_rng(name_seed(scene.name, PLACE)).random(3)
    first = vertices.min(0) - (2 + random) * spacing
    shape = np.ceil((vertices.max(0) - first) / spacing).astype(int) + 3
    points = first + np.stack(np.indices(shape), -1).reshape(-1, 3) * spacing
    image = np.zeros(shape, np.int16)
    for label, solid in enumerate(solids_of(scene), 1):
        image[solid.is_inside(points).reshape(shape)] = label
    return image, spacing, first


# The methods: of an image and its spacing each makes a mesh of every label.


def marching(image: Array, spacing: Array) -> Meshes:
    fields = {label: np.where(image == label, -1, 1) for label in range(1, image.max() + 1)}
    return {label: closed_isosurface(field, spacing, 0) for label, field in fields.items()}


def surface_nets(image: Array, spacing: Array) -> Meshes:
    """Mesh all labels at once by VTK's SurfaceNets3D, as it smooths by default."""
    import pyvista
    import vtk

    nets, grid, count = vtk.vtkSurfaceNets3D(), pyvista.wrap(image), int(image.max())
    grid.spacing = spacing
    nets.SetInputData(grid)
    nets.GenerateLabels(count, 1, count)
    nets.SetOutputMeshTypeToTriangles()
    nets.Update()
    found = pyvista.wrap(nets.GetOutput())
    faces, (one, other) = found.regular_faces.astype(np.int32), found["BoundaryLabels"].T
    sides = {n: [faces[one == n], faces[other == n, ::-1]] for n in range(1, count + 1)}
    return {n: Mesh(found.points, np.concatenate(both)) for n, both in sides.items()}


def slicer(image: Array, spacing: Array, *, factor: float) -> Meshes:
    """Mesh each label as 3D Slicer: flying edges, then WindowedSinc, both in units of samples."""
    import pyvista

    meshes, smoothing = {}, {"n_iter": int(20 + 40 * factor), "pass_band": 10 ** (-4 * factor)}
    smoothing |= dict.fromkeys(("non_manifold_smoothing", "normalize_coordinates"), True)
    for label in range(1, image.max() + 1):
        mask = (image == label).astype(np.float32)
        edges = pyvista.wrap(mask).contour([0.5], compute_normals=False, method="flying_edges")
        found = edges.smooth_taubin(**smoothing, boundary_smoothing=False)
        mesh = Mesh(found.points.astype(float), found.regular_faces.astype(np.int32))
        meshes[label] = stretched(mesh, spacing, 0)
    return meshes


def serra(image: Array, spacing: Array, **options: Any) -> Meshes:
    import serra_mesh

    mesher = serra_mesh.Mesher(voxel_resolution=list(spacing), **options)
    mesher.mesh(image.astype(np.uint32))
    found = {label: mesher.get(label) for label in range(1, image.max() + 1)}
    return {n: Mesh(mesh.vertices, mesh.faces.astype(np.int32)) for n, mesh in found.items()}


def ours(image: Array, spacing: Array, *, keep_volume: bool = False) -> Meshes:
    network, placed = network_of(DEFAULT_QUALITY, "auto", 0), {"spacing": spacing, "origin": ZERO}
    if image.max() == 1 and not keep_volume:
        return {1: reconstruct(make_grid(image > 0, **placed), network)}
    return reconstruct_labels(image, network=network, keep_volume=keep_volume, **placed)


PEERS: dict[str, Callable[[Array, Array], Meshes]] = {
    "mc": marching,
    "surfacenets": surface_nets,
    **{f"slicer-{factor:g}": partial(slicer, factor=factor) for factor in (0.3, 0.5, 0.7)},
    "serra": serra,
    "serra-faired": partial(serra, fairing=20, fairing_taubin=True),
    "ours": ours,
    "ours-volume": partial(ours, keep_volume=True),
}


def measure(scene: Scene, method: str, ratio: float) -> Row:
    """Return means and sums over labels, and processor seconds.

    "gaps" and "overlaps" are the shares of points within a voxel of the walls between labels that
    are in none of the meshes, and in several.
    """
    image, spacing, first = image_of(scene, ratio)
    for _ in range(2):  # the first run imports what the method needs
        clock = time.process_time()
        meshes = PEERS[method](image, spacing)
        seconds = time.process_time() - clock
    results = [Solid(stretched(mesh, 1, first)) for mesh in meshes.values()]
    rows = [compared(true, result) for true, result in zip(solids_of(scene), results)]
    row = {key: float(np.mean([row[key] for row in rows])) for key in ("voxels", "bias", "volume")}
    row |= {key: sum(row[key] for row in rows) for key in ("faces", "open", "megabytes")}
    row |= {"seconds": seconds, "most": max(row["voxels"] for row in rows)}
    if len(results) == 1:
        return row
    depth = ndimage.distance_transform_edt(image > 0, sampling=spacing)
    near = [sample_surface(solid.mesh, (0, 2), POINTS).points for solid in solids_of(scene)]
    near = np.concatenate(near) + np.random.default_rng(0).uniform(-1, 1, (len(near) * POINTS, 3))
    near = near[depth[tuple(np.rint((near - first) / spacing).astype(int).T)] > DEEP + ratio]
    times = np.sum([result.is_inside(near) for result in results], 0)
    return {**row, "gaps": float(np.mean(times == 0)), "overlaps": float(np.mean(times > 1))}


def compared(true: Solid, result: Solid) -> Row:
    """Return how far a mesh is from the true one, both ways, on which side, and how large it is."""
    mesh = result.mesh
    there = result.distance(sample_surface(true.mesh, (0, 0), POINTS).points)
    back = true.signed_distance(sample_surface(mesh, (0, 1), POINTS).points)
    row = {"voxels": float(there.mean() + np.abs(back).mean()) / 2, "bias": float(back.mean())}
    ply = 12 * len(np.unique(mesh.faces)) + 13 * len(mesh.faces)  # bytes of a binary file
    row |= {"faces": len(mesh.faces), "open": mesh.open_edges(), "megabytes": ply / 1e6}
    return {**row, "volume": abs(100 * (mesh.volume() / true.mesh.volume() - 1))}
