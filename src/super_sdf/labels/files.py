"""Conversion of a label image to the meshes of its labels, in one run: all files, or none."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import SEEK_END
from pathlib import Path
from typing import IO, Any

import numpy as np

from ..convert import describe_place
from ..errors import MeshError, OptionError, seen
from ..files.mesh_writers import Colour, World
from ..files.meshes import check_format_holds, check_mesh_suffix, check_target, format_of, local_origin_note, write_meshes
from ..files.output import check_apart, naming
from ..files.regular import files_of
from ..files.volume import PLACE
from .names import LabelName, Names, in_file_name, numbers_of
from .reconstruct import LabelPiece, find_image, in_order, label_slabs
from ..surface.mesh import Mesh, join_meshes
from ..network.decoder import Decoder
from ..options import ALL, LABELS, MARCHING, OPTIONS, ConvertOptions
from ..progress import Progress
from ..surface.topology import OpenEdges, vertex_components
from .volumes import keep_volumes, mean_spacing, volume_notes

MOST_FILES = 500  # each is held open until all are complete


@dataclass(eq=False)
class LabelMesh:
    """What is known of the mesh of a label, and where its pieces wait in a file."""

    label: int
    name: str
    path: Path
    waiting: IO[bytes]
    places: list[tuple[int, int, int]] = field(default_factory=list)
    edges: OpenEdges = field(default_factory=OpenEdges)
    volume: float = 0.0
    dtype: type[Any] | np.dtype[Any] = np.float32

    def add(self, piece: LabelPiece) -> None:
        """Add a piece of the mesh."""
        self._put(piece.mesh)
        self.edges.add(piece.mesh.faces)
        self.volume += piece.volume

    def replace(self, mesh: Mesh) -> None:
        """Take a mesh with other vertices instead of the pieces so far."""
        self.places, self.volume = [], mesh.volume()
        self._put(mesh)

    def _put(self, mesh: Mesh) -> None:
        start = self.waiting.seek(0, SEEK_END)
        self.places.append((start, len(mesh.vertices), len(mesh.faces)))
        self.waiting.write(mesh.vertices.tobytes() + mesh.faces.tobytes())
        self.dtype = mesh.vertices.dtype

    def pieces(self) -> Iterator[Mesh]:
        """Yield the mesh piece by piece."""
        for place, vertices, faces in self.places:
            self.waiting.seek(place)
            size = 3 * vertices * np.dtype(self.dtype).itemsize
            data = self.waiting.read(size + 12 * faces)
            points = np.frombuffer(data[:size], self.dtype).reshape(-1, 3)
            yield Mesh(points, np.frombuffer(data[size:], np.int32).reshape(-1, 3))

    def _components(self) -> int:
        """Return in how many pieces the mesh is, by its faces alone."""
        faces = np.concatenate([piece.faces for piece in self.pieces()])
        return len(np.unique(vertex_components(faces, int(faces.max()) + 1)[faces[:, 0]]))

    def report(self) -> dict[str, Any]:
        """Return the row of the label as it can be written as JSON."""
        _, vertices, triangles = np.sum(self.places, axis=0).tolist()
        return {
            "label": self.label,
            "name": self.name,
            "output": str(self.path),
            "vertices": vertices,
            "triangles": triangles,
            "volume": self.volume,
            "components": self._components(),
            "closed": not len(self.edges),
        }


def convert_labels(
    source: str | Path,
    target: str | Path,
    network: Decoder,
    options: ConvertOptions | None = None,
    *,
    names: Names | None = None,
    force: bool = False,
    progress: Progress | None = None,
    before_rename: Callable[[Mapping[Path, Path]], None] | None = None,
) -> dict[str, Any]:
    """Convert a file with a label image to closed meshes of its labels, which share their walls.

    A target ``.glb`` or ``.3mf`` gets all labels as its parts; of another, ``part.ply`` say, each
    label has its own file, ``part-1.ply``. ``names`` of ``read_names`` take the place of numbers in
    ``options.labels``, in files and as parts, and parts have their colours. Listed labels that the
    image lacks are left out. ``before_rename`` is called with all complete files, by the paths that
    they will have; an exception in it leaves none. The other parameters are those of ``convert``;
    options besides ``options.LABELS`` must have their defaults.

    Returns
    -------
    dict
        Shape, spacing, origin and direction of the grid, a row for each label (``labels``), the
        listed labels that the image lacks (``missing``), and ``inferred``: sentences on what was
        inferred. A row has the volume of the mesh beside that of the label's samples, each of which
        counts as a box.

    Raises
    ------
    SuperSdfError
        As in ``reconstruct_labels`` and ``write_mesh``; OptionError if an option does not go with
        labels. Nothing is written then.
    """
    options = options or ConvertOptions()
    check_options(options)
    check_mesh_suffix(Path(target), options.unit)
    given = options.reading()
    place, bound = {name: given[name] for name in PLACE}, options.max_memory
    known = names or {}
    wanted = in_order(numbers_of(options.labels or ALL, known))
    image = find_image(source, wanted, place, options.axes, bound, options.space)
    grid = image.grid
    called = names_of(image.names(), known)
    ends = {n: in_file_name(called[n].name) if n in known else str(n) for n in called}
    paths = label_paths(target, list(told_apart(ends, "-").values()))
    for path in dict.fromkeys(paths):
        check_target(path, force=force)
        check_apart(path, files_of(source))
    check_format_holds(target, grid, options.factor)
    with naming(paths[0]), tempfile.TemporaryFile(dir=paths[0].parent) as waiting:
        meshes = {
            label: LabelMesh(label, entry.name, path, waiting)
            for (label, entry), path in zip(called.items(), paths)
        }
        slabs = label_slabs(image, network, options.factor, max_memory=bound, progress=progress)
        for piece in slabs:
            meshes[piece.label].add(piece)
        torn = [label for label, mesh in meshes.items() if len(mesh.edges)]
        if torn:
            raise MeshError(f"the mesh of label {torn[0]} is torn: run it again, and report it")
        volumes, off = image.volumes(), list[str]()
        if options.keep_volume:
            off = _move(list(meshes.values()), volumes, mean_spacing(grid))
        world = World(options.unit, grid.space, colours_of(called.values()))
        files: dict[Path, dict[str, Mesh]] = {path: {} for path in paths}
        for mesh in meshes.values():
            files[mesh.path][mesh.name] = join_meshes(list(mesh.pieces()))
        rows = [
            {**mesh.report(), "sample_volume": volume}
            for mesh, volume in zip(meshes.values(), volumes)
        ]
        write_meshes(files, force=force, world=world, before_rename=before_rename)
    return {
        **describe_place(grid),
        "labels": rows,
        "missing": [
            {"label": label, "name": entry.name}
            for label, entry in names_of(image.missing(wanted), known).items()
        ],
        "inferred": [*grid.notes, *local_origin_note(target, files[paths[0]].values()), *off],
    }


def _move(meshes: Sequence[LabelMesh], volumes: Sequence[float], spacing: float) -> list[str]:
    """Give meshes the volumes of their samples; return a note on those that stay off."""
    whole = [join_meshes(list(mesh.pieces())) for mesh in meshes]
    for mesh, moved in zip(meshes, keep_volumes(whole, volumes, spacing)):
        mesh.replace(moved)
    return volume_notes({m.name: (m.volume, v) for m, v in zip(meshes, volumes)})


def with_numbers(options: ConvertOptions, names: Names | None) -> ConvertOptions:
    """Return options with numbers in place of names of labels; OptionError if some do not go."""
    if options.labels is None:
        return options
    check_options(options)
    labels = in_order(numbers_of(options.labels, names or {}))
    return replace(options, labels=labels if isinstance(labels, str) else tuple(labels))


def names_of(labels: list[int], known: Names) -> Names:
    """Return what each label is called, by a name of its own."""
    entries = {label: known.get(label, LabelName(f"label {label}")) for label in labels}
    names = told_apart({label: entry.name for label, entry in entries.items()}, " ")
    return {label: entries[label]._replace(name=name) for label, name in names.items()}


def missing_note(missing: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a note on the labels that an image lacks, if there are some."""
    names = ", ".join(row["name"] for row in missing)
    return [f"no sample has a label that was asked for: {names}"] if missing else []


