"""Conversion of a label image to the meshes of its labels, in one run: all files, or none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..errors import MeshError, OptionError, seen
from ..files.mesh_writers import World
from ..files.meshes import (
    check_mesh_suffix,
    check_target,
    format_of,
    write_meshes,
)
from ..files.output import check_apart
from ..files.regular import files_of
from ..files.volume import PLACE
from ..grid.sdf_grid import SdfGrid, describe_place, mean_spacing
from ..network.decoder import Decoder
from ..options import ALL, LABELS, MARCHING, OPTIONS, Options
from ..progress import Progress, Stopwatch
from ..surface.mesh import Mesh
from .image import find_image, in_order
from .names import LabelName, Names, in_file_name, numbers_of
from .reconstruct import label_meshes
from .volumes import keep_volumes, volume_notes

MOST_FILES = 500


@dataclass(frozen=True, eq=False)
class LabelConversion:
    """What a conversion of a label image has made, as ``convert.Conversion`` says it of one mesh.

    A row of ``labels`` has the volume of the mesh beside that of the label's samples, each of which
    counts as a box; ``missing`` are the listed labels that no sample has.
    """

    grid: SdfGrid
    labels: list[dict[str, Any]]
    missing: list[dict[str, Any]]
    notes: tuple[str, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    closed: bool = True

    def remarks(self) -> list[str]:
        """Return a note on the labels that the image lacks, if there are some."""
        names = ", ".join(row["name"] for row in self.missing)
        return [f"no sample has a label that was asked for: {names}"] * bool(names)

    def report(self) -> dict[str, Any]:
        """Return the result as a dictionary that can be written as JSON."""
        return {
            **describe_place(self.grid),
            "labels": self.labels,
            "missing": self.missing,
            "inferred": list(self.notes),
        }


def convert_labels(
    source: str | Path,
    target: str | Path,
    network: Decoder,
    options: Options | None = None,
    *,
    names: Names | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> LabelConversion:
    """Convert a file with a label image to closed meshes of its labels, which share their walls.

    A target ``.glb`` or ``.3mf`` gets all labels as its parts; of another, ``part.ply`` say, each
    label has its own file, ``part-1.ply``. ``names`` of ``read_names`` take the place of numbers in
    ``options.labels``, in files and as parts, and parts have their colours. Listed labels that the
    image lacks are left out. The other parameters are those of ``convert``; options besides
    ``options.LABELS`` must have their defaults.

    Raises
    ------
    SuperSdfError
        As in ``reconstruct_labels`` and ``write_mesh``; OptionError if an option does not go with
        labels. Nothing is written then.
    """
    watch, options, known = Stopwatch(), options or Options(), names or {}
    check_options(options)
    check_mesh_suffix(Path(target), options.unit)
    given, bound = options.reading(), options.max_memory
    wanted = in_order(numbers_of(options.labels or ALL, known))
    place = {name: given[name] for name in PLACE}
    image = find_image(source, wanted, place, options.axes, bound, options.space)
    grid, called = image.grid, names_of(image.names(), known)
    ends = {n: in_file_name(called[n].name) if n in known else str(n) for n in called}
    paths = label_paths(target, list(told_apart(ends, "-").values()))
    for path in dict.fromkeys(paths):
        check_target(path, force=force)
        check_apart(path, files_of(source))
    watch.lap("read")
    meshes = label_meshes(image, network, options.factor, bound, progress)
    torn = [label for label, mesh in zip(called, meshes) if mesh.open_edges()]
    if torn:
        raise MeshError(f"the mesh of label {torn[0]} is torn: run it again, and report it")
    volumes, off = image.volumes(), list[str]()
    if options.keep_volume:
        meshes = keep_volumes(meshes, volumes, mean_spacing(grid))
        made = zip(called.values(), meshes, volumes)
        off = volume_notes({entry.name: (mesh.volume(), volume) for entry, mesh, volume in made})
    watch.lap("mesh")
    files: dict[Path, dict[str, Mesh]] = {path: {} for path in paths}
    rows = []
    for path, (label, entry), mesh, volume in zip(paths, called.items(), meshes, volumes):
        files[path][entry.name] = mesh
        row = {"label": label, "name": entry.name, "output": str(path)}
        row |= {"vertices": len(mesh.vertices), "triangles": len(mesh.faces)}
        row |= {"volume": mesh.volume(), "components": mesh.components()[0], "closed": True}
        rows.append({**row, "sample_volume": volume})
    colours = {entry.name: entry.colour for entry in called.values() if entry.colour}
    world = World(options.unit, grid.space, colours)
    write_meshes(files, force=force, world=world)
    watch.lap("write")
    missing = names_of(image.missing(wanted), known)
    return LabelConversion(
        grid,
        rows,
        [{"label": label, "name": entry.name} for label, entry in missing.items()],
        (*grid.notes, *off),
        watch.seconds,
    )


def with_numbers(options: Options, names: Names | None) -> Options:
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


def told_apart(names: dict[int, str], mark: str) -> dict[int, str]:
    """Return names to which the labels are added until no two are the same in any case."""
    while True:
        times = Counter(name.casefold() for name in names.values())
        alike = {label: name for label, name in names.items() if times[name.casefold()] > 1}
        if not alike:
            return names
        names = {**names, **{label: f"{name}{mark}{label}" for label, name in alike.items()}}


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


def check_options(options: Options, more: Sequence[str] = ()) -> None:
    """Raise OptionError for a given option, or one of ``more``, that does not go with labels."""
    given = {}
    for name, value in vars(options).items():
        if name not in LABELS and value not in (OPTIONS[name].default, MARCHING):
            given[name] = f" {seen(value)}"
    for name in (*given, *more):
        text = "open" if name == "cap" else name.replace("_", "-") + given.get(name, "")
        raise OptionError(
            f"{text} does not go with labels, which share their walls: "
            "leave it out, or mesh one label (--label)"
        )
