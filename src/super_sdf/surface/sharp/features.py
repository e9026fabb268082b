"""Where the surface has an edge or a corner, and where on it a vertex belongs.

1. Candidates are patches whose planes differ, by the settled planes of the faces beside.
2. Each gets the point where these planes meet, moved so that the samples' spheres agree: the foot
   point of a sample in the cone of normals of an edge, outside a convex one or inside a concave
   one, lies on the edge.
3. ``Edges.evidence`` gathers what speaks for an edge there and what against it: how sharply the
   field itself turns, flat ground beside, spheres that touch or are pierced. Most of it is averaged
   along the chain of candidates, since an edge has a length.
4. A linear rule says how far from the middle of its patch to that point the vertex goes: all the
   way on an edge, a part of it on rounded ground. Where it is little, marching cubes is kept. The
   rule was fitted by ``export.edges``, on shapes with and without edges, to how far from the middle
   to that point the true surface lies; it is in ``rule.json``.
5. Beside features, vertices are moved as much of the way onto the settled planes.
6. A feature's vertex that would fold the surface goes half way back to the middle of its patch.

References
----------
Kobbelt, Botsch, Schwanecke and Seidel, "Feature Sensitive Surface Extraction from Volume Data",
2001, for the point where the planes meet; Sellán, Batty and Stein, "Reach For the Spheres", 2023,
and Carrera et al., "Dual Contouring of Signed Distance Data", 2026, for the spheres.

Positions are in fine spacings, from node (0, 0, 0) of the fine lattice, but for wedges.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...arrays import BoolArray, Index, IntArray, Numbers, Vectors, dot, length, unit
from ...refine.field import FineField, SampleSpheres
from ...threads import map_chunks
from ..marching import CAP_HEIGHT, Crossings, tables
from ..mesh import CLEARANCE
from .folds import REACH, Rounding, without_folds
from .patches import (
    Patches,
    Placed,
    beside,
    find_patches,
    triangles_of,
    unfolded,
    voxels_near_kinks,
)
from .planes import ROUNDS, Planes, planes_at_crossings, settle_planes, square_falloff

RULE = Path(__file__).with_name("rule.json")
SHARP_COSINE = 0.85  # normals of a patch that differ by more, 32 degrees, may make a feature
HALF_ANGLE_COSINE = 0.962  # of a little less than half that angle
LEAST_SLOPE_TRUST = 0.02  # of every crossing of a feature
RINGS = 3  # patches round a candidate, counted from it, in which planes are settled
CHAIN_ROUNDS = 8  # in each, a candidate takes the mean of those it shares a crossing with
LEAST_SHARE = 0.2  # of the way to the edge from which a patch has a feature
MOVED_RINGS = 3  # round a feature, in which vertices may be moved onto the planes: all of them ...
FADING, FADED_OUT = 1.0, 2.5  # ... up to a distance in fine spacings, none from another on
FARTHEST_MOVE = 0.5  # fine spacings
OUTSIDE_CELL = 0.5  # fine spacings by which a feature's vertex may leave its cell
OF_PATCH = 4  # numbers of evidence that are not averaged along the chain
LEAST_SPHERES = 4  # that pass near a feature: in noise no sample is exact, and normals say nothing
TEMPORARIES = 1000  # numbers per patch in the search for its spheres among 125 samples
# Cells to every side that a vertex depends on: gradients reach 2 cells, a patch is 1 wide, and so
# is the fan beside.
REACH_IN_CELLS = RINGS + ROUNDS + CHAIN_ROUNDS + MOVED_RINGS + REACH + 5
REACH_IN_VOXELS = 2  # further: whether a voxel is examined depends on those beside it

# Of wedges, in coarse spacings:
ALONG = 0.6  # distance along an edge at which a sphere counts for a quarter
FARTHEST_ALONG = 1.8
CLOSE_BY = 0.3  # distance along an edge within which no sphere may be pierced: see ``Contact``
OFF_SPHERE = 0.05  # distance from a sphere at which it counts for half
FARTHEST_SPHERE = 0.3
LARGEST_RADIUS = 1.4  # samples near the band's edge, 1.5, may have been truncated there
LEAST_RADIUS = 0.05  # of spheres: of smaller ones the direction is unknown
PIERCED = 0.02  # by which a sphere outside the cone must be pierced to count
TOUCHING = 0.04  # from a sphere at which it is touched ...
TOUCHED_ALONG = 1.0  # ... if it is within this distance along the edge
ITERATIONS = 3
LONGEST_STEP = 0.25
RANK = 0.05  # eigenvalues below this share of the largest leave a direction open
NEAR = 2  # voxels to each side whose samples are looked at


@dataclass(frozen=True, eq=False)
class Rule:
    """The linear rule for how far a vertex goes to the edge: ``bias + evidence @ weights``."""

    bias: float
    weights: tuple[float, ...]

    def share(self, evidence: Vectors) -> Numbers:
        """Return the share of the way for evidence (f, n), 0 to 1; summed in a fixed order."""
        share: Numbers = np.full(len(evidence), self.bias)
        for weight, column in zip(self.weights, evidence.T):
            share += weight * column
        return np.clip(share, 0, 1)


@lru_cache(maxsize=1)
def load_rule() -> Rule:
    """Return the rule that ``export.edges`` has written."""
    stored = json.loads(RULE.read_text())
    return Rule(stored["bias"], tuple(stored["weights"].values()))


@dataclass(frozen=True, eq=False)
class Candidates:
    """Patches that may hold an edge or a corner."""

    patch: Index  # (f,), their rows in all patches
    middle: Vectors  # (f, 3), mean of the crossings of each
    edge: Vectors  # (f, 3), the edge's nearest point, or the corner, kept near the patch's cell
    evidence: Vectors  # (f, 10): see ``evidence_of``
    spheres: IntArray  # (f,), how many spheres pass near the edge
    planes: Planes  # the settled planes of all crossings
    inside: Index  # (i,), the patches whose crossings were settled

    def share(self) -> Numbers:
        """Return how far the vertex of each goes from the middle to the edge, (f,), 0 to 1."""
        return np.where(self.spheres < LEAST_SPHERES, 0, load_rule().share(self.evidence))


@dataclass(frozen=True, eq=False)
class Features:
    """The vertices and triangles that edges and corners change.

    Vertices have the numbers of their edges among the own edges of all crossings, then those of
    features, in their order.
    """

    used: Index  # (m,), own edges of the crossings ...
    position: Vectors  # (m, 3), ... and the positions of their vertices
    peak: Vectors  # (f, 3), the positions of the features' vertices
    cell_ijk: Index  # (f, 3), the low nodes of their cells
    nth: Index  # (f,), which patch of the cell has the feature
    faces: IntArray  # (t, 3), the triangles of the cells that have a feature
    plain: Crossings  # the crossings, with the other cells only


def find_features(
    field: FineField, crossings: Crossings, border: IntArray, rounded: Rounding, threads: int = 1
) -> Features | None:
    """Look for edges and corners in voxels where the field has kinks, and beside them."""
    kinked = voxels_near_kinks(field, threads)
    voxels = beside(field, kinked, -(-(RINGS + 1) // field.factor))
    patches, used = find_patches(field, crossings, voxels)
    if not len(used):
        return None
    own = planes_at_crossings(field, crossings, used, border, threads)
    candidates = find_candidates(patches, own, kinked, field, threads)
    placed = place(patches, own, candidates, candidates.share())
    box = field.factor * border.astype(np.float64)
    position = _kept_in_grid(placed.position, own.point, box)
    peak = _kept_in_grid(placed.peak, patches.low[placed.feature] + 0.5, box)
    placed = replace(placed, position=position, peak=peak)
    placed = without_folds(patches, placed, own.point, rounded)
    plain = np.ones(len(crossings.cell_row), bool)
    plain[patches.cell[placed.feature]] = False
    _, corners = triangles_of(patches, placed, ~plain[patches.cell])
    count, features = len(crossings.own_row), len(placed.peak)
    numbers = np.concatenate([used, np.arange(count, count + features)]).astype(np.int32)
    feature = patches.chosen(placed.feature)
    nth = feature.loop - tables().first_loop[crossings.case[feature.cell]]
    where = placed.position, placed.peak, feature.low.astype(np.int64), nth
    return Features(used, *where, numbers[corners], crossings.with_cells(plain))


def _kept_in_grid(position: Vectors, start: Vectors, box: Vectors) -> Vectors:
    """Return positions (n, 3) that do not leave the grid, nor its border if they started there.

    An open surface ends on the border, and a cap is flat there. ``start``, (n, 3), is where a
    vertex was on its lattice edge, or the middle of its cell; ``box``, (2, 3), are the corners of
    the grid.
    """
    at_border = (start <= box[0]) | (start >= box[1])
    flat = np.clip(start, box[0] - CAP_HEIGHT, box[1] + CAP_HEIGHT)
    return np.where(at_border, flat, np.clip(position, box[0] + CLEARANCE, box[1] - CLEARANCE))


def place(patches: Patches, own: Planes, candidates: Candidates, share: Numbers) -> Placed:
    """Return the vertices of all patches if those of candidates go a ``share``, (f,), to the edge.

    Those of little share have none.
    """
    kept = share > LEAST_SHARE
    position = _move_beside(patches, own, candidates, share)
    vertex = candidates.middle + share[:, None] * (candidates.edge - candidates.middle)
    placed = Placed(position, candidates.planes.normal, candidates.patch[kept], vertex[kept])
    return unfolded(patches, placed)


def find_candidates(
    patches: Patches, own: Planes, kinked: BoolArray, field: FineField, threads: int = 1
) -> Candidates:
    """Return the patches that may hold a feature, with its vertex and the evidence for it."""
    seeds = np.flatnonzero(kinked[patches.row])
    seeds = seeds[is_sharp(patches.chosen(seeds), own.normal, own.trust)]
    near = np.append(patches.dilate(seeds, RINGS, len(own.point)), True)
    inside = np.flatnonzero(near[patches.crossing].all(1))
    some = patches.chosen(inside)
    planes = settle_planes(some, own, threads) if len(inside) else own
    sharp = np.flatnonzero(is_sharp(some, planes.normal, own.trust))
    chosen = some.chosen(sharp)
    work = partial(_measure, chosen, planes, own, field)
    parts = map_chunks(work, len(sharp), TEMPORARIES, threads)
    empty = np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 10)), np.empty(0, np.int32)
    middle, point, evidence, spheres = (np.concatenate(arrays) for arrays in zip(empty, *parts))
    evidence[:, OF_PATCH:] = _mean_along_chain(chosen, evidence[:, OF_PATCH:])
    low = chosen.low - OUTSIDE_CELL
    edge = np.clip(point, low, low + 1 + 2 * OUTSIDE_CELL)
    return Candidates(inside[sharp], middle, edge, evidence, spheres, planes, inside)


def is_sharp(patches: Patches, normal: Vectors, trust: Numbers) -> BoolArray:
    """Return which patches, (P,), turn by ``SHARP_COSINE``, where the slope is about 1."""
    # Where all are within half that angle of the first, no two differ by more.
    some = np.flatnonzero(_least_cosine(patches, normal, first=True) < HALF_ANGLE_COSINE)
    sharp: BoolArray = np.zeros(len(patches.row), bool)
    sharp[some] = _least_cosine(patches.chosen(some), normal) < SHARP_COSINE
    return sharp & ~patches.having(trust < LEAST_SLOPE_TRUST)


def _least_cosine(patches: Patches, normal: Vectors, *, first: bool = False) -> Numbers:
    """Return the least cosine of the normals of each patch's crossings, (P,); or of the first's."""
    least: Numbers = np.full(len(patches.row), np.inf)
    for other in range(1, patches.crossing.shape[1]):
        rows = np.flatnonzero(patches.crossing[:, other] >= 0)  # then it has all before, too
        mine = normal[patches.crossing[rows, other]]
        for one in range(1 if first else other):
            cosine = dot(normal[patches.crossing[rows, one]], mine)
            least[rows] = np.minimum(least[rows], cosine)
    return least


def _mean_along_chain(patches: Patches, evidence: Vectors) -> Vectors:
    """Return the evidence of patches (f, n) averaged over those that they are joined to."""
    patch, crossing = patches.joined()
    used, crossing = np.unique(crossing, return_inverse=True)
    shared = np.bincount(crossing, minlength=len(used))
    columns = []
    for mean in evidence.T:
        for _ in range(CHAIN_ROUNDS):
            at_crossing = np.bincount(crossing, mean[patch], len(used)) / shared
            mean = np.bincount(patch, at_crossing[crossing], len(mean)) / patches.sides
        columns.append(mean)
    return np.stack(columns, 1)


def _move_beside(patches: Patches, own: Planes, candidates: Candidates, share: Numbers) -> Vectors:
    """Return the positions of all crossings, (n, 3), those beside features on settled planes.

    They go as far as the nearest feature goes to the edge, ``share`` (f,), and less with the
    distance from it: otherwise there would be a step.
    """
    sure, inside = np.flatnonzero(share > LEAST_SHARE), candidates.inside
    features = np.searchsorted(inside, candidates.patch[sure])
    distance, nearest = _nearest_feature(
        patches.chosen(inside), features, candidates.edge[sure], own.point
    )
    moved = np.append(share[sure], 0)[nearest]
    moved *= np.clip((FADED_OUT - distance) / (FADED_OUT - FADING), 0, 1)
    rows = np.flatnonzero(moved)
    shift = candidates.planes.point[rows] - own.point[rows]
    shift *= np.minimum(1, FARTHEST_MOVE / np.maximum(length(shift), 1e-12))[:, None]
    position: Vectors = own.point.copy()
    position[rows] += moved[rows, None] * shift
    return position


def _nearest_feature(
    patches: Patches, features: Index, vertex: Vectors, point: Vectors
) -> tuple[Numbers, Index]:
    """Return the distance (n,) of crossings to a vertex within some rings of patches, and whose."""
    distance: Numbers = np.full(len(point) + 1, np.inf)  # the last is of no crossing
    nearest = np.full(len(point), -1, np.int64)
    known = np.full(len(patches.row), -1, np.int64)
    known[features] = np.arange(len(features))
    for _ in range(MOVED_RINGS):
        rows = np.flatnonzero(known >= 0)
        place, nth = np.nonzero(patches.there[rows])
        peak, at = known[rows[place]], patches.crossing[rows[place], nth]
        apart = length(point[at] - vertex[peak])
        np.minimum.at(distance, at, apart)
        best = apart == distance[at]
        nearest[at[best]] = peak[best]
        away = distance[patches.crossing]
        chosen = np.take_along_axis(patches.crossing, away.argmin(1)[:, None], 1)[:, 0]
        known = np.where(np.isfinite(away.min(1)), nearest[chosen], -1)
    return distance[:-1], nearest


class Wedges(NamedTuple):
    """Where two or more faces meet, one for each of some patches.

    Positions and lengths are in coarse spacings, from node (0, 0, 0) of the fine lattice, so sample
    (i, j, k) is at (i + 1/2, j + 1/2, k + 1/2). Vectors are in columns.
    """

    point: Vectors  # (3, f), on the edge, or the corner
    tangent: Vectors  # (3, f), direction of the edge; 0 at a corner, where three faces or more meet
    sides: Vectors  # (2, 3, f), the two normals that differ most
    cosine: Numbers  # (f,), of the angle between these
    # (f,), 1 if the solid fills less than half of the space round the edge, -1 if it fills more
    convex: Numbers
    # (f, 3, 3), mean of the squares of the normals: how the planes hold the point
    stiffness: Vectors


class Nearby(NamedTuple):
    """Pairs of a wedge and a sphere that passes near it, in the order of the wedges.

    Columns of wedges stand here once for each pair, vectors as (3, n).
    """

    wedge: Index  # (n,)
    centre: Vectors  # the sample
    radius: Numbers
    tangent: Vectors
    outward: Vectors  # (2, 3, n), the sides of the wedge, turned to where the spheres are
    cosine: Numbers
    may_touch: BoolArray  # whether it is an edge, and the sample on the side where the cone is


class Contact(NamedTuple):
    """How spheres stand to the edges that they are near."""

    direction: Vectors  # (3, n), from the sample to the edge, of unit length
    along: Numbers  # (n,), distance along the edge
    gap: Numbers  # (n,), distance from the sphere to the edge, negative if it is pierced
    in_cone: BoolArray  # (n,), whether it must touch the edge, by the normals of the two faces
    # (n,), whether it may not be pierced: further on, the edge may have ended or turned
    is_close: BoolArray


def _measure(
    patches: Patches, planes: Planes, own: Planes, field: FineField, rows: slice
) -> tuple[Vectors, Vectors, Vectors, IntArray]:
    """Return the middle of some patches, the point on the edge, evidence, and how many spheres.

    The evidence, (f, 10), is what speaks for an edge in each patch and against it, in coarse
    spacings. Of the patch: the cosine of the settled normals, and of the field's own; how far
    planes were settled; the logarithm of the trust in the flattest ground. Then what is averaged
    along the chain: the own cosine; how far the trust in the roughest ground is over a tenth; by
    how much a sphere is pierced; how many are touched; how far spheres moved the point; how far it
    is outside.
    """
    patches, factor = patches.chosen(rows), field.factor
    crossing, there, count = patches.crossing, patches.there, len(patches.row)
    wedges = wedges_of(planes.point[crossing] / factor, planes.normal[crossing], there)
    assert field.spheres is not None  # otherwise no features are looked for
    near = find_spheres(wedges, field.voxel_ijk[patches.row].astype(np.int64), field.spheres)
    point = lean(wedges, near)
    contact = contact_of(point, near)
    own_cosine = _least_cosine(patches, own.normal)
    settled = np.where(there, length(planes.point[crossing] - own.point[crossing]), 0).max(1)
    trust = planes.trust[crossing]
    flattest = np.log(np.where(there, trust, 0).max(1) + 1e-3)
    roughest = np.log(np.where(there, trust, np.inf).min(1) + 1e-3)
    pierced: Numbers = np.full(count, -0.1)
    np.maximum.at(pierced, near.wedge[contact.is_close], -contact.gap[contact.is_close])
    touching = contact.in_cone & (np.abs(contact.gap) < TOUCHING)
    touching &= np.abs(contact.along) < TOUCHED_ALONG
    middle = patches.mean(own.point)
    columns = (
        *(wedges.cosine, own_cosine, settled / factor, flattest),
        *(own_cosine, np.maximum(roughest - np.log(0.1), 0)),
        np.clip(pierced, 0, 0.15),
        np.minimum(np.bincount(near.wedge[touching], minlength=count), 3),
        np.minimum(length((point - wedges.point).T), 0.15),
        dot(point.T - middle / factor, unit(patches.mean(planes.normal))),
    )
    spheres = np.bincount(near.wedge, minlength=count).astype(np.int32)
    return middle, factor * point.T, np.stack(columns, 1).astype(np.float64), spheres


def wedges_of(point: Vectors, normal: Vectors, there: BoolArray) -> Wedges:
    """Return the wedges of patches, at the points nearest to all planes of each.

    A plane is given by a point and a normal, (f, S, 3) each; ``there``, (f, S), says which are.
    """
    count, normal = there.sum(1), normal * there[..., None]
    stiffness = np.einsum("pei,pej->pij", normal, normal) / count[:, None, None]
    values, vectors = np.linalg.eigh(stiffness)
    middle = (point * there[..., None]).sum(1) / count[:, None]
    height = dot(point - middle[:, None], normal)
    right = (height[..., None] * normal).sum(1) / count[:, None]
    inverse = np.where(values > RANK * values[:, -1:], 1 / np.maximum(values, 1e-9), 0)
    step = np.einsum("pij,pj->pi", vectors, inverse * np.einsum("pij,pi->pj", vectors, right))
    peak = middle + step
    cosine = np.einsum("pei,pfi->pef", normal, normal)
    cosine[~(there[:, :, None] & there[:, None, :])] = 2
    one, other = np.divmod(cosine.reshape(len(cosine), -1).argmin(1), there.shape[1])
    row = np.arange(len(peak))
    first, second = normal[row, one], normal[row, other]
    above = dot(point[row, one] - peak, second) + dot(point[row, other] - peak, first)
    convex = np.where(above < 0, 1.0, -1.0)
    corner = values[:, 0] > RANK * values[:, -1]
    tangent = np.where(corner, 0, vectors[:, :, 0].T)
    sides = np.stack([first.T, second.T])
    return Wedges(peak.T.copy(), tangent, sides, dot(first, second), convex, stiffness)


def find_spheres(wedges: Wedges, voxel: Index, spheres: SampleSpheres) -> Nearby:
    """Return the spheres that pass within ``FARTHEST_SPHERE`` of each wedge's edge.

    Wedges of a ``voxel``, (f, 3), follow each other, and have the same samples around.
    """
    first = np.append(True, np.any(np.diff(voxel, axis=0) != 0, axis=1))[: len(voxel)]
    number = _samples_around(voxel[first], spheres)
    distance: Numbers = spheres.distance.astype(np.float64) / 2
    usable = (number >= 0) & (np.abs(distance) < LARGEST_RADIUS)[number]
    of_wedge = np.cumsum(first) - 1
    wedge, place = np.nonzero(usable[of_wedge])
    number = number[of_wedge[wedge], place]
    centre = np.stack([axis[number] + 0.5 for axis in spheres.voxel_ijk.T])
    radius = np.abs(distance)[number]
    away = wedges.point[:, wedge] - centre
    along = _along(away, wedges.tangent[:, wedge])
    across = np.sqrt(np.maximum(_along(away, away) - along * along, 0))
    kept = (np.abs(across - radius) < FARTHEST_SPHERE) & (np.abs(along) < FARTHEST_ALONG)
    wedge, number = wedge[kept], number[kept]
    convex, tangent = wedges.convex[wedge], wedges.tangent[:, wedge]
    may_touch = (np.sign(distance[number]) == convex) & tangent.any(0)
    outward = -convex * wedges.sides[..., wedge]
    cosine = wedges.cosine[wedge]
    return Nearby(wedge, centre[:, kept], radius[kept], tangent, outward, cosine, may_touch)


def _samples_around(voxel: Index, spheres: SampleSpheres) -> Index:
    """Return the numbers of the exact samples within ``NEAR`` of voxels (v, 3), -1 for none.

    A line of them along the last axis is searched for at once: (v, 125).
    """
    keys, (nx, ny, nz) = spheres.index.keys, spheres.shape
    steps = np.indices((2 * NEAR + 1,) * 2).reshape(2, -1) - NEAR
    i, j, k = voxel[:, 0, None] + steps[0], voxel[:, 1, None] + steps[1], voxel[:, 2, None]
    line = (i * ny + j) * nz
    start = np.searchsorted(keys, line + np.maximum(k - NEAR, 0))
    number = start[..., None] + np.arange(2 * NEAR + 1)
    there = ((i >= 0) & (i < nx) & (j >= 0) & (j < ny))[..., None] & (number < len(keys))
    there &= keys.take(number, mode="clip") <= (line + np.minimum(k + NEAR, nz - 1))[..., None]
    return np.where(there, number, -1).reshape(len(voxel), -1)


def contact_of(point: Vectors, near: Nearby) -> Contact:
    """Return how spheres stand to edges at points (3, f); none must touch a corner."""
    away = point[:, near.wedge] - near.centre
    along = _along(away, near.tangent)
    across = away - along * near.tangent
    apart = np.sqrt(_along(across, across))
    direction = across / np.maximum(apart, 1e-12)
    first, second = _along(direction, near.outward[0]), _along(direction, near.outward[1])
    in_cone = (first > near.cosine * second) & (second > near.cosine * first)
    in_cone &= near.may_touch & (apart > LEAST_RADIUS)
    return Contact(direction, along, apart - near.radius, in_cone, np.abs(along) < CLOSE_BY)


def lean(wedges: Wedges, near: Nearby) -> Vectors:
    """Return the points, (3, f), at which planes and spheres agree best, by least squares."""
    point, count, wedge = wedges.point, wedges.point.shape[1], near.wedge
    tangent = wedges.tangent.T
    hold = wedges.stiffness + 1e-3 * np.eye(3) + 1e3 * tangent[:, :, None] * tangent[:, None, :]
    for _ in range(ITERATIONS):
        direction, along, gap, in_cone, is_close = contact_of(point, near)
        counts = in_cone | (is_close & (gap < -PIERCED))
        weight = counts * square_falloff(along / ALONG) / (1 + (gap / OFF_SPHERE) ** 2)
        pull = np.einsum("pij,jp->pi", wedges.stiffness, wedges.point - point)
        stiff = hold.copy()
        for i in range(3):
            pull[:, i] -= np.bincount(wedge, weight * gap * direction[i], count)
            for j in range(i + 1):
                total = np.bincount(wedge, weight * direction[i] * direction[j], count)
                stiff[:, i, j] += total
                if i != j:
                    stiff[:, j, i] += total
        step = np.linalg.solve(stiff, pull[..., None])[..., 0].T
        point = point + np.clip(step, -LONGEST_STEP, LONGEST_STEP)
    return point


def _along(a: Vectors, b: Vectors) -> Numbers:
    """Return the products of vectors (3, n)."""
    product: Numbers = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product
