"""Where the surface has an edge or a corner, and where on it a vertex belongs.

1. Candidates are patches whose planes differ, by the settled planes of the faces beside.
2. Each gets the point where these planes meet, moved so that the samples' spheres agree.
3. ``evidence_of`` gathers what speaks for an edge there and what against it: flat ground on both
   sides, spheres that touch or are pierced. It is averaged along the chain of candidates, since an
   edge has a length, and weighed by a logistic rule.
4. Beside features of which the rule is sure, vertices are moved onto the settled planes.
5. A feature's vertex that would fold the surface goes half way back to the middle of its patch.

The rule was fitted by ``export.edges`` on shapes with and without edges, to whether a vertex on the
edge brings the surface nearer to the true one.

Positions are in fine spacings, from node (0, 0, 0) of the fine lattice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...arrays import BoolArray
from ...machine.resources import map_chunks
from ..field import FineField, SampleSpheres
from .patches import Index, Numbers, Patches, Placed, Vectors, dilate, dot, length, unfolded
from .planes import Planes, settle_planes
from .wedges import Nearby, Wedges, contact_of, find_spheres, lean, wedges_of

SHARP_COSINE = 0.85  # normals of a patch that differ by more, 32 degrees, may make a feature
HALF_ANGLE_COSINE = 0.962  # of a little less than half that angle
LEAST_SLOPE_TRUST = 0.02  # of every crossing of a feature
RINGS = 3  # patches round a candidate, counted from it, in which planes are settled
CHAIN_ROUNDS = 8  # in each, a candidate takes the mean of those it shares a crossing with
SURE = 0.5  # score of a feature from which vertices beside it are moved
MOVED_RINGS = 3  # round a feature, in which vertices may be moved onto the planes: all of them ...
FADING, FADED_OUT = 1.0, 2.5  # ... up to a distance in fine spacings, none from another on
FARTHEST_MOVE = 0.5  # fine spacings
OUTSIDE_CELL = 0.5  # fine spacings by which a feature's vertex may leave its cell
TOUCHING = 0.04  # coarse spacings from a sphere at which it is touched
LEAST_SPHERES = 4  # that pass near a feature: in noise no sample is exact, and normals say nothing
TEMPORARIES = 1000  # numbers per patch in the search for its spheres among 125 samples
TOUCHED_ALONG = 1.0  # coarse spacings along an edge in which spheres are counted


@dataclass(frozen=True, eq=False)
class Rule:
    """The logistic rule that tells features from rounded ground: ``bias + evidence @ weights``."""

    bias: float
    weights: tuple[float, ...]

    def score(self, evidence: Vectors) -> Numbers:
        """Return the score of evidence (f, n), positive for a feature; summed in a fixed order."""
        score: Numbers = np.full(len(evidence), self.bias)
        for weight, column in zip(self.weights, evidence.T):
            score += weight * column
        return score


RULE = Rule(
    0.979, (0.083, 0.940, -88.25, -2.820, -0.340, 0.900, -10.76, -1.843, -1.684, -0.226, -0.253)
)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Patches that may hold an edge or a corner."""

    patch: Index  # (f,), their rows in all patches
    vertex: Vectors  # (f, 3), the edge's nearest point, or the corner, kept near the patch's cell
    evidence: Vectors  # (f, 11), averaged along the chain: see ``evidence_of``
    spheres: NDArray[np.int32]  # (f,), how many spheres pass near the edge
    planes: Planes  # the settled planes of all crossings
    near: BoolArray  # (n,), which crossings were settled

    def score(self) -> Numbers:
        """Return the score of each, (f,), positive for a feature."""
        return np.where(self.spheres < LEAST_SPHERES, -np.inf, RULE.score(self.evidence))


def place_features(
    patches: Patches, own: Planes, turning: BoolArray, field: FineField, threads: int = 1
) -> Placed:
    """Return the positions of all crossings, which patches have a feature, and its vertices."""
    candidates = find_candidates(patches, own, turning, field, threads)
    score = candidates.score()
    kept = score > 0
    position = move_beside(patches, own, candidates, score > SURE)
    normal = candidates.planes.normal
    placed = Placed(position, normal, candidates.patch[kept], candidates.vertex[kept])
    return unfolded(patches, placed)


def find_candidates(
    patches: Patches, own: Planes, turning: BoolArray, field: FineField, threads: int = 1
) -> Candidates:
    """Return the patches that may hold a feature, with its vertex and the evidence for it."""
    seeds = is_sharp(patches, own.normal, own.trust) & turning[patches.row]
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
        threads,
    )
    empty = np.empty((0, 3)), np.empty((0, 11)), np.empty(0, np.int32)
    point, evidence, spheres = (np.concatenate(arrays) for arrays in zip(empty, *parts))
    evidence = mean_along_chain(chosen, evidence, len(own.point))
    low = chosen.low - OUTSIDE_CELL
    vertex = np.clip(field.factor * point, low, low + 1 + 2 * OUTSIDE_CELL)
    return Candidates(inside[sharp], vertex, evidence, spheres, planes, near)


