"""Compiled twins of the functions that take most of the time after the network (extra ``fast``).

Each has the name and the arguments of a function of ``nodes``, ``lattice``, ``spheres`` or
``isosurface``, and the same results bit for bit. The loops are in ``kernels``; they run without
Python's lock, so chunks run side by side.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray, Signs
from ..compiled import kernels
from ..steps.cell_cases import CORNERS, EDGE_AXIS, EDGE_START, triangle_table
from ..steps.field import FineField
from ..steps.interpolation import Said, finer_places
from ..steps.marching import edges_of_block
from ..steps.nodes import (
    BARELY_INSIDE,
    BARELY_OUTSIDE,
    SHARING,
    SharedNodes,
    block_ijk,
    nodes_of_part,
    part_of_node,
    seen_from,
)
from ..steps.spheres import Samples

Arrays = tuple[NDArray[Any], ...]


def is_on_disk() -> bool:
    """Say whether machine code was kept by an earlier process: else all is compiled anew."""
    folder, last = Path(kernels.make_triangles.stats.cache_path), kernels.make_triangles.__name__
    return any(folder.glob(f"kernels.{last}-*.nbi"))


def wake() -> None:
    """Call something, so that the next call is quick."""
    kernels.wake()


@lru_cache
def _parts(factor: int) -> Arrays:
    """Return the block nodes of all parts in a row, and where each part's begin."""
    columns = nodes_of_part(factor)
    ends = np.cumsum([0, *map(len, columns)])
    return np.concatenate(columns).astype(np.int32), ends.astype(np.int32)


@lru_cache
def _sharers() -> Arrays:
    """Return who shares each part, as which part of theirs, in a row, and where each begins."""
    seen = [seen_from(part, place) for part in range(27) for place in SHARING[part]]
    ends = np.cumsum([0, *map(len, SHARING)])
    return tuple(np.asarray(a).astype(np.int32) for a in (np.concatenate(SHARING), seen, ends))


def number_parts(table: IntArray, sizes: IntArray) -> tuple[IntArray, BoolArray, int]:
    """See ``nodes._number_parts``."""
    starts, owned = np.empty_like(table), np.zeros(table.shape, np.bool_)
    count = kernels.number_parts(table, sizes, *_sharers(), starts, owned)
    return starts, owned, int(count)


def pin(values: FloatArray, nodes: SharedNodes, skipped: Signs, changed: BoolArray) -> None:
    """See ``nodes._pin``."""
    _, ends = _parts(nodes.factor)
    shared = np.array([[place in sharing for sharing in SHARING] for place in range(27)])
    barely = BARELY_INSIDE, BARELY_OUTSIDE
    kernels.pin(values, nodes.starts, skipped, shared, np.diff(ends), *barely, changed)


def average_chunk(blocks: FloatArray, nodes: SharedNodes, rows: slice, values: FloatArray) -> None:
    """See ``nodes._average_chunk``."""
    tables = *_parts(nodes.factor), *_sharers()
    shared = nodes.table, nodes.starts, nodes.owned
    kernels.average(blocks, *shared, *tables, rows.start, rows.stop, values)


def carry_chunk(
    values: FloatArray, nodes: SharedNodes, finer: SharedNodes, rows: slice, onto: FloatArray
) -> None:
    """See ``lattice._carry_chunk``."""
    kernels.carry(
        values, nodes.starts, *part_of_node(nodes.factor), nodes.factor + 1,
        finer.starts, finer.owned, *part_of_node(finer.factor), finer.factor + 1,
        *finer_places(nodes.factor, finer.factor), rows.start, rows.stop, onto,
    )  # fmt: skip


def add_chunk(said: Said, nodes: SharedNodes, chunk: slice, sums: NDArray[np.float64]) -> None:
    """See ``lattice._add_chunk``."""
    spoken = said.rows[chunk], said.place[:, chunk], said.values[chunk], said.weights[chunk]
    kernels.add(*spoken, nodes.starts, *part_of_node(nodes.factor), nodes.factor, sums)


def find_chunk(
    values: FloatArray, nodes: SharedNodes, samples: Samples, chunk: slice
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """See ``spheres._find_chunk``."""
    exact = samples.exact[chunk]
    rows, place = np.empty(len(exact), np.int32), np.zeros((3, len(exact)), np.float32)
    value, cosine = np.zeros((2, len(exact)), np.float32)
    kernels.find_foot_points(
        values, nodes.starts, *part_of_node(nodes.factor), nodes.factor, samples.patches, exact,
        samples.table, samples.row_of, rows, place, value, cosine,
    )  # fmt: skip
    return rows, place, value, cosine


def count_chunk(field: FineField, rows: slice) -> IntArray:
    """See ``isosurface._count_chunk``."""
    edges, nodes = edges_of_block(field.factor), field.nodes
    times = np.zeros(rows.stop - rows.start, np.int32)
    kernels.count_vertices(
        field.values, nodes.starts[rows], nodes.owned[rows], *part_of_node(field.factor),
        edges.start, edges.end, edges.part, times,
    )  # fmt: skip
    return times


def extract_rows(
    field: FineField, firsts: NDArray[np.int64], before: slice, rows: slice
) -> tuple[NDArray[np.float64], IntArray]:
    """See ``isosurface._extract_rows``."""
    nodes, edges = field.nodes, edges_of_block(field.factor)
    first_node = nodes.owned_before(before.start)
    vertex_at = np.empty(3 * (nodes.owned_before(rows.stop) - first_node), np.int32)
    shared = field.values, nodes.starts, nodes.owned, *part_of_node(field.factor)
    own = edges.axis, edges.start, edges.end, edges.part
    position = np.empty((firsts[rows.stop] - firsts[rows.start], 3))
    lattice = np.array(field.shape) * field.factor
    kernels.make_vertices(
        *shared, *own, firsts, np.ascontiguousarray(field.voxel_ijk), field.factor,
        block_ijk(field.factor), lattice, before.start, rows.start, rows.stop, first_node,
        vertex_at, position,
    )  # fmt: skip
    # A vertex lies in four cells, and a cell has fewer triangles than vertices.
    faces = np.empty((4 * (firsts[rows.stop] - firsts[before.start]), 3), np.int32)
    cells = *_cells(field.factor), rows.start, rows.stop
    count = kernels.make_triangles(*shared, *cells, first_node, vertex_at, faces)
    return position, faces[:count].copy()


@lru_cache
def _cells(factor: int) -> Arrays:
    """Return the low node of each cell of a block, its corners, its edges, and the triangles."""
    step = np.array([(factor + 1) ** 2, factor + 1, 1])
    block = block_ijk(factor)
    low = np.flatnonzero((block < factor).all(1))
    corners = CORNERS @ step
    arrays = low, corners, corners[list(EDGE_START)], np.array(EDGE_AXIS), *triangle_table()
    return tuple(array.astype(np.int32) for array in arrays)
