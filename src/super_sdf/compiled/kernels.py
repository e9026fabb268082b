"""The loops behind ``compiled``: what numba makes machine code of.

Without types in the signatures: numba finds them. Operations, their order and their precision are
those of the NumPy functions, so all constants that meet single precision are single, too.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ..mesh import CLEARANCE
from ..neighbourhood import CENTRE, STRIDES
from ..steps.marching import CAP_HEIGHT
from ..steps.spheres import DIRECTIONS

compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def wake():
    """Do nothing."""


@compiled
def number_parts(table, sizes, sharers, seen, first_sharer, starts, owned):
    """Number the parts of blocks; return how many nodes there are."""
    count = np.int64(0)
    for voxel in range(len(table)):
        for part in range(27):
            for at in range(first_sharer[part], first_sharer[part + 1]):
                owner = table[voxel, sharers[at]]
                if owner >= 0:
                    break
            if owner == voxel:
                owned[voxel, part] = True
                starts[voxel, part] = count
                count += sizes[part]
            else:  # an earlier voxel: it has its number already
                starts[voxel, part] = starts[owner, seen[at]]
    return count


@compiled
def pin(values, starts, skipped, shared, sizes, inner, outer, changed):
    """Give nodes shared with skipped voxels their sign."""
    for voxel in range(len(starts)):
        for place in range(27):
            if skipped[voxel, place] == 0:
                continue
            outside = skipped[voxel, place] > 0
            for part in range(27):
                if not shared[place, part]:
                    continue
                for node in range(starts[voxel, part], starts[voxel, part] + sizes[part]):
                    if (values[node] > 0) != outside:
                        changed[node] = True
                        values[node] = outer if outside else inner


@compiled
def average(
    blocks, table, starts, owned, columns, first_column, sharers, seen, first_sharer,
    first, last, values,
):  # fmt: skip
    """Average what the sharers of each part say."""
    for voxel in range(first, last):
        for part in range(27):
            if not owned[voxel, part]:
                continue
            for nth in range(first_column[part + 1] - first_column[part]):
                total, times = 0.0, 0
                for at in range(first_sharer[part], first_sharer[part + 1]):
                    other = table[voxel, sharers[at]]
                    if other >= 0:
                        total += blocks[other, columns[first_column[seen[at]] + nth]]
                        times += 1
                values[starts[voxel, part] + nth] = total / times


@compiled
def carry(
    values, starts, part, place, side, finer_starts, finer_owned, finer_part, finer_place,
    finer_side, low, share, first, last, onto,
):  # fmt: skip
    """Carry values to a finer lattice: along x, then y, then z."""
    coarse = np.empty((side, side, side), np.float32)
    along_x = np.empty((finer_side, side, side), np.float32)
    along_y = np.empty((finer_side, finer_side, side), np.float32)
    for voxel in range(first, last):
        for node in range(side * side * side):
            coarse.flat[node] = values[starts[voxel, part[node]] + place[node]]
        for i in range(finer_side):
            for j in range(side):
                for k in range(side):
                    below, above = coarse[low[i], j, k], coarse[low[i] + 1, j, k]
                    along_x[i, j, k] = below + (above - below) * share[i]
        for i in range(finer_side):
            for j in range(finer_side):
                for k in range(side):
                    below, above = along_x[i, low[j], k], along_x[i, low[j] + 1, k]
                    along_y[i, j, k] = below + (above - below) * share[j]
        node = 0
        for i in range(finer_side):
            for j in range(finer_side):
                for k in range(finer_side):
                    if finer_owned[voxel, finer_part[node]]:
                        below, above = along_y[i, j, low[k]], along_y[i, j, low[k] + 1]
                        number = finer_starts[voxel, finer_part[node]] + finer_place[node]
                        onto[number] += below + (above - below) * share[k]
                    node += 1


@compiled
def add(rows, place, values, weights, starts, part, place_in_part, cells, sums):
    """Add what is said at places to the sums of the nodes round them."""
    side = cells + 1
    for n in range(len(rows)):
        x, tx = _cell(place[0, n], cells)
        y, ty = _cell(place[1, n], cells)
        z, tz = _cell(place[2, n], cells)
        value = np.float64(values[n])
        for corner in range(8):
            dx, dy, dz = corner >> 2, corner >> 1 & 1, corner & 1
            node = ((x + dx) * side + y + dy) * side + z + dz
            number = starts[rows[n], part[node]] + place_in_part[node]
            share = _side(tx, dx) * _side(ty, dy) * _side(tz, dz)
            spoken = np.float64(share * weights[n])
            for power in range(3):
                sums[power, number] += spoken
                spoken = spoken * value


@compiled
def _cell(place, cells):
    """Return the cell that a place lies in along an axis, and where in it."""
    scaled = place * np.float32(cells)
    low = min(np.int32(scaled), np.int32(cells - 1))
    return low, scaled - np.float32(low)


@compiled
def _side(share, upper):
    """Return the weight of a cell's upper or lower side."""
    return share if upper else np.float32(1) - share


