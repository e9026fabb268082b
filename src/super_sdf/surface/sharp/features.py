"""Where the surface has an edge or a corner, and where on it a vertex belongs.

1. Candidates are patches whose planes differ, by the settled planes of the faces beside.
2. Each gets the point where these planes meet, moved so that the samples' spheres agree.
3. ``evidence_of`` gathers what speaks for an edge there and what against it: how sharply the field
   itself turns, flat ground beside, spheres that touch or are pierced. Most of it is averaged along
   the chain of candidates, since an edge has a length.
4. A linear rule says how far from the middle of its patch to that point the vertex goes: all the
   way on an edge, a part of it on rounded ground. Where it is little, marching cubes is kept.
5. Beside features, vertices are moved as much of the way onto the settled planes.
6. A feature's vertex that would fold the surface goes half way back to the middle of its patch.

The rule was fitted by ``export.edges``, on shapes with and without edges, to how far from the
middle to that point the true surface lies.

Positions are in fine spacings, from node (0, 0, 0) of the fine lattice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray, IntArray
from ...refine.field import FineField, SampleSpheres
from ...threads import map_chunks
from ..cell_cases import loop_table
from ..marching import CAP_HEIGHT, Crossings
from ..mesh import CLEARANCE
from .folds import REACH, without_folds
from .patches import (
    Index,
    Numbers,
    Patches,
    Placed,
    Vectors,
    beside,
    dilate,
    dot,
    find_patches,
    length,
    triangles_of,
    unfolded,
    unit,
    voxels_near_kinks,
)
from .planes import ROUNDS, Planes, planes_at_crossings, settle_planes
from .wedges import Nearby, Wedges, contact_of, find_spheres, lean, wedges_of

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
TOUCHING = 0.04  # coarse spacings from a sphere at which it is touched
OF_PATCH = 4  # numbers of evidence that are not averaged along the chain
LEAST_SPHERES = 4  # that pass near a feature: in noise no sample is exact, and normals say nothing
TEMPORARIES = 1000  # numbers per patch in the search for its spheres among 125 samples
TOUCHED_ALONG = 1.0  # coarse spacings along an edge in which spheres are counted
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


RULE = Rule(
    1.6111,
    (0.4816, -0.5337, -3.5793, 0.3067, -0.9708, 0.1929, -15.4162, 0.3484, -21.0059, -0.8157),
)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Patches that may hold an edge or a corner."""

    patch: Index  # (f,), their rows in all patches
    middle: Vectors  # (f, 3), mean of the crossings of each
    edge: Vectors  # (f, 3), the edge's nearest point, or the corner, kept near the patch's cell
    evidence: Vectors  # (f, 10): see ``evidence_of``
    spheres: NDArray[np.int32]  # (f,), how many spheres pass near the edge
    planes: Planes  # the settled planes of all crossings
    inside: Index  # (i,), the patches whose crossings were settled

    def share(self) -> Numbers:
        """Return how far the vertex of each goes from the middle to the edge, (f,), 0 to 1."""
        return np.where(self.spheres < LEAST_SPHERES, 0, RULE.share(self.evidence))


@dataclass(frozen=True, eq=False)
class Features:
    """The vertices and triangles in voxels that may hold an edge, and what is left of the others.

    Vertices have the numbers of their edges among the own edges of all crossings, then those of
    features, in their order.
    """

    used: Index  # (m,), own edges of the crossings ...
    position: Vectors  # (m, 3), ... and the positions of their vertices
    peak: Vectors  # (f, 3), the positions of the features' vertices
    cell_ijk: Index  # (f, 3), the low nodes of their cells
    nth: Index  # (f,), which patch of the cell has the feature
    faces: IntArray  # (t, 3), the triangles of all these voxels
    plain: Crossings  # the crossings, with the cells of the other voxels only


