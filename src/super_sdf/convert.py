"""Conversion of one grid file to one mesh file: read, refine, extract the surface, write, report.

>>> from super_sdf.convert import ConvertOptions, convert
>>> convert("part.npz", "part.ply", load_network(), ConvertOptions())    # doctest: +SKIP
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from .arrays import Triple
from .errors import MeshError
from .files.expectation import CERTAIN_SHARE, Expectation, expect
from .files.grids import read_grid_with
from .files.meshes import write_pieces
from .files.output import check_apart
from .files.precision import check_format_holds, local_origin_note
from .files.store import files_of
from .grid.cubic import cubic_grid
from .grid.direction import Direction
from .grid.field import EXACT, MASK, SCALED
from .grid.sdf_grid import SdfGrid
from .grid.spacing import as_triple
from .mesh import Mesh, join_meshes
from .network.decoder import Decoder
from .options import check_goal
from .pipeline import reconstruct_slabs
from .progress import Progress, Stopwatch, part_of, share_of
from .simplification.simplify import (
    Simplified,
    check_can_simplify,
    check_room,
    simplify_mesh,
)
from .slabs.pieces import Piece
from .steps.cap import check_all_seen, check_can_close
from .steps.lattice import lattice_shape
from .steps.mesher_names import DEFAULT_MESHER
from .steps.meshers import find_mesher
from .steps.nodes import check_factor
from .topology import OpenEdges

if TYPE_CHECKING:
    from .fields.writing import FieldFile

DROPPED = "pieces smaller than a voxel that no sample supports, and so left out: {}"
LONE = "voxels of the mask without a neighbour on their side, each meshed as a piece: {}"
CAPPED = (
    "the solid runs out of the grid: its surface is closed along the border (leave it open with "
    "--open)"
)
SHARE_BEFORE = 0.2  # of the time, until the mesh is simplified


@dataclass(frozen=True)
class ConvertOptions:
    """The options of a conversion; see ``read_grid``, ``reconstruct`` and ``simplify_mesh``.

    ``cap`` is True by default, as for the command, and unlike in ``reconstruct``. ``simplify`` is
    an error in voxels; at most one of it and ``triangles`` may be given.
    """

    factor: int = 4
    spacing: tuple[float, ...] | None = None
    origin: tuple[float, ...] | None = None
    inside: str = "auto"
    offset: float = 0.0
    cap: bool = True
    max_memory: int | None = None
    mesher: str = DEFAULT_MESHER
    simplify: float | None = None
    triangles: int | None = None
    axes: str | None = None
    direction: tuple[float, ...] | None = None
    field: str = "auto"
    label: int | None = None
    level: float | None = None
    scale: float | None = None

    @property
    def simplifies(self) -> bool:
        """Whether the mesh is to be simplified."""
        return self.simplify is not None or self.triangles is not None


COUNTS = (
    "band_voxels",
    "noisy_voxels",
    "decoded_voxels",
    "nodes",
    "vertices",
    "triangles",
    "pinned_nodes",
    "dropped_pieces",
    "lone_samples",
    "slabs",
    "planned_bytes",
)


class Engine(Protocol):
    """Who reads a grid and makes its mesh, such as the workers of a cluster."""

    def read(self, source: str | Path, options: ConvertOptions) -> SdfGrid:
        """Return the grid in a file."""

    def pieces(
        self,
        grid: SdfGrid,
        options: ConvertOptions,
        expected: Expectation,
        progress: Progress | None,
    ) -> Iterator[Piece]:
        """Yield the pieces of the mesh, in order."""

    def report(self) -> dict[str, Any]:
        """Return what ``Conversion.engine`` is, after the work."""

    def warnings(self) -> tuple[str, ...]:
        """Return sentences on what may be wrong with the result, after the work."""


@dataclass(frozen=True)
class Conversion:
    """The result of a conversion.

    Attributes
    ----------
    shape, spacing, origin, direction
        Of the grid; spacing and origin in world units.
    counts : dict
        The counts named in ``COUNTS``, and ``expected_triangles`` and ``expected_bytes``.
    bounds : two Triples
        The lowest and the highest coordinates of the vertices, in world units.
    closed : bool
        Whether the mesh has no open edge, counted while it is written (``topology.OpenEdges``). If
        not, the surface leaves the grid and is not capped.
    notes, warnings : tuple of str
        Sentences on what was inferred, and on what may be wrong with the result.
    seconds : dict
        Seconds per stage.
    simplified : dict, optional
        Of a simplified mesh, what ``Simplified.report`` returns; distances are in voxels.
    capped : bool
        Whether the solid runs out of the grid, and its surface was closed along the border.
    field : dict
        What the values were taken as, and what the samples show of it.
    saved_field : dict, optional
        The path of the refined field, and shape, spacing and origin of the fine lattice.
    engine : dict
        Who did the work, if that was not this process.
    """

    shape: tuple[int, int, int]
    spacing: Triple
    origin: Triple
    direction: Direction
    counts: dict[str, int]
    bounds: tuple[Triple, Triple]
    closed: bool
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    seconds: dict[str, float]
    simplified: dict[str, Any] | None = None
    capped: bool = False
    field: dict[str, Any] = dataclass_field(default_factory=dict)
    saved_field: dict[str, Any] | None = None
    engine: dict[str, Any] = dataclass_field(default_factory=dict)

    def remarks(self) -> list[str]:
        """Return sentences on what the mesh has that the samples do not show, or lacks."""
        dropped, lone = self.counts["dropped_pieces"], self.counts["lone_samples"]
        remarks = [CAPPED] if self.capped else []
        if dropped:
            remarks.append(DROPPED.format(dropped))
        if lone and self.field.get("kind") == MASK:
            remarks.append(LONE.format(lone))
        return remarks

    def report(self) -> dict[str, Any]:
        """Return the result as a dictionary that can be written as JSON."""
        return {
            "shape": list(self.shape),
            "spacing": list(self.spacing),
            "origin": list(self.origin),
            "direction": [list(row) for row in self.direction],
            **self.counts,
            "bounds": [list(corner) for corner in self.bounds],
            "closed": self.closed,
            "capped": self.capped,
            "field": self.field,
            **self.engine,
            **({"saved_field": self.saved_field} if self.saved_field else {}),
            **({"simplified": self.simplified} if self.simplified else {}),
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
    save_field: str | Path | None = None,
    engine: Engine | None = None,
) -> Conversion:
    """Convert a grid file to a mesh file.

    Parameters
    ----------
    source, target : path
        The grid file and the mesh file, in formats of ``read_grid`` and ``write_mesh``.
    network : Network
        From ``load_network``; it can be used for any number of files.
    options : ConvertOptions
        Factor, spacing, axis order, sign, offset, cap, mesher, memory bound and
        simplification.
    force : bool
        Replace the target, and the field's file, if they exist.
    progress : callable, optional
        Called with (done, total), see ``progress.Progress``; an exception in it ends the work.
    before_rename : callable, optional
        Called with the path of the finished temporary file, before it is renamed to ``target``.
    announce : callable, optional
        Called before the work with a sentence on the size of the mesh file, if it will be large.
    save_field : path, optional
        A file for the refined field, in a format of ``write_field``. It and the mesh file are both
        complete at the end, or neither is written.
    engine : Engine, optional
        Who reads the grid and makes the mesh; by default this process, with ``network``.

    Raises
    ------
    SuperSdfError
        As in ``read_grid``, ``upsample``, ``simplify_mesh`` and ``write_mesh``; MeshError if slabs
        or bricks do not meet, as those of processors that round differently. Nothing is written
        then.
    """
    watch = Stopwatch()
    if options.simplifies:
        check_goal(options.simplify, options.triangles, ("simplify", "triangles"))
        check_can_simplify()
    grid = engine.read(source, options) if engine else read_grid_with(source, options)
    check_can_close(grid, cap=options.cap)
    if engine:
        check_all_seen(grid, "convert it on one machine (without --cluster)")
    inputs = files_of(source)
    check_apart(target, inputs)
    if save_field is not None:
        check_apart(save_field, inputs)
    total = _check_work(options)
    lattice = cubic_grid(grid, options.offset)
    about = check_format_holds(target, lattice, total)
    notes = (*lattice.notes, *local_origin_note(target, about))
    expected = expect(grid, total, options.offset, target, cap=options.cap)
    _check_size(expected, target, options, announce)
    tally = Tally(expected, cap=options.cap)
    with open_field(save_field, grid, options, force=force) as file:
        watch.lap("read")
        maker = Maker(grid, network, options, engine, file)
        meshes = _meshes(maker, tally, watch, progress)
        complete = partial(_complete_field, file, force=force, then=before_rename)
        write_pieces(meshes, target, force=force, about=about, before_rename=complete)
    watch.lap("write")
    done = describe(grid, tally, options, watch.seconds, notes)
    if engine:
        warnings = (*done.warnings, *engine.warnings())
        done = replace(done, warnings=warnings, engine=engine.report())
    return replace(done, saved_field=file.report()) if file else done


@dataclass(frozen=True)
class Maker:
    """What makes the pieces of a mesh: a grid, and a network or an engine."""

    grid: SdfGrid
    network: Decoder
    options: ConvertOptions
    engine: Engine | None
    file: FieldFile | None

    def pieces(self, expected: Expectation, progress: Progress | None) -> Iterator[Piece]:
        """Yield the pieces, made while they are taken."""
        options = self.options
        if self.engine:
            return self.engine.pieces(self.grid, options, expected, progress)
        return reconstruct_slabs(
            self.grid,
            self.network,
            options.factor,
            offset=options.offset,
            cap=options.cap,
            mesher=options.mesher,
            max_memory=options.max_memory,
            progress=progress,
            save=self.file.add if self.file else None,
        )


def _check_work(options: ConvertOptions) -> int:
    """Return how many times finer the mesh is than the grid; OptionError if that cannot be done."""
    check_factor(options.factor)
    find_mesher(options.mesher)
    return options.factor


def _check_size(
    expected: Expectation,
    target: str | Path,
    options: ConvertOptions,
    announce: Callable[[str], None] | None,
) -> None:
    """Announce a large file, or check that there is room to simplify the mesh."""
    if options.simplifies:
        least = int(expected.triangles * CERTAIN_SHARE)
        check_room(least, options.max_memory, estimated=True)
    elif announce and (sentence := expected.warning(target)):
        announce(sentence)


def _meshes(
    maker: Maker, tally: Tally, watch: Stopwatch, progress: Progress | None
) -> Iterator[Mesh]:
    """Return the pieces of the mesh, made while they are taken, or the simplified one."""
    options = maker.options
    shown = part_of(progress, 0, SHARE_BEFORE) if options.simplifies else progress
    pieces = maker.pieces(tally.expected, shown)
    meshes = tally.count(pieces, watch)
    if not options.simplifies:
        return meshes
    rest = part_of(progress, SHARE_BEFORE, 1)
    return tally.simplify(meshes, maker.grid.voxel_size, options, watch, rest)


def _complete_field(
    file: FieldFile | None, part: Path, *, force: bool, then: Callable[[Path], None] | None
) -> None:
    """Complete the field's file, and check that it can appear, before the mesh ``part`` does."""
    if file:
        from .fields.writing import check_field_target

        file.finish()
        check_field_target(file.path, force=force)
    if then:
        then(part)


