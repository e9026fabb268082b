"""Procedural closed solids: training without mesh data.

`random_solid` draws from a family, a function that draws one kind of solid, about one unit long and
anywhere in space. It adds features of another scale to about half of
the solids, bends some, and scales the result to a bounding box diagonal of 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from manifold3d import Error, Manifold
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from export.shapes.basic import csg, lathe, primitive, prism, rounded
from export.shapes.draws import joined, log_uniform, swayed, turned, twisted, unit_sized
from export.shapes.edges import chamfered, filleted
from export.shapes.mechanical import gear, plate, ribs, text, threads
from export.shapes.organic import blends, creature, sculpture
from export.shapes.slender import lattice, pipe, section, shell, thin
from super_sdf import Mesh

ATTEMPTS = 20  # about one candidate in a hundred fails, mostly by too many faces
MAX_FACES = 70_000  # the finest reliefs have some 50,000
MIN_VOLUME = 1e-4  # of the cubed diagonal; the thinnest shells and trusses hold some 1e-3
TOLERANCE = 1e-5  # of the diagonal; shorter edges only spoil the normals of their triangles

Family = Callable[[np.random.Generator], Manifold]

MACHINED: tuple[Family, ...] = (
    prism, csg, lathe, rounded,
    filleted, chamfered,
    plate, gear, threads, ribs,
    shell, pipe, thin, section, lattice, text,
)  # fmt: skip
GROWN: tuple[Family, ...] = (blends, creature, sculpture)
FAMILIES: dict[str, Family] = {family.__name__: family for family in (*MACHINED, *GROWN)}

GROWN_SHARE = 0.4  # few of the meshes at hand have smooth, irregular shapes


def draw_family(rng: np.random.Generator, names: Sequence[str] = ()) -> Family:
    """Draw a family: one of those named, equally likely each time they are, or of all."""
    if names:
        return FAMILIES[names[rng.integers(len(names))]]
    families = GROWN if rng.random() < GROWN_SHARE else MACHINED
    return families[rng.integers(len(families))]


def bent(rng: np.random.Generator, solid: Manifold) -> Manifold:
    """Twist or sway a solid, its faces first cut fine enough to follow."""
    fine = unit_sized(solid).refine_to_length(0.04)
    if fine.num_tri() > MAX_FACES:
        return solid
    return swayed(rng, fine, 0.6) if rng.random() < 0.5 else twisted(fine, rng.uniform(0.8, 2.8))


def draw_places(rng: np.random.Generator, solid: Manifold, count: int) -> np.ndarray:
    """Draw frames on the surface, (count, 3, 4): columns of two tangents, the normal, the point."""
    mesh = solid.to_mesh64()
    corners = mesh.vert_properties[:, :3][mesh.tri_verts]
    sides = corners[:, 1:] - corners[:, :1]
    normals = np.cross(sides[:, 0], sides[:, 1])
    areas = np.linalg.norm(normals, axis=1)
    drawn = rng.choice(len(areas), count, p=areas / areas.sum())
    points = np.einsum("nk,nki->ni", rng.dirichlet([1, 1, 1], count), corners[drawn])
    normal = normals[drawn] / areas[drawn, None]
    tangent = np.cross(normal, np.eye(3)[np.abs(normal).argmin(1)])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.stack([tangent, np.cross(normal, tangent), normal, points], axis=2)


def with_features(rng: np.random.Generator, solid: Manifold) -> Manifold:
    """Add and cut small parts on the surface: one part or two, each of one to eight copies."""
    for _ in range(rng.integers(1, 3)):
        if solid.is_empty():
            break
        tool = unit_sized(primitive(rng)).scale([log_uniform(rng, 0.03, 0.35)] * 3)
        most = 2000 // tool.num_tri()
        places = draw_places(rng, solid, int(rng.integers(1, 3 + min(6, most))))
        tools = joined([tool.transform(place) for place in places])
        solid = solid + tools if rng.random() < 0.5 else solid - tools
    return solid


def draw_candidate(rng: np.random.Generator, families: Sequence[str] = ()) -> Manifold:
    """Draw a solid of one family or two, perhaps with features and a bend, its diagonal 1."""
    solid = unit_sized(draw_family(rng, families)(rng))
    if rng.random() < 0.15:
        other = unit_sized(turned(rng, draw_family(rng, families)(rng)))
        other = other.scale([rng.uniform(0.3, 0.9)] * 3).translate(list(rng.uniform(-0.2, 0.2, 3)))
        solid = solid + other if rng.random() < 0.6 else solid - other
    if rng.random() < 0.4:
        solid = with_features(rng, solid)
    if rng.random() < 0.15:
        solid = bent(rng, solid)
    return unit_sized(solid).simplify(TOLERANCE)


def without_crumbs(mesh: Mesh) -> Mesh:
    """Drop the pieces, and fill the cavities, of less than 2 % of the largest piece's volume."""
    edges = mesh.faces[:, [0, 1, 2]], mesh.faces[:, [1, 2, 0]]
    links = coo_array((np.ones(mesh.faces.size), [side.ravel() for side in edges]))
    piece = connected_components(links, directed=False)[1][mesh.faces[:, 0]]
    volumes = np.abs(np.bincount(piece, np.linalg.det(mesh.vertices[mesh.faces])))
    kept = mesh.faces[(volumes > 0.02 * volumes.max())[piece]]
    used, faces = np.unique(kept, return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32))


def mesh_of(solid: Manifold) -> Mesh:
    drawn = solid.to_mesh64()
    return Mesh(drawn.vert_properties[:, :3], drawn.tri_verts.astype(np.int32))


def random_solid(rng: np.random.Generator, families: Sequence[str] = ()) -> Mesh:
    """Draw a closed solid with outward faces, its bounding box centred and of diagonal 1.

    It is of the families named, or of any. The same state of ``rng`` gives the same solid. About
    one solid in 300 touches or intersects itself, where a bent wall or a level set is very thin.
    """
    for _ in range(ATTEMPTS):
        solid = draw_candidate(rng, families)
        valid = solid.status() == Error.NoError and solid.num_tri() <= MAX_FACES
        if valid and float(solid.volume()) > MIN_VOLUME:
            mesh = without_crumbs(mesh_of(solid))
            low, high = mesh.vertices.min(0), mesh.vertices.max(0)
            scale = 1 / float(np.linalg.norm(high - low))
            return mesh.transformed(scale * np.eye(3), -scale * (low + high) / 2)
    raise RuntimeError(f"none of {ATTEMPTS} drawn solids was usable; draw from another seed")