def _measure(
    patches: Patches, planes: Planes, own: Planes, field: FineField
) -> tuple[Vectors, Vectors, NDArray[np.int32]]:
    """Return the point on the edge of some patches, the evidence, and the number of spheres."""
    ijk = field.voxel_ijk[patches.row].astype(np.int64)
    corners = planes.point[patches.crossing] / field.factor, planes.normal[patches.crossing]
    wedges = wedges_of(ijk, *corners, patches.there)
    none = np.empty((0, 3), np.int32), np.empty(0, np.float32)
    nearby = find_spheres(wedges, field.spheres or SampleSpheres(field.shape, *none))
    leaned = lean(wedges, nearby)
    evidence = evidence_of(patches, planes, own, wedges, leaned, nearby)
    count = nearby.count_of(np.ones(len(nearby.wedge), bool), len(evidence))
    return leaned.point, evidence, count


def is_sharp(patches: Patches, normal: Vectors, trust: Numbers) -> BoolArray:
    """Return which patches, (P,), turn by ``SHARP_COSINE``, where the slope is about 1."""
    sides = patches.crossing.shape[1]
    # Where all are within half that angle of the first, no two differ by more.
    pairs = [(0, other) for other in range(1, sides)]
    some = np.flatnonzero(_least_cosine(patches, normal, pairs) < HALF_ANGLE_COSINE)
    pairs = [(one, other) for other in range(sides) for one in range(other)]
    sharp: BoolArray = np.zeros(len(patches.row), bool)
    sharp[some] = _least_cosine(patches.chosen(some), normal, pairs) < SHARP_COSINE
    known = (trust[patches.crossing] >= LEAST_SLOPE_TRUST) | ~patches.there
    return sharp & known.all(1)


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
    patches: Patches, planes: Planes, own: Planes, start: Wedges, wedges: Wedges, nearby: Nearby
) -> Vectors:
    """Return what speaks for a feature in each patch and against it, (f, 11).

    In this order: the logarithm of the trust in its flattest ground, and how far that is over a
    tenth; by how much a sphere is pierced, and by how much all are cleared; whether a sphere is
    touched, and how many; how far the spheres moved the point; the cosine of the normals, and how
    far it is under -0.2, as on a blade; the logarithm of the trust in the field; 1 if convex.
    """
    contact, count = contact_of(wedges, nearby), len(patches.row)
    trust = np.where(patches.there, planes.trust[patches.crossing], np.inf).min(1)
    steady = np.where(patches.there, own.trust[patches.crossing], np.inf).min(1)
    pierced: Numbers = np.full(count, -0.1)
    close = contact.is_close
    np.maximum.at(pierced, nearby.wedge[close], -contact.gap[close])
    touching = contact.in_cone & (np.abs(contact.gap) < TOUCHING)
    touched = nearby.count_of(touching & (np.abs(contact.along) < TOUCHED_ALONG), count)
    support = np.log(trust + 1e-3)
    columns = (
        *(support, np.maximum(support - np.log(0.1), 0)),
        *(np.clip(pierced, 0, 0.15), np.clip(-pierced, 0, 0.1)),
        *(np.minimum(touched, 1), np.minimum(touched, 3)),
        np.minimum(length(wedges.point - start.point), 0.15),
        *(start.cosine, np.maximum(-0.2 - start.cosine, 0)),
        np.log(steady),
        start.convex > 0,
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


def move_beside(patches: Patches, own: Planes, candidates: Candidates, sure: BoolArray) -> Vectors:
    """Return the positions of all crossings, (n, 3), those beside sure features on settled planes.

    The move fades with the distance from the feature: otherwise there would be a step.
    """
    distance = distance_from(
        patches, candidates.patch[sure], candidates.vertex[sure], own.point, MOVED_RINGS
    )
    share = np.clip((FADED_OUT - distance) / (FADED_OUT - FADING), 0, 1) * candidates.near
    shift = candidates.planes.point - own.point
    shift *= np.minimum(1, FARTHEST_MOVE / np.maximum(length(shift), 1e-12))[:, None]
    position: Vectors = own.point + share[:, None] * shift
    return position


def distance_from(
    patches: Patches, features: Index, vertex: Vectors, point: Vectors, rings: int
) -> Numbers:
    """Return the distance of crossings to a feature's vertex within some rings of patches, (n,)."""
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
    return distance