def told_apart(names: dict[int, str], mark: str) -> dict[int, str]:
    """Return names to which the labels are added until no two are the same in any case."""
    while True:
        times = Counter(name.casefold() for name in names.values())
        alike = {label: name for label, name in names.items() if times[name.casefold()] > 1}
        if not alike:
            return names
        names = {**names, **{label: f"{name}{mark}{label}" for label, name in alike.items()}}


def colours_of(names: Iterable[LabelName]) -> dict[str, Colour]:
    """Return the colours of parts by their names."""
    return {entry.name: entry.colour for entry in names if entry.colour}


def label_paths(target: str | Path, labels: Sequence[Any]) -> list[Path]:
    """Return the file of each label: the target itself, if it can have parts."""
    path = Path(target)
    if format_of(path).has_scene:
        return [path] * len(labels)
    if len(labels) > MOST_FILES:
        raise OptionError(
            f"{path} would be {len(labels):,} files, one for each label: give .glb or .3mf, which "
            f"hold all as parts, or at most {MOST_FILES} labels (--labels 1,2,3)"
        )
    return [path.with_name(f"{path.stem}-{label}{path.suffix}") for label in labels]


def check_options(options: ConvertOptions, more: Sequence[str] = ()) -> None:
    """Raise OptionError for a given option, or one of ``more``, that does not go with labels."""
    others = [name for name in vars(options) if name not in LABELS]
    given = [
        name for name in others if getattr(options, name) not in (OPTIONS[name].default, MARCHING)
    ]
    for name in (*given, *more):
        value = f" {seen(getattr(options, name))}" if name in given else ""
        text = "open" if name == "cap" else f"{name.replace('_', '-')}{value}"
        raise OptionError(
            f"{text} does not go with labels, which share their walls: "
            "leave it out, or mesh one label (--label)"
        )
