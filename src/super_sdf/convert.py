"""Conversion of one grid file to one mesh file: read, refine, extract the surface, write, report.

>>> from super_sdf.convert import ConvertOptions, convert
>>> convert("part.npz", "part.ply", load_network(), ConvertOptions())    # doctest: +SKIP
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .arrays import Triple
from .errors import MeshError
from .files.grids import read_grid
from .files.meshes import check_format_holds, check_target, local_origin_note, write_mesh
from .files.output import check_apart, check_free
from .files.regular import files_of
from .grid.cubic import cubic_grid
from .grid.placement import as_triple
from .grid.sdf_grid import SdfGrid
from .machine.extras import check_modules
from .machine.memory import memory_bound
from .network.decoder import Decoder
from .options import MASK, SCALED, SHARP
from .options import ConvertOptions as ConvertOptions
from .pipeline import reconstruct_slabs, upsample
from .progress import Progress, Stopwatch, part_of, share_of
from .refine.field import FineField, lattice_shape
from .refine.survey import Band
from .slabs.preparing import Piece
from .surface.cap import check_can_close
from .surface.mesh import Mesh, join_meshes
from .surface.topology import OpenEdges

if TYPE_CHECKING:
    from .files.fields import FieldFile
    from .simplify.simplify import Simplified

CAPPED = (
    "the solid runs out of the grid: its surface is closed along the border (leave it open with "
    "--open)"
)
DROPPED = "pieces smaller than a voxel that no sample supports, and so left out"
LONE = "voxels of the mask without a neighbour on their side, each meshed as a piece"
KEPT_SHARE = 1 / 16  # of the memory bound: a mesh that takes more is too large to be checked
SHARE_BEFORE = 0.2  # of the time, until the mesh is simplified
COUNTS = (
    *("band_voxels", "noisy_voxels", "decoded_voxels", "nodes", "vertices", "triangles"),
    *("pinned_nodes", "dropped_pieces", "lone_samples", "slabs", "planned_bytes"),
)

MakePieces = Callable[[Progress | None], Iterator[Piece]]
"""Yields the mesh of a grid in pieces, in order, made while they are taken."""


@dataclass(frozen=True, eq=False)
class Kept:
    """What a check of a mesh needs: the grid as it was read, the mesh, and the band if known."""

    grid: SdfGrid
    mesh: Mesh
    band: Band | None = None


@dataclass(frozen=True)
class Conversion:
    """The result of a conversion."""

    grid: SdfGrid  # as it was read
    counts: dict[str, int]  # those of ``COUNTS``
    bounds: tuple[Triple, Triple]  # lowest and highest coordinates, in world units
    closed: bool  # no edge is open; else the surface leaves the grid and is not capped
    capped: bool  # the solid runs out of the grid, and was closed along the border
    warnings: tuple[str, ...]  # on what may be wrong with the result
    simplified: dict[str, Any] | None  # ``Simplified.report``; distances in voxels
    notes: tuple[str, ...] = ()  # on what was inferred
    seconds: dict[str, float] = field(default_factory=dict)  # per stage
    saved_field: dict[str, Any] | None = None  # its path; shape, spacing, origin of the lattice
    engine: dict[str, Any] = field(default_factory=dict)  # who did the work, if not this process
    kept: Kept | None = None  # for a check, if it was asked for and is small enough

    def remarks(self) -> list[str]:
        """Return sentences on what the mesh has that the samples do not show, or lacks."""
        dropped, lone = self.counts["dropped_pieces"], self.counts["lone_samples"]
        said = [CAPPED] * self.capped + [f"{DROPPED}: {dropped}"] * (dropped > 0)
        return said + [f"{LONE}: {lone}"] * (lone > 0 and self.grid.field.kind == MASK)

    def report(self) -> dict[str, Any]:
        """Return the result as a dictionary that can be written as JSON."""
        return {
            **describe_place(self.grid),
            **self.counts,
            "bounds": [list(corner) for corner in self.bounds],
            "closed": self.closed,
            "capped": self.capped,
            "field": self.grid.field.report(),
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
    save_field: str | Path | None = None,
    keep: bool = False,
) -> Conversion:
    """Convert a grid file to a mesh file, in formats of ``read_grid`` and ``write_mesh``.

    ``force`` replaces the target, and the field's file, if they exist. ``progress`` is called with
    (done, total), see ``progress.Progress``; an exception in it ends the work. ``before_rename`` is
    called with the path of the finished temporary file, before it is renamed to ``target``.
    ``save_field`` is a file for the refined field, in a format of ``write_field``: it and the mesh
    file are both complete at the end, or neither is written. ``keep`` keeps grid, band and mesh for
    a check, so that it need not read them again.

    SuperSdfError as in ``read_grid``, ``upsample``, ``simplify_mesh`` and ``write_mesh``; MeshError
    if slabs do not meet. Nothing is written then.
    """
    watch = Stopwatch()
    if options.goals():
        check_modules("simplifying", "simplify")
    grid = read_grid(source, **options.reading())
    keeper = Keeper(options.max_memory) if keep else None
    if save_field is not None:
        check_apart(save_field, files_of(source))

    fields: list[FineField] = []

    def make(shown: Progress | None) -> Iterator[Piece]:
        return reconstruct_slabs(
            grid,
            network,
            options.factor,
            offset=options.offset,
            cap=options.cap,
            mesher=options.mesher,
            max_memory=options.max_memory,
            progress=shown,
            save=fields.append if file else None,
            look=keeper.take_band if keeper else None,
        )

    def complete(part: Path) -> None:
        if file:
            whole = fields[0]
            if len(fields) > 1:
                whole = upsample(grid, network, options.factor, offset=options.offset)
            file.write(whole)
            check_free(file.path, force=force)  # both files appear, or none
        if before_rename:
            before_rename(part)

    with _field_file(save_field, grid, options, force=force) as file:
        done = convert_grid(
            grid,
            source,
            target,
            make,
            options,
            force=force,
            progress=progress,
            before_rename=complete,
            watch=watch,
            keeper=keeper,
        )
    return replace(done, saved_field=file.report) if file else done


def describe_place(grid: SdfGrid) -> dict[str, Any]:
    """Return where the samples of a grid lie, for JSON."""
    return {
        "shape": list(grid.shape),
        "spacing": list(grid.spacing),
        "origin": list(grid.origin),
        "direction": [list(row) for row in grid.direction],
        "space": grid.space,
    }


def _field_file(
    path: str | Path | None, grid: SdfGrid, options: ConvertOptions, *, force: bool
) -> AbstractContextManager[FieldFile | None]:
    """Return the file to write the refined field to, which appears at the end; None without."""
    if path is None:
        return nullcontext()
    # imported here, since few conversions write a field, and the start is part of each
    from .files.fields import check_field_fits, check_field_target, saving_field

    check_can_close(grid, cap=options.cap)
    path, shape = check_field_target(path, force=force), lattice_shape(grid.shape, options.factor)
    check_field_fits(path, shape, options.max_memory)
    return saving_field(path, force=force)


def convert_grid(
    grid: SdfGrid,
    source: str | Path,
    target: str | Path,
    make: MakePieces,
    options: ConvertOptions,
    *,
    force: bool = False,
    progress: Progress | None = None,
    before_rename: Callable[[Path], None] | None = None,
    watch: Stopwatch | None = None,
    keeper: Keeper | None = None,
) -> Conversion:
    """Write the mesh that ``make`` makes of a grid, which is that of ``source``; see ``convert``.

    ``watch`` has measured how long reading took; ``keeper`` keeps what a check needs.
    """
    watch = watch or Stopwatch()
    check_can_close(grid, cap=options.cap)
    check_apart(target, files_of(source))
    check_target(target, force=force, unit=options.unit)
    if options.keep_volume:
        from .labels.volumes import check_has_volume  # imported here, as few conversions need it

        check_has_volume(grid, options.offset, cap=options.cap)
    lattice = cubic_grid(grid, options.offset)
    check_format_holds(target, lattice, options.factor)
    watch.lap("read")
    tally, simplified, off = Tally(options.cap), None, list[str]()
    shown = part_of(progress, 0, SHARE_BEFORE) if options.goals() else progress
    mesh = join_meshes(list(tally.count(make(shown), watch)))
    if options.keep_volume or options.goals():
        mesh, simplified, off = _reworked(mesh, grid, options, progress)
        tally.instead(mesh)
        watch.lap("simplify" if simplified else "isosurface")
    if keeper:
        keeper.take_mesh(mesh)
    write_mesh(
        mesh,
        target,
        force=force,
        unit=options.unit,
        space=grid.space,
        before_rename=before_rename,
    )
    watch.lap("write")
    counts = {name: tally.counts[name] for name in COUNTS}
    warnings = find_warnings(grid, options.offset, counts, is_open=tally.is_open)
    return Conversion(
        grid,
        counts,
        bounds=(as_triple(tally.low, "low"), as_triple(tally.high, "high")),
        closed=simplified.mesh.is_closed() if simplified else not tally.is_open,
        capped=options.cap and tally.leaves,
        warnings=(*warnings, *(simplified.warnings if simplified else ())),
        simplified=simplified.report(grid.voxel_size) if simplified else None,
        notes=(
            *(*lattice.notes, *edges_note(lattice, options), *local_origin_note(target, [mesh])),
            *off,
        ),
        seconds=watch.seconds,
        kept=keeper.kept(grid) if keeper else None,
    )


def _reworked(
    mesh: Mesh, grid: SdfGrid, options: ConvertOptions, progress: Progress | None
) -> tuple[Mesh, Simplified | None, list[str]]:
    """Return the mesh with the volume of its samples, and simplified, if so asked, and notes."""
    simplified, off = None, list[str]()
    if options.keep_volume:
        from .labels.volumes import keep_volumes, mean_spacing, volume_notes, volume_of_samples

        volume = volume_of_samples(grid)
        (mesh,) = keep_volumes([mesh], [volume], mean_spacing(grid))
    if options.goals():
        from .simplify.simplify import simplify_mesh

        simplified = simplify_mesh(
            mesh,
            error=options.error(grid.voxel_size),
            triangles=options.triangles,
            max_memory=options.max_memory,
            progress=share_of(part_of(progress, SHARE_BEFORE, 1)),
        )
        mesh = simplified.mesh
    if options.keep_volume:  # simplifying may have changed it
        off = volume_notes({"the mesh": (mesh.volume(), volume)})
    return mesh, simplified, off


class Keeper:
    """Keeps the band and copies the pieces of a mesh, while they are small beside the memory."""

    def __init__(self, max_memory: int | None) -> None:
        bound = memory_bound(max_memory)
        self.room = np.inf if bound is None else KEPT_SHARE * bound
        self.band: Band | None = None
        self.mesh: Mesh | None = None

    def take_band(self, band: Band) -> None:
        """Keep the band."""
        self.band = band

    def take_mesh(self, mesh: Mesh) -> None:
        """Keep the mesh, if it is small enough."""
        if mesh.vertices.nbytes + mesh.faces.nbytes < self.room:
            self.mesh = mesh

    def kept(self, grid: SdfGrid) -> Kept | None:
        """Return what is kept; None if nothing, or not all of it."""
        return Kept(grid, self.mesh, self.band) if self.mesh else None


class Tally:
    """Counts, bounding box and open edges of a mesh, added up while its pieces are written."""

    def __init__(self, cap: bool) -> None:
        self.cap = cap
        self.edges = OpenEdges()
        self.last: Piece | None = None  # without its meshes
        self.counts: Counter[str] = Counter()
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self.is_cut = self.leaves = False

    @property
    def is_open(self) -> bool:
        """Whether edges are open."""
        return len(self.edges) > 0

    def count(self, pieces: Iterable[Piece], watch: Stopwatch) -> Iterator[Mesh]:
        """Yield the meshes of the pieces, and count them; MeshError if the pieces do not meet.

        The time until the caller takes the next mesh counts as writing.
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
                self._extend_box(mesh.vertices)
            yield from piece.meshes
            del piece  # before the next one is made
            watch.lap("write")
        if self.last and self.is_open and (self.cap or not self.is_cut):
            raise torn(len(self.edges), "in", self.last)

    def instead(self, mesh: Mesh) -> None:
        """Count another mesh instead of those so far; the open edges stay."""
        self.counts["vertices"], self.counts["triangles"] = len(mesh.vertices), len(mesh.faces)
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self._extend_box(mesh.vertices)

    def _count_edges(self, piece: Piece) -> None:
        """Count the edges of a piece; MeshError if edges before it stay open."""
        before, first = self.edges.edges, self.counts["vertices"]
        for mesh in piece.meshes:
            self.edges.add(mesh.faces)
        left = self.edges.before(first)  # no later piece has these vertices
        if self.is_cut and not self.cap:
            left = np.setdiff1d(left, before)  # the others may be on the border of the grid
        if self.last and len(left):
            raise torn(len(left), f"at plane {piece.planes[0]}, between", self.last, piece)
        self.last = replace(piece, meshes=[])

    def _extend_box(self, vertices: NDArray[Any]) -> None:
        """Extend the box axis by axis: five times as fast as ``min(0)``."""
        for axis, coordinates in enumerate(vertices.T if len(vertices) else ()):
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