_CENTRE, _STEP = CENTRE, tuple(int(step) for step in STRIDES)


@compiled
def find_foot_points(
    values, starts, part, place_in_part, cells, patches, exact, table, row_of, rows, place, value,
    cosine,
):  # fmt: skip
    """Find the best foot point of each sample."""
    half = np.float32(0.5)
    for n in range(len(exact)):
        voxel = exact[n]
        distance = patches[voxel, _CENTRE]
        dx, dy, dz = _unit(
            patches[voxel, _CENTRE + _STEP[0]] - patches[voxel, _CENTRE - _STEP[0]],
            patches[voxel, _CENTRE + _STEP[1]] - patches[voxel, _CENTRE - _STEP[1]],
            patches[voxel, _CENTRE + _STEP[2]] - patches[voxel, _CENTRE - _STEP[2]],
        )
        sign = np.copysign(np.float32(1), distance)
        nearest = np.float32(np.inf)
        rows[n] = -1
        for _ in range(DIRECTIONS):
            aside_x, x = _locate(-distance * dx * half)
            aside_y, y = _locate(-distance * dy * half)
            aside_z, z = _locate(-distance * dz * half)
            at = _CENTRE + _STEP[0] * aside_x + _STEP[1] * aside_y + _STEP[2] * aside_z
            row = row_of[table[voxel, at]]
            if row < 0:
                break  # the direction stays, and so do the tries
            there, gx, gy, gz = _read(values, starts[row], part, place_in_part, cells, x, y, z)
            nx, ny, nz = _unit(gx, gy, gz)
            clearance = sign * there
            if rows[n] < 0 or clearance < nearest:
                nearest = clearance
                rows[n], value[n] = row, there
                place[0, n], place[1, n], place[2, n] = x, y, z
                cosine[n] = dx * nx + dy * ny + dz * nz
            dx, dy, dz = _unit(dx + nx, dy + ny, dz + nz)


@compiled
def _unit(x, y, z):
    length = max(np.sqrt(x * x + y * y + z * z), np.float32(1e-6))
    return x / length, y / length, z / length


@compiled
def _locate(half):
    """Return how many voxels aside a point lies along an axis, and where in that voxel."""
    aside = min(max(np.rint(half), np.float32(-1)), np.float32(1))
    where = half - aside + np.float32(0.5)
    return np.int32(aside), min(max(where, np.float32(0)), np.float32(1))


@compiled
def _read(values, starts, part, place_in_part, cells, px, py, pz):
    """See ``lattice.read``, at one place."""
    side = cells + 1
    low_x, x = _cell(px, cells)
    low_y, y = _cell(py, cells)
    low_z, z = _cell(pz, cells)
    first = (low_x * side + low_y) * side + low_z
    v000 = _at(values, starts, part, place_in_part, first)
    v001 = _at(values, starts, part, place_in_part, first + 1)
    v010 = _at(values, starts, part, place_in_part, first + side)
    v011 = _at(values, starts, part, place_in_part, first + side + 1)
    v100 = _at(values, starts, part, place_in_part, first + side * side)
    v101 = _at(values, starts, part, place_in_part, first + side * side + 1)
    v110 = _at(values, starts, part, place_in_part, first + side * side + side)
    v111 = _at(values, starts, part, place_in_part, first + side * side + side + 1)
    z00, z01, z10, z11 = v001 - v000, v011 - v010, v101 - v100, v111 - v110
    at00, at01, at10, at11 = v000 + z00 * z, v010 + z01 * z, v100 + z10 * z, v110 + z11 * z
    y0, y1 = at01 - at00, at11 - at10
    at0, at1 = at00 + y0 * y, at10 + y1 * y
    along_x = at1 - at0
    slope0, slope1 = z00 + (z01 - z00) * y, z10 + (z11 - z10) * y
    along_y, along_z = y0 + (y1 - y0) * x, slope0 + (slope1 - slope0) * x
    return at0 + along_x * x, along_x, along_y, along_z


