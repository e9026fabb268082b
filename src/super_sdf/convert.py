"""One file to another: a grid is read, refined, meshed and written, and what came of it is told.

>>> from super_sdf.convert import ConvertOptions, convert
>>> convert("part.npz", "part.ply", load_network(), ConvertOptions())    # doctest: +SKIP
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .decoder import Decoder
from .files.grids import read_grid
from .files.meshes import write_pieces
from .grid import SdfGrid, Triple
from .mesh import Mesh
from .pipeline import Piece, reconstruct_slabs
from .progress import Progress, Stopwatch


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
        Voxels, nodes, vertices and triangles, by name.
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

    Raises
    ------
    SuperSdfError
        As ``read_grid``, ``upsample`` and ``write_mesh`` raise it; nothing was written then.
    """
    watch = Stopwatch()
    given = {"spacing": options.spacing, "origin": options.origin}
    grid = read_grid(source, inside=options.inside, level=options.offset, **given)
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
    total = Total()
    write_pieces(total.count(pieces, watch), target, force=force)
    watch.lap("write")
    return describe(grid, total, options, watch.seconds)


class Total:
    """What there is to say of all pieces of a mesh."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.is_cut = False

    def count(self, pieces: Iterable[Piece], watch: Stopwatch) -> Iterator[Mesh]:
        """Pass the meshes on, and count; the time until the next is asked for is for writing."""
        for piece in pieces:
            watch.take(piece.seconds)
            self.is_cut |= piece.is_cut
            self.counts.update(piece.counts)
            self.counts |= Counter(piece.whole)
            yield from piece.meshes
            del piece  # before the next is made
            watch.lap("write")


def describe(
    grid: SdfGrid, total: Total, options: ConvertOptions, seconds: dict[str, float]
) -> Conversion:
    """Say what was made."""
    closed = options.cap or not total.is_cut
    counts = {name: total.counts[name] for name in COUNTS}
    warnings = find_warnings(counts, closed)
    where = grid.shape, grid.spacing, grid.origin
    return Conversion(*where, counts, closed, grid.notes, warnings, seconds)


def find_warnings(counts: dict[str, int], closed: bool) -> tuple[str, ...]:
    """Return what a user should know of the result."""
    warnings = []
    if not closed:
        warnings.append("the surface runs out of the grid and is open there (close it with --cap)")
    if counts["noisy_voxels"]:
        share = 100 * counts["noisy_voxels"] / counts["band_voxels"]
        warnings.append(
            f"in {share:.2g} % of the band the values differ by more than distances can: they "
            "are taken for noisy there, and corrected"
        )
    if counts["pinned_nodes"]:
        warnings.append(
            f"{counts['pinned_nodes']} fine values contradict the coarse ones around them and were "
            "given their sign: the input is no distance field there"
        )
    return tuple(warnings)