def open_field(
    path: str | Path | None, grid: SdfGrid, options: ConvertOptions, *, force: bool
) -> AbstractContextManager[FieldFile | None]:
    """Return the file to write the refined field to, which appears at the end; None without a path.

    Raises
    ------
    SuperSdfError
        If the file exists, its suffix is unknown, or the field would not fit.
    """
    if path is None:
        return nullcontext()
    # imported here, since few conversions write a field, and the start is part of each
    from .fields.writing import check_field_fits, check_field_target, saving_field

    path, shape = check_field_target(path, force=force), lattice_shape(grid.shape, options.factor)
    check_field_fits(path, shape, options.max_memory)
    return saving_field(path, shape, force=force)


class Tally:
    """Counts and bounding box of a mesh, summed over its pieces while they are written."""

    def __init__(self, expected: Expectation, *, cap: bool) -> None:
        self.expected, self.cap = expected, cap
        self.edges = OpenEdges()
        self.last: Piece | None = None  # without its meshes
        self.counts: Counter[str] = Counter()
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self.is_cut = self.leaves = False
        self.simplified: Simplified | None = None
        self.voxel_size = 1.0

    def count(self, pieces: Iterable[Piece], watch: Stopwatch) -> Iterator[Mesh]:
        """Yield the meshes of the pieces, and count them.

        The time until the caller takes the next mesh counts as writing.

        Raises
        ------
        MeshError
            If the pieces do not meet.
        """
        for piece in pieces:
            watch.take(piece.seconds)
            self.is_cut |= piece.is_cut
            self._count_edges(piece)
            watch.lap("isosurface")
            self.leaves |= piece.leaves
            self.counts.update(piece.counts)
            self.counts |= Counter(piece.whole)
            for mesh in piece.meshes:
                self.extend_box(mesh)
            yield from piece.meshes
            del piece  # before the next one is made
            watch.lap("write")
        if self.last and self.must_be_closed and len(self.edges):
            raise torn(len(self.edges), "in", self.last)

    @property
    def must_be_closed(self) -> bool:
        """Whether the surface so far may end only where the next piece begins."""
        return self.cap or not self.is_cut

    def _count_edges(self, piece: Piece) -> None:
        """Count the edges of a piece; MeshError if edges before it stay open."""
        before, first = self.edges.edges, self.counts["vertices"]
        for mesh in piece.meshes:
            self.edges.add(mesh.faces)
        left = self.edges.before(first)  # no later piece has these vertices
        if not self.must_be_closed:
            left = np.setdiff1d(left, before)  # the others may be on the border of the grid
        if self.last and len(left):
            raise torn(len(left), f"at plane {piece.planes[0]}, between", self.last, piece)
        self.last = replace(piece, meshes=[])

    def simplify(
        self,
        pieces: Iterable[Mesh],
        voxel_size: float,
        options: ConvertOptions,
        watch: Stopwatch,
        progress: Progress | None,
    ) -> Iterator[Mesh]:
        """Yield the mesh of all pieces simplified; counts and bounding box are its own then."""
        found = simplify_mesh(
            join_meshes(list(pieces)),
            error=None if options.simplify is None else options.simplify * voxel_size,
            triangles=options.triangles,
            max_memory=options.max_memory,
            progress=share_of(progress),
        )
        self.simplified, self.voxel_size = found, voxel_size
        self.counts["vertices"] = len(found.mesh.vertices)
        self.counts["triangles"] = len(found.mesh.faces)
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self.extend_box(found.mesh)
        watch.lap("simplify")
        yield found.mesh

    def extend_box(self, mesh: Mesh) -> None:
        """Extend the bounding box by a mesh, axis by axis: five times as fast as ``min(0)``."""
        for axis, coordinates in enumerate(mesh.vertices.T):
            if len(coordinates):
                self.low[axis] = min(self.low[axis], coordinates.min())
                self.high[axis] = max(self.high[axis], coordinates.max())


