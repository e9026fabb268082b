"""Where the surface has an edge or a corner, and where on it a vertex belongs.

1. Candidates are patches whose planes differ, by the settled planes of the faces beside.
2. Each gets the point where these planes meet, moved so that the samples' spheres agree: a wedge.
3. ``Edges.evidence`` gathers what speaks for an edge there and what against it: how sharply the
   field itself turns, flat ground beside, spheres that touch or are pierced. Most of it is averaged
   along the chain of candidates, since an edge has a length.
4. A linear rule says how far from the middle of its patch to that point the vertex goes: all the
   way on an edge, a part of it on rounded ground. Where it is little, marching cubes is kept. The
   rule, ``rule.json``, was fitted by ``export.edges`` to where the true surface of shapes lies.
5. Beside features, vertices are moved as much of the way onto the settled planes.
6. A feature's vertex that would fold the surface goes half way back to the middle of its patch.

References
----------
Kobbelt, Botsch, Schwanecke and Seidel, "Feature Sensitive Surface Extraction from Volume Data",
2001, for the point where the planes meet; Sellán, Batty and Stein, "Reach For the Spheres", 2023,
and Carrera et al., "Dual Contouring of Signed Distance Data", 2026, for the spheres.

Positions are in fine spacings, from node (0, 0, 0) of the fine lattice, but for wedges: ``planes``.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from ...arrays import BoolArray, Index, IntArray, Numbers, Vectors, dot, inner, length, unit
from ...refine.field import FineField
from ...threads import map_chunks
from ..marching import CAP_HEIGHT, Crossings, tables
from ..mesh import CLEARANCE
from .folds import REACH, Rounding, without_folds
from .patches import Patches, Placed, beside, find_patches, triangles_of, voxels_near_kinks
from .planes import (
    ROUNDS,
    TOUCHED_ALONG,
    TOUCHING,
    Planes,
    contact_of,
    find_spheres,
    lean,
    planes_at_crossings,
    settle_planes,
    wedges_of,
)

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
TEMPORARIES = 500  # numbers per patch in the search for its spheres among 125 samples
# Cells to every side that a vertex depends on: gradients reach 2 cells, a patch is 1 wide, and so
# is the fan beside.
REACH_IN_CELLS = RINGS + ROUNDS + CHAIN_ROUNDS + MOVED_RINGS + REACH + 5
REACH_IN_VOXELS = 2  # further: whether a voxel is examined depends on those beside it


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
    evidence: Vectors  # (f, 10): see ``_measure``
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
    return placed.unfolded(patches)


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
    columns = np.ascontiguousarray(normal.T)
    corners = [columns.take(crossing, 1, mode="clip") for crossing in patches.crossing.T]
    for other in range(1, len(corners)):
        rows = np.flatnonzero(patches.sides > other)  # long loops are rare
        mine = corners[other].take(rows, 1)
        for one in range(1 if first else other):
            cosine = inner(corners[one].take(rows, 1), mine)
            least[rows] = np.minimum(least[rows], cosine)
    return least


def _mean_along_chain(patches: Patches, evidence: Vectors) -> Vectors:
    """Return the evidence of patches (f, n) averaged over those that they are joined to."""
    patch = np.repeat(np.arange(len(patches.sides)), patches.sides)
    _, crossing = np.unique(patches.crossing[patches.crossing >= 0], return_inverse=True)
    shared = np.bincount(crossing)
    columns = []
    for mean in evidence.T:
        for _ in range(CHAIN_ROUNDS):
            at_crossing = np.bincount(crossing, mean.take(patch)) / shared
            mean = np.bincount(patch, at_crossing.take(crossing)) / patches.sides
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
        joined = patches.crossing.take(rows, 0)
        peak, at = np.repeat(known[rows], patches.sides[rows]), joined[joined >= 0]
        apart = length(point.take(at, 0) - vertex.take(peak, 0))
        np.minimum.at(distance, at, apart)
        best = np.flatnonzero(apart == distance.take(at))
        nearest[at[best]] = peak[best]
        away = distance.take(patches.crossing, mode="wrap")
        chosen = np.take_along_axis(patches.crossing, away.argmin(1)[:, None], 1)[:, 0]
        known = np.where(np.isfinite(away.min(1)), nearest[chosen], -1)
    return distance[:-1], nearest


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
    patches, factor = patches.chosen(np.arange(rows.start, rows.stop)), field.factor
    crossing, count = patches.crossing.T, len(patches.row)
    there = crossing >= 0
    point, normal = planes.point.take(crossing, 0), planes.normal.take(crossing, 0)
    wedges = wedges_of(np.moveaxis(point, 2, 0) / factor, np.moveaxis(normal, 2, 0) * there, there)
    near = find_spheres(wedges, field.voxel_ijk.take(patches.row, 0), field.spheres)
    leant = lean(wedges, near)
    contact = contact_of(leant, near)
    own_cosine = _least_cosine(patches, own.normal)
    settled = np.where(there, length(point - own.point.take(crossing, 0)), 0).max(0)
    trust = planes.trust.take(crossing)
    flattest = np.log(np.where(there, trust, 0).max(0) + 1e-3)
    roughest = np.log(np.where(there, trust, np.inf).min(0) + 1e-3)
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
        np.minimum(length((leant - wedges.point).T), 0.15),
        dot(leant.T - middle / factor, unit(patches.mean(planes.normal))),
    )
    spheres = np.bincount(near.wedge, minlength=count).astype(np.int32)
    return middle, factor * leant.T, np.stack(columns, 1).astype(np.float64), spheres
