"""No triangles that intersect: what folds the surface is undone.

A fan whose vertex lies in its cell, with crossings on their lattice edges, meets no fan of another
cell. So what intersects has a feature's vertex outside its cell, a moved crossing or a turned side.

1. Suspects are vertices round which the surface does not face one way. Their triangles are tested
   against all others whose boxes they overlap.
2. Of a pair that intersects, the feature's vertex that is least outside its cell is pulled into it:
   a corner, which may be farther out, stays. If there is none, all vertices are put back.
3. Triangles that this changes are tested again. Of those that intersect now, all vertices of
   features are pulled into their cells, and crossings go back onto their lattice edges.
4. Twice more; now features are dropped.

Positions are in fine spacings, from node (0, 0, 0) of the fine lattice.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...arrays import BoolArray
from ...network.neighbourhood import NEIGHBOURHOOD
from .patches import (Index, Patches, Placed, Triangles, Vectors, cross, dilate, dot, length, middles, sums_at, triangles_of, unit)
from .triangle_pairs import intersecting, keys_of, overlapping_boxes

# Vertices of triangles that intersect are in cells at most 3 apart: none is more than half a cell
# outside its own, and a triangle has vertices of two cells.
APART = 3
# Whether only the vertex least outside its cell is pulled back, and whether features are dropped.
ROUNDS = ((True, False), (False, False), (False, True), (False, True))
# Cells that the vertices depend on: in each round on such triangles, and on those beside that are
# suspects.
REACH = len(ROUNDS) * (APART + 1) + 2
ONE_WAY = 0.1  # least cosine between normals and their mean where a surface faces one way
LEAST_MOVE = 0.1  # of the way to the nearest node, from which a crossing may fold the surface
INSIDE_CELL = 0.02  # fine spacings from its faces that a vertex is pulled into a cell


def without_folds(patches: Patches, placed: Placed, lattice: Vectors) -> Placed:
    """Return the vertices with fewer features and moves, so that no triangles intersect.

    ``lattice``, (n, 3), are the crossings where they were on their lattice edges.
    """
    suspect = find_suspects(patches, placed, lattice)
    for least, drop in ROUNDS:
        folded = find_folded(patches, placed, suspect, least)
        if not folded.any():
            break
        suspect = beside(patches, placed, folded)
        placed = put_back(patches, placed, lattice, folded)
        if drop:
            left = np.concatenate([np.ones(len(lattice), bool), ~folded[len(lattice) :]])
            suspect, kept = suspect[left], left[len(lattice) :]
            placed = replace(placed, feature=placed.feature[kept], peak=placed.peak[kept])
    return placed


def put_back(patches: Patches, placed: Placed, lattice: Vectors, chosen: BoolArray) -> Placed:
    """Return the vertices, chosen ones on their lattice edges or in their cells.

    Features' vertices are pulled towards the middles of their crossings.
    """
    crossings, peaks = np.split(chosen, [len(lattice)])
    placed = replace(placed, position=np.where(crossings[:, None], lattice, placed.position))
    low = patches.low[placed.feature] + INSIDE_CELL
    high = patches.low[placed.feature] + 1 - INSIDE_CELL
    middle = np.clip(middles(patches, placed), low, high)
    way = placed.peak - middle
    room = np.where(way > 0, high - middle, middle - low)
    share = np.min(room / np.maximum(np.abs(way), 1e-12), axis=1)[:, None]
    pulled = peaks[:, None] & (share < 1)
    return replace(placed, peak=np.where(pulled, middle + share * way, placed.peak))


def find_suspects(patches: Patches, placed: Placed, lattice: Vectors) -> BoolArray:
    """Return the vertices, (n + f,), where fans and moved crossings may fold the surface.

    There it does not face one way: the triangles at the vertex, or the planes of the crossings
    round a node of the lattice, where two sheets may pass.
    """
    to_node = length(lattice - np.rint(lattice))
    moved = length(placed.position - lattice) > LEAST_MOVE * to_node
    changed = np.concatenate([moved, np.ones(len(placed.feature), bool)])
    _, triangles = triangles_at(patches, placed, patches_at(patches, placed, changed))
    a, b, c = (placed.points[corner] for corner in triangles.T)
    normals = np.repeat(unit(cross(b - a, c - a)), 3, axis=0)
    suspect = turns(triangles.ravel(), normals, len(changed))
    nodes, node = np.unique(keys_of(np.rint(lattice)), return_inverse=True)
    sheets = turns(node, placed.normal, len(nodes))[node]
    used = np.zeros(len(changed), bool)
    used[triangles] = True
    suspect[: len(lattice)] |= sheets & used[: len(lattice)]
    return suspect


def turns(place: Index, normals: Vectors, count: int) -> BoolArray:
    """Return which of ``count`` places have normals that do not face one way."""
    mean = unit(sums_at(place, normals, count))
    least = np.ones(count)
    np.minimum.at(least, place, dot(normals, mean[place]))
    found: BoolArray = least < ONE_WAY
    return found


def patches_at(patches: Patches, placed: Placed, chosen: BoolArray) -> BoolArray:
    """Return the patches, (P,), that have some of the vertices, (n + f,)."""
    crossings, peaks = np.split(chosen, [len(placed.position)])
    found: BoolArray = np.any(crossings[patches.crossing] & patches.there, axis=1)
    found[placed.feature[peaks]] = True
    return found


def beside(patches: Patches, placed: Placed, chosen: BoolArray) -> BoolArray:
    """Return vertices, (n + f,): each triangle that changes with chosen ones has one of these."""
    crossings = chosen[: len(placed.position)]
    around = dilate(patches, patches_at(patches, placed, chosen), 1, len(crossings))
    fans = np.any(around[patches.crossing] & patches.there, axis=1)[placed.feature]
    return np.concatenate([crossings, fans])


def triangles_at(patches: Patches, placed: Placed, chosen: BoolArray) -> Triangles:
    """Return the triangles of chosen patches, (P,), as if there were no others."""
    known = np.flatnonzero(chosen[placed.feature])
    feature = (np.cumsum(chosen) - 1)[placed.feature[known]]
    some = replace(placed, feature=feature, peak=placed.peak[known])
    rows, count = np.flatnonzero(chosen), len(placed.position)
    patch, corners = triangles_of(patches.chosen(rows), some)
    return rows[patch], np.concatenate([np.arange(count), count + known])[corners]


def find_folded(patches: Patches, placed: Placed, suspect: BoolArray, least: bool) -> BoolArray:
    """Return the vertices, (n + f,), of pairs of triangles that intersect, one at a suspect.

    With ``least``, of each pair only the vertex that is least outside its cell.
    """
    keys = keys_of(np.floor(patches.low / APART))
    some = np.unique(keys[patches_at(patches, placed, suspect)])
    close = np.isin(keys, some[:, None] + keys_of(NEIGHBOURHOOD))
    _, triangles = triangles_at(patches, placed, close)
    one, other = overlapping_boxes(placed.points, triangles, suspect)
    pairs = np.concatenate(intersecting(placed.points, triangles[one], triangles[other]), 1)
    step = np.zeros(len(suspect))
    if least:
        low = patches.low[placed.feature]
        beyond = np.maximum(low - placed.peak, placed.peak - low - 1).max(1)
        step = np.where(beyond > 0, beyond, 1)
        step = np.concatenate([np.ones(len(placed.position)), step])
    folded = np.zeros(len(suspect), bool)
    folded[pairs[step[pairs] == step[pairs].min(1, initial=1, keepdims=True)]] = True
    return folded