def find_features(
    field: FineField, crossings: Crossings, border: IntArray, threads: int = 1
) -> Features | None:
    """Look for edges and corners in voxels where the field has kinks, and beside them."""
    kinked = voxels_near_kinks(field, threads)
    voxels = beside(field, kinked, -(-(RINGS + 1) // field.factor))
    patches, used = find_patches(field, crossings, voxels)
    if not len(used):
        return None
    own = planes_at_crossings(field, crossings, used, border, threads)
    placed = place_features(patches, own, kinked, field)
    box = field.factor * border.astype(np.float64)
    position = _kept_in_grid(placed.position, own.point, box)
    peak = _kept_in_grid(placed.peak, patches.low[placed.feature] + 0.5, box)
    placed = replace(placed, position=position, peak=peak)
    placed = without_folds(patches, placed, own.point)
    _, corners = triangles_of(patches, placed)
    count, features = len(crossings.own_row), len(placed.peak)
    numbers = np.concatenate([used, np.arange(count, count + features)]).astype(np.int32)
    plain = ~voxels[crossings.cell_row]
    return Features(
        used,
        placed.position,
        placed.peak,
        patches.low[placed.feature].astype(np.int64),
        loop_table().nth[patches.loop[placed.feature]],
        numbers[corners],
        replace(
            crossings,
            cell_row=crossings.cell_row[plain],
            cell=crossings.cell[plain],
            case=crossings.case[plain],
        ),
    )


def _kept_in_grid(position: Vectors, start: Vectors, box: Vectors) -> Vectors:
    """Return positions (n, 3) that do not leave the grid, nor its border if they started there.

    An open surface ends on the border, and a cap is flat there. ``start``, (n, 3), is where a
    vertex was on its lattice edge, or the middle of its cell; ``box``, (2, 3), are the corners of
    the grid.
    """
    at_border = (start <= box[0]) | (start >= box[1])
    flat = np.clip(start, box[0] - CAP_HEIGHT, box[1] + CAP_HEIGHT)
    return np.where(at_border, flat, np.clip(position, box[0] + CLEARANCE, box[1] - CLEARANCE))


def place_features(patches: Patches, own: Planes, kinked: BoolArray, field: FineField) -> Placed:
    """Return the positions of all crossings, which patches have a feature, and its vertices."""
    candidates = find_candidates(patches, own, kinked, field)
    return placed_by(patches, own, candidates, candidates.share())


def placed_by(patches: Patches, own: Planes, candidates: Candidates, share: Numbers) -> Placed:
    """Return what ``place_features`` does, with vertices that go a ``share``, (f,), to the edge."""
    kept = share > LEAST_SHARE
    position = move_beside(patches, own, candidates, share)
    vertex = candidates.middle + share[:, None] * (candidates.edge - candidates.middle)
    placed = Placed(position, candidates.planes.normal, candidates.patch[kept], vertex[kept])
    return unfolded(patches, placed)


def find_candidates(
    patches: Patches, own: Planes, kinked: BoolArray, field: FineField
) -> Candidates:
    """Return the patches that may hold a feature, with its vertex and the evidence for it."""
    seeds = np.flatnonzero(kinked[patches.row])
    seeds = seeds[is_sharp(patches.chosen(seeds), own.normal, own.trust)]
    near = dilate(patches, seeds, RINGS, len(own.point))
    inside = np.flatnonzero((near[patches.crossing] | ~patches.there).all(1))
    some = patches.chosen(inside)
    planes = settle_planes(some, own) if len(inside) else own
    sharp = np.flatnonzero(is_sharp(some, planes.normal, own.trust))
    chosen = some.chosen(sharp)
    parts = map_chunks(
        lambda rows: _measure(chosen.chosen(rows), planes, own, field),
        len(sharp),
        TEMPORARIES,
    )
    empty = np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 10)), np.empty(0, np.int32)
    middle, point, evidence, spheres = (np.concatenate(arrays) for arrays in zip(empty, *parts))
    evidence[:, OF_PATCH:] = mean_along_chain(chosen, evidence[:, OF_PATCH:], len(own.point))
    low = chosen.low - OUTSIDE_CELL
    edge = np.clip(point, low, low + 1 + 2 * OUTSIDE_CELL)
    return Candidates(inside[sharp], middle, edge, evidence, spheres, planes, inside)