def torn(count: int, where: str, *pieces: Piece) -> MeshError:
    """Return the error for edges that stay open in or between pieces."""
    made = " and ".join(
        f"planes {piece.planes[0]} to {piece.planes[1] - 1}"
        + f" ({piece.worker})" * bool(piece.worker)
        for piece in pieces
    )
    way = "run it again, and report it if that does not help"
    if pieces[0].worker:
        way = "use workers with the same processor, NumPy and onnxruntime"
    edges = f"{count:,} open edge{'s' * (count > 1)}"
    return MeshError(f"the mesh is torn, with {edges} {where} {made}: {way}")


def describe(
    grid: SdfGrid,
    tally: Tally,
    options: ConvertOptions,
    seconds: dict[str, float],
    notes: tuple[str, ...],
) -> Conversion:
    """Return the result of a conversion."""
    closed = not len(tally.edges)
    counts = {name: tally.counts[name] for name in COUNTS}
    counts["expected_triangles"] = tally.expected.triangles
    counts["expected_bytes"] = tally.expected.size
    ends = grid.field.unseen is not None
    thin = grid.low >= options.offset
    warnings = find_warnings(counts, closed, thin=thin, kind=grid.field.kind, ends=ends)
    simplified = None
    if tally.simplified:
        simplified = tally.simplified.report(tally.voxel_size)
        closed = tally.simplified.mesh.is_closed()
        warnings += tally.simplified.warnings
    where = grid.shape, grid.spacing, grid.origin, grid.direction
    bounds = as_triple(tally.low, "low"), as_triple(tally.high, "high")
    capped = options.cap and tally.leaves
    found = grid.field.report()
    return Conversion(
        *where, counts, bounds, closed, notes, warnings, seconds, simplified, capped, found
    )