def edges_note(grid: SdfGrid, options: ConvertOptions) -> list[str]:
    """Return why no edges are found, if they were asked for."""
    if options.mesher != SHARP or grid.field.has_exact:
        return []
    return [f"{grid.field.kind} values show no edges: the mesh is that of marching cubes"]


def find_warnings(
    grid: SdfGrid, offset: float, counts: dict[str, int], *, is_open: bool
) -> list[str]:
    """Return a sentence on each thing that may be wrong with the mesh of a grid."""
    warnings = []
    if is_open and grid.field.unseen is not None:
        warnings.append("the surface ends where samples are unknown, and is open there")
    elif is_open:
        warnings.append("the surface runs out of the grid and is open there (close it with --cap)")
    if grid.low >= offset:
        thin = "no sample lies inside: the solid is thinner than the spacing"
        warnings.append(f"{thin}, and its mesh may have holes")
    if grid.field.kind in (MASK, SCALED):  # only distances can be noisy, or contradict each other
        return warnings
    if counts["noisy_voxels"]:
        share = in_percent(counts["noisy_voxels"], counts["band_voxels"])
        differ = f"in {share} of the band the values differ by more than distances can"
        warnings.append(f"{differ}: they are taken as noisy there, and corrected")
    if pinned := counts["pinned_nodes"]:
        contradict = f"{pinned} fine values contradict the coarse ones around them"
        way = "were given their sign: the input is no distance field there"
        warnings.append(f"{contradict} and {way}")
    return warnings


def in_percent(part: int, whole: int) -> str:
    """Return a share, which must not be 0, as a percentage with two digits."""
    share = 100 * part / whole
    if share < 0.01:
        return "less than 0.01 %"
    return f"{share:.0f} %" if share >= 9.95 else f"{share:.2g} %"