def _measure(
    patches: Patches, planes: Planes, own: Planes, field: FineField
) -> tuple[Vectors, Vectors, Vectors, NDArray[np.int32]]:
    """Return the middle of some patches, the point on the edge, evidence, and how many spheres."""
    ijk = field.voxel_ijk[patches.row].astype(np.int64)
    corners = planes.point[patches.crossing] / field.factor, planes.normal[patches.crossing]
    wedges = wedges_of(ijk, *corners, patches.there)
    none = np.empty((0, 3), np.int32), np.empty(0, np.float32)
    nearby = find_spheres(wedges, field.spheres or SampleSpheres(field.shape, *none))
    leaned = lean(wedges, nearby)
    evidence = evidence_of(patches, planes, own, (wedges, leaned), nearby, field.factor)
    count = nearby.count_of(np.ones(len(nearby.wedge), bool), len(evidence))
    return mean_of(patches, own.point), field.factor * leaned.point, evidence, count


def mean_of(patches: Patches, vectors: Vectors) -> Vectors:
    """Return the mean of the vectors (n, 3) at the crossings of each patch, (P, 3)."""
    there = patches.there[..., None]
    mean: Vectors = np.where(there, vectors[patches.crossing], 0).sum(1) / patches.sides[:, None]
    return mean


def is_sharp(patches: Patches, normal: Vectors, trust: Numbers) -> BoolArray:
    """Return which patches, (P,), turn by ``SHARP_COSINE``, where the slope is about 1."""
    sides = patches.crossing.shape[1]
    # Where all are within half that angle of the first, no two differ by more.
    pairs = [(0, other) for other in range(1, sides)]
    some = np.flatnonzero(_least_cosine(patches, normal, pairs) < HALF_ANGLE_COSINE)
    pairs = pairs_of(sides)
    sharp: BoolArray = np.zeros(len(patches.row), bool)
    sharp[some] = _least_cosine(patches.chosen(some), normal, pairs) < SHARP_COSINE
    known = (trust[patches.crossing] >= LEAST_SLOPE_TRUST) | ~patches.there
    return sharp & known.all(1)


def pairs_of(sides: int) -> list[tuple[int, int]]:
    """Return all pairs of so many crossings."""
    return [(one, other) for other in range(sides) for one in range(other)]


def _least_cosine(patches: Patches, normal: Vectors, pairs: list[tuple[int, int]]) -> Numbers:
    """Return the least cosine of the normals of some pairs of each patch's crossings, (P,)."""
    least: Numbers = np.full(len(patches.row), np.inf)
    for one, other in pairs:
        first, second = patches.crossing[:, one], patches.crossing[:, other]
        rows = np.flatnonzero((first >= 0) & (second >= 0))
        cosine = dot(normal[first[rows]], normal[second[rows]])
        least[rows] = np.minimum(least[rows], cosine)
    return least