def find_warnings(
    counts: dict[str, int],
    closed: bool,
    thin: bool = False,
    kind: str = EXACT,
    ends: bool = False,
) -> tuple[str, ...]:
    """Return a sentence on each thing that may be wrong with the result.

    ``thin`` says that no sample lies inside the solid, ``kind`` what the field is: only distances
    can be noisy, or contradict each other. ``ends``: the surface ends at unknown samples.
    """
    warnings = []
    if not closed and ends:
        warnings.append("the surface ends where samples are unknown, and is open there")
    elif not closed:
        warnings.append("the surface runs out of the grid and is open there (close it with --cap)")
    if thin:
        warnings.append(
            "no sample lies inside: the solid is thinner than the spacing, and its mesh may have "
            "holes"
        )
    if kind in (MASK, SCALED):
        return tuple(warnings)
    if counts["noisy_voxels"]:
        share = in_percent(counts["noisy_voxels"], counts["band_voxels"])
        warnings.append(
            f"in {share} of the band the values differ by more than distances can: they "
            "are taken as noisy there, and corrected"
        )
    if counts["pinned_nodes"]:
        warnings.append(
            f"{counts['pinned_nodes']} fine values contradict the coarse ones around them and were "
            "given their sign: the input is no distance field there"
        )
    return tuple(warnings)


def in_percent(part: int, whole: int) -> str:
    """Return a share, which must not be 0, as a percentage with two digits."""
    share = 100 * part / whole
    if share < 0.01:
        return "less than 0.01 %"
    return f"{share:.0f} %" if share >= 9.95 else f"{share:.2g} %"
