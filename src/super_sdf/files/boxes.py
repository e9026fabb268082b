"""Boxes of a chunked array: read one after the other, so that each chunk is unpacked once.

An array is copied so that its planes of x are contiguous. A box holds whole chunks, and as many of
them side by side as a little memory allows, first along the axis that is fastest in the copy: the
copy is then written in long runs, however the array is chunked.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import prod
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Box: TypeAlias = tuple[slice, slice, slice]
"""Which samples along each axis of an array; all slices have a start and a stop."""

Sizes: TypeAlias = tuple[int, ...]


@dataclass(frozen=True)
class Layout:
    """How an array is copied.

    Attributes
    ----------
    order : three ints
        The axes of the array in the order of the copy, the fastest last.
    box : three ints
        Samples of a box along each axis of the array.
    run : int
        Samples that are contiguous in the copy, of those of a box.
    """

    order: Sizes
    box: Sizes
    run: int


def choose_layout(shape: Sizes, chunks: Sizes, orders: Sequence[Sizes], budget: int) -> Layout:
    """Return the layout with the longest runs; the first of those that are equal.

    Parameters
    ----------
    shape, chunks : three ints
        Samples of the array, and of a chunk, along each axis.
    orders : sequence of three ints each
        The orders of axes that the copy may have.
    budget : int
        Samples that a box may have. It has at least one chunk.
    """
    found = []
    for order in orders:
        box = _grow(shape, chunks, order, budget)
        found.append(Layout(order, box, _run_of(shape, box, order)))
    return max(found, key=lambda layout: layout.run)


def _grow(shape: Sizes, chunks: Sizes, order: Sizes, budget: int) -> Sizes:
    """Return the size of a box: a chunk, made longer along the fastest axis, then the next."""
    box = [min(chunk, count) for chunk, count in zip(chunks, shape)]
    for axis in reversed(order):
        others = prod(box) // box[axis]
        fitting = max(budget // (others * chunks[axis]), 1)
        box[axis] = min(fitting * chunks[axis], shape[axis])
    return tuple(box)


def _run_of(shape: Sizes, box: Sizes, order: Sizes) -> int:
    """Return how many samples of a box are contiguous in the copy."""
    run = 1
    for axis in reversed(order):
        run *= box[axis]
        if box[axis] < shape[axis]:
            break
    return run


def boxes_of(bounds: Sequence[tuple[int, int]], box: Sizes) -> Iterator[Box]:
    """Yield boxes of a size that fill the samples between bounds along each axis.

    They begin at multiples of their size, where chunks begin, but for the first ones.
    """
    yield from product(*(_cuts(low, high, size) for (low, high), size in zip(bounds, box)))


def _cuts(low: int, high: int, size: int) -> list[slice]:
    """Return slices from ``low`` to before ``high`` that end at multiples of a size."""
    inner = range((low // size + 1) * size, high, size)
    ends = [low, *inner, high]
    return [slice(a, b) for a, b in pairwise(ends)]


def runs_of(
    block: NDArray[Any], start: Sizes, shape: Sizes
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield the bytes of a block that are contiguous in an array, and where they begin there.

    Parameters
    ----------
    block : (a, b, c) array
        Contiguous, in C order.
    start : three ints
        Where its first sample is in the array.
    shape : three ints
        Samples of the array, which is in C order.
    """
    _, b, c = shape
    apart = 1 if block.shape[2] == c else 2  # axes along which pieces are apart in the array
    if apart == 1 and block.shape[1] == b:
        apart = 0
    steps = np.array([b * c, c, 1]) * block.itemsize
    first = int(np.dot(start, steps))
    for place in np.ndindex(block.shape[:apart]):
        yield first + int(np.dot(place, steps[:apart])), block[place].reshape(-1).view(np.uint8)