@compiled
def _at(values, starts, part, place_in_part, node):
    return values[starts[part[node]] + place_in_part[node]]


@compiled
def count_vertices(values, starts, owned, part, place, start, end, edge_part, times):
    """Count the vertices of each voxel."""
    inside = np.empty(len(part), np.bool_)
    for voxel in range(len(starts)):
        if _fill_inside(values, starts[voxel], part, place, inside):
            for edge in range(len(start)):
                if inside[start[edge]] != inside[end[edge]] and owned[voxel, edge_part[edge]]:
                    times[voxel] += 1


@compiled
def _fill_inside(values, starts, part, place, inside):
    """Say which nodes of a block are inside; return whether it holds both."""
    number = 0
    for node in range(len(part)):
        inside[node] = values[starts[part[node]] + place[node]] <= 0
        number += inside[node]
    return 0 < number < len(part)


@compiled
def make_vertices(
    values, starts, owned, part, place, axis, start, end, edge_part, firsts, ijk, factor, block,
    lattice, first, own, last, first_node, vertex_at, position,
):  # fmt: skip
    """Name and place the vertices of voxels: positions from voxel ``own`` on."""
    inside = np.empty(len(part), np.bool_)
    for voxel in range(first, last):
        if not _fill_inside(values, starts[voxel], part, place, inside):
            continue
        number = firsts[voxel]
        for edge in range(len(start)):
            low, high = start[edge], end[edge]
            if inside[low] == inside[high] or not owned[voxel, edge_part[edge]]:
                continue
            node = starts[voxel, part[low]] + place[low]
            if node >= first_node:
                vertex_at[3 * (node - first_node) + axis[edge]] = number
            if voxel >= own:
                below = np.float64(values[node])
                above = np.float64(values[starts[voxel, part[high]] + place[high]])
                share = min(max(below / (below - above), CLEARANCE), 1 - CLEARANCE)
                for a in range(3):
                    at = np.float64(factor * ijk[voxel, a] + block[low, a])
                    begin = _onto_border(at, lattice[a])
                    stop = _onto_border(at + (1.0 if a == axis[edge] else 0.0), lattice[a])
                    position[number - firsts[own], a] = begin + share * (stop - begin)
            number += 1


@compiled
def _onto_border(position, nodes):
    return min(max(position, -CAP_HEIGHT), nodes + CAP_HEIGHT)


@compiled
def make_triangles(
    values, starts, owned, part, place, low, corners, edge_start, edge_axis, counts, table,
    first, last, first_node, vertex_at, faces,
):  # fmt: skip
    """Make the triangles of voxels; return how many."""
    inside = np.empty(len(part), np.bool_)
    total = 0
    for voxel in range(first, last):
        if not _fill_inside(values, starts[voxel], part, place, inside):
            continue
        for cell in range(len(low)):
            case = _case(inside, low[cell], corners)
            for nth in range(counts[case]):
                for corner in range(3):
                    edge = table[case, nth, corner]
                    node = low[cell] + edge_start[edge]
                    number = starts[voxel, part[node]] + place[node] - first_node
                    faces[total, corner] = vertex_at[3 * number + edge_axis[edge]]
                total += 1
    return total


@compiled
def _case(inside, low, corners):
    case = 0
    for corner in range(8):
        case |= np.int64(inside[low + corners[corner]]) << corner
    return case