def evidence_of(
    patches: Patches, planes: Planes, own: Planes, both: tuple[Wedges, Wedges], nearby: Nearby,
    factor: int,
) -> Vectors:  # fmt: skip
    """Return what speaks for an edge in each patch and against it, (f, 10), in coarse spacings.

    ``both`` are the wedges by the planes alone, and those that lean on spheres. Of the patch: the
    cosine of the settled normals, and of the field's own; how far planes were settled; the
    logarithm of the trust in the flattest ground. Then what is averaged along the chain: the own
    cosine; how far the trust in the roughest ground is over a tenth; by how much a sphere is
    pierced; how many are touched; how far spheres moved the point; how far it is outside.
    """
    start, wedges = both
    contact, count = contact_of(wedges, nearby), len(patches.row)
    there, crossing = patches.there, patches.crossing
    own_cosine = _least_cosine(patches, own.normal, pairs_of(crossing.shape[1]))
    settled = np.where(there, length(planes.point[crossing] - own.point[crossing]), 0).max(1)
    trust = planes.trust[crossing]
    flattest = np.log(np.where(there, trust, 0).max(1) + 1e-3)
    roughest = np.log(np.where(there, trust, np.inf).min(1) + 1e-3)
    pierced: Numbers = np.full(count, -0.1)
    close = contact.is_close
    np.maximum.at(pierced, nearby.wedge[close], -contact.gap[close])
    touching = contact.in_cone & (np.abs(contact.gap) < TOUCHING)
    touched = nearby.count_of(touching & (np.abs(contact.along) < TOUCHED_ALONG), count)
    middle = mean_of(patches, own.point) / factor
    columns = (
        *(start.cosine, own_cosine, settled / factor, flattest),
        *(own_cosine, np.maximum(roughest - np.log(0.1), 0)),
        *(np.clip(pierced, 0, 0.15), np.minimum(touched, 3)),
        np.minimum(length(wedges.point - start.point), 0.15),
        dot(wedges.point - middle, unit(mean_of(patches, planes.normal))),
    )
    return np.stack(columns, 1).astype(np.float64)


def mean_along_chain(patches: Patches, evidence: Vectors, count: int) -> Vectors:
    """Return the evidence of patches (f, n) averaged over those that they are joined to."""
    patch, crossing = patches.joined()
    used, crossing = np.unique(crossing, return_inverse=True)
    shared = np.bincount(crossing, minlength=len(used))
    mean = evidence
    for _ in range(CHAIN_ROUNDS):
        columns = []
        for column in mean.T:
            at_crossing = np.bincount(crossing, column[patch], len(used)) / shared
            columns.append(np.bincount(patch, at_crossing[crossing], len(mean)) / patches.sides)
        mean = np.stack(columns, 1)
    return mean


def move_beside(patches: Patches, own: Planes, candidates: Candidates, share: Numbers) -> Vectors:
    """Return the positions of all crossings, (n, 3), those beside features on settled planes.

    They go as far as the nearest feature goes to the edge, ``share`` (f,), and less with the
    distance from it: otherwise there would be a step.
    """
    sure, inside = np.flatnonzero(share > LEAST_SHARE), candidates.inside
    features = np.searchsorted(inside, candidates.patch[sure])
    distance, nearest = nearest_feature(
        patches.chosen(inside), features, candidates.edge[sure], own.point, MOVED_RINGS
    )
    moved = np.append(share[sure], 0)[nearest]
    moved *= np.clip((FADED_OUT - distance) / (FADED_OUT - FADING), 0, 1)
    shift = candidates.planes.point - own.point
    shift *= np.minimum(1, FARTHEST_MOVE / np.maximum(length(shift), 1e-12))[:, None]
    position: Vectors = own.point + moved[:, None] * shift
    return position


def nearest_feature(
    patches: Patches, features: Index, vertex: Vectors, point: Vectors, rings: int
) -> tuple[Numbers, Index]:
    """Return the distance (n,) of crossings to a vertex within some rings of patches, and whose."""
    distance: Numbers = np.full(len(point), np.inf)
    nearest = np.full(len(point), -1, np.int64)
    known = np.full(len(patches.row), -1, np.int64)
    known[features] = np.arange(len(features))
    patch, crossing = patches.joined()
    for _ in range(rings):
        here = np.flatnonzero(known[patch] >= 0)
        peak, at = known[patch[here]], crossing[here]
        apart = length(point[at] - vertex[peak])
        np.minimum.at(distance, at, apart)
        best = apart == distance[at]
        nearest[at[best]] = peak[best]
        away = np.where(patches.there, distance[patches.crossing], np.inf)
        chosen = np.take_along_axis(patches.crossing, away.argmin(1)[:, None], 1)[:, 0]
        known = np.where(np.isfinite(away.min(1)), nearest[chosen], -1)
    return distance, nearest
