"""One file to another: a grid is read, refined, meshed and written, and what came of it is told.

>>> from super_sdf.convert import ConvertOptions, convert
>>> convert("part.npz", "part.ply", load_network(), ConvertOptions())    # doctest: +SKIP
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .arrays import Triple
from .files.expectation import Expectation, expect
from .files.grids import read_grid
from .files.meshes import write_pieces
from .files.precision import check_format_holds, local_origin_note
from .grid.sdf_grid import SdfGrid
from .grid.spacing import as_triple
from .mesh import Mesh
from .network.decoder import Decoder
from .pipeline import Piece, reconstruct_slabs
from .progress import Progress, Stopwatch
from .steps.nodes import check_factor


@dataclass(frozen=True)
class ConvertOptions:
    """What is asked of a conversion; see ``read_grid`` and ``reconstruct``."""

    factor: int = 4
    spacing: tuple[float, ...] | None = None
    origin: tuple[float, ...] | None = None
    inside: str = "auto"
    offset: float = 0.0
    cap: bool = False
    max_memory: int | None = None


COUNTS = (
    "band_voxels",
    "noisy_voxels",
    "decoded_voxels",
    "nodes",
    "vertices",
    "triangles",
    "pinned_nodes",
    "slabs",
    "planned_bytes",
)


@dataclass(frozen=True)
class Conversion:
    """What came of a conversion.

    Attributes
    ----------
    shape, spacing, origin
        The grid's.
    counts : dict
        Voxels, nodes, vertices and triangles, by name; what was expected of the file before.
    bounds : two Triples
        The lowest and the highest coordinates of vertices.
    closed : bool
        Whether the mesh has no open edge. Not counted: the mesh is a closed manifold by
        construction unless the surface runs out of the grid, and then too if it is capped.
    notes, warnings : tuple of str
        What was inferred, and what a user should know, a sentence each.
    seconds : dict
        The time that each stage took.
    """

    shape: tuple[int, int, int]
    spacing: Triple
    origin: Triple
    counts: dict[str, int]
    bounds: tuple[Triple, Triple]
    closed: bool
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    seconds: dict[str, float]

    def report(self) -> dict[str, Any]:
        """Return counts and findings as they stand in JSON."""
        return {
            "shape": list(self.shape),
            "spacing": list(self.spacing),
            "origin": list(self.origin),
            **self.counts,
            "bounds": [list(corner) for corner in self.bounds],
            "closed": self.closed,
            "inferred": list(self.notes),
            "warnings": list(self.warnings),
        }


def convert(
    source: str | Path,
    target: str | Path,
    network: Decoder,
    options: ConvertOptions,
    *,
    force: bool = False,
    progress: Progress | None = None,
    before_rename: Callable[[Path], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> Conversion:
    """Convert a grid file to a mesh file.

    Parameters
    ----------
    source, target : path
        As ``read_grid`` and ``write_mesh`` want them.
    network : Network
        From ``load_network``; it serves any number of files.
    options : ConvertOptions
        What is asked.
    force : bool
        Replace the target if it exists.
    progress : callable, optional
        Called with (done, total), see ``progress.Progress``; what it raises ends the work.
    before_rename : callable, optional
        Called with the path of the finished mesh, before it takes the target's name.
    announce : callable, optional
        Called before the work with a sentence on the size of the file, if that will be large.

    Raises
    ------
    SuperSdfError
        As ``read_grid``, ``upsample`` and ``write_mesh`` raise it; nothing was written then.
    """
    watch = Stopwatch()
    grid = read_grid(
        source,
        spacing=options.spacing,
        origin=options.origin,
        inside=options.inside,
        max_memory=options.max_memory,
    )
    check_factor(options.factor)
    about = check_format_holds(target, grid, options.factor)
    notes = (*grid.notes, *local_origin_note(target, about))
    expected = expect(grid, options.factor, options.offset, target)
    if announce and (said := expected.said(target)):
        announce(said)
    watch.lap("read")
    pieces = reconstruct_slabs(
        grid,
        network,
        options.factor,
        offset=options.offset,
        cap=options.cap,
        max_memory=options.max_memory,
        progress=progress,
    )
    total = Total(expected)
    meshes = total.count(pieces, watch)
    write_pieces(meshes, target, force=force, about=about, before_rename=before_rename)
    watch.lap("write")
    return describe(grid, total, options, watch.seconds, notes)


class Total:
    """What there is to say of all pieces of a mesh."""

    def __init__(self, expected: Expectation) -> None:
        self.expected = expected
        self.counts: Counter[str] = Counter()
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self.is_cut = False

    def count(self, pieces: Iterable[Piece], watch: Stopwatch) -> Iterator[Mesh]:
        """Pass the meshes on, and count; the time until the next is asked for is for writing."""
        for piece in pieces:
            watch.take(piece.seconds)
            self.is_cut |= piece.is_cut
            self.counts.update(piece.counts)
            self.counts |= Counter(piece.whole)
            for mesh in piece.meshes:
                self.reach(mesh)
            yield from piece.meshes
            del piece  # before the next is made
            watch.lap("write")

    def reach(self, mesh: Mesh) -> None:
        """Take a mesh into the box."""
        if len(mesh.vertices):
            self.low = np.minimum(self.low, mesh.vertices.min(0))
            self.high = np.maximum(self.high, mesh.vertices.max(0))


def describe(
    grid: SdfGrid,
    total: Total,
    options: ConvertOptions,
    seconds: dict[str, float],
    notes: tuple[str, ...],
) -> Conversion:
    """Say what was made."""
    closed = options.cap or not total.is_cut
    counts = {name: total.counts[name] for name in COUNTS}
    counts["expected_triangles"] = total.expected.triangles
    counts["expected_bytes"] = total.expected.size
    warnings = find_warnings(counts, closed)
    where = grid.shape, grid.spacing, grid.origin
    bounds = as_triple(total.low, "low"), as_triple(total.high, "high")
    return Conversion(*where, counts, bounds, closed, notes, warnings, seconds)


def find_warnings(counts: dict[str, int], closed: bool) -> tuple[str, ...]:
    """Return what a user should know of the result."""
    warnings = []
    if not closed:
        warnings.append("the surface runs out of the grid and is open there (close it with --cap)")
    if counts["noisy_voxels"]:
        share = in_percent(counts["noisy_voxels"], counts["band_voxels"])
        warnings.append(
            f"in {share} of the band the values differ by more than distances can: they "
            "are taken for noisy there, and corrected"
        )
    if counts["pinned_nodes"]:
        warnings.append(
            f"{counts['pinned_nodes']} fine values contradict the coarse ones around them and were "
            "given their sign: the input is no distance field there"
        )
    return tuple(warnings)


def in_percent(part: int, whole: int) -> str:
    """Return a share that is not 0 in two digits, as one says it."""
    share = 100 * part / whole
    if share < 0.01:
        return "less than 0.01 %"
    return f"{share:.0f} %" if share >= 9.95 else f"{share:.2g} %"
