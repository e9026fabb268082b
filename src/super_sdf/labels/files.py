"""Conversion of a label image to the meshes of its labels, in one run: all files, or none.

Names and colours come from the tables that programs write:

3D Slicer, FreeSurfer   1 liver 221 130 101 255
ITK-SNAP                1 221 130 101 1 1 1 "liver"
JSON                    {"1": "liver"} or {"liver": 1}; also below "labels", as of nnU-Net
CSV, TSV                1,liver
"""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import FileError, MeshError, OptionError, flag, seen
from ..files.formats import check_regular_file, files_of
from ..files.grids import names_in
from ..files.meshes import World, check_mesh_suffix, check_target, has_parts, write_meshes
from ..files.output import check_apart
from ..files.readers import PLACE
from ..grid.sdf_grid import SdfGrid, describe_place
from ..network.contract import Decoder
from ..options import ALL, LABELS, MARCHING, OPTIONS, Options
from ..surface.mesh import Mesh
from ..threads import Progress, Stopwatch
from .reconstruct import find_image, in_order, label_meshes
from .volumes import volume_notes

LONGEST = 80  # characters of a name


class LabelName(NamedTuple):
    """A name, and a colour in red, green and blue from 0 to 255 if the table has one."""

    name: str
    colour: tuple[int, int, int] | None = None


Names = dict[int, LabelName]


@dataclass(frozen=True, eq=False)
class LabelConversion:
    """What a conversion of a label image has made, as ``convert.Conversion`` says it of one mesh.

    In ``labels``, the volume of a mesh stands beside that of its samples, taken as boxes.
    """

    grid: SdfGrid
    labels: list[dict[str, Any]]
    missing: list[dict[str, Any]]  # labels that were asked for, and that no sample has
    notes: tuple[str, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    closed: bool = True

    def report(self) -> dict[str, Any]:
        """Return the result as a dictionary that can be written as JSON."""
        made = {"labels": self.labels, "missing": self.missing, "inferred": list(self.notes)}
        return {**describe_place(self.grid), **made}


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
    label has its own file, ``part-1.ply``. ``names`` of ``read_names``, by default those that the
    source states, take the place of numbers in ``options.labels``, in files and as parts, and parts
    have their colours. Listed labels that the image lacks are left out. The other parameters are
    those of ``convert``; options besides
    ``options.LABELS`` must have their defaults. Errors are those of ``reconstruct_labels`` and
    ``write_mesh``, OptionError if an option does not go with labels; nothing is written then.
    """
    watch, options = Stopwatch(), options or Options()
    known = names or {n: LabelName(*each) for n, each in names_in(source).items()}
    options = with_numbers(replace(options, labels=options.labels or ALL), known)
    check_mesh_suffix(Path(target), options.unit)
    wanted, place = in_order(options.labels), {name: getattr(options, name) for name in PLACE}
    image = find_image(source, wanted, place, options.axes, options.max_memory, options.space)
    grid, called = image.grid, names_of(image.labels, known)
    paths = paths_of(Path(target), called, known)
    for path in dict.fromkeys(paths):
        check_target(path, force=force)
        check_apart(path, files_of(source))
    watch.lap("read")
    meshes, notes, warnings = label_meshes(image, network, options, progress)
    for label, mesh in zip(called, meshes):
        if mesh.open_edges():
            raise MeshError(f"the mesh of label {label} is torn: run it again, and report it")
    volumes = image.volumes
    if options.keep_volume:
        made = zip(called.values(), meshes, volumes)
        notes += volume_notes({entry.name: (mesh.volume(), volume) for entry, mesh, volume in made})
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
    write_meshes(files, force=force, world=World(options.unit, grid.space, colours))
    watch.lap("write")
    lacking = names_of(image.missing, known)
    missing = [{"label": label, "name": entry.name} for label, entry in lacking.items()]
    if missing:
        listed = ", ".join(entry.name for entry in lacking.values())
        notes.append(f"no sample has a label that was asked for: {listed}")
    said = (*grid.notes, *notes)
    return LabelConversion(grid, rows, missing, said, watch.seconds, tuple(warnings))


def paths_of(target: Path, called: Names, known: Names) -> list[Path]:
    """Return the file of each label: the target, if that holds several meshes, or its own."""
    if has_parts(target):
        return [target] * len(called)
    ends = {n: called[n].name if n in known else str(n) for n in called}
    ends = {n: re.sub(r"[^\w.-]+", "_", end).strip("._") or "label" for n, end in ends.items()}
    ends = {n: end.encode()[:LONGEST].decode(errors="ignore") for n, end in ends.items()}
    named = told_apart(ends, "-").values()
    return [target.with_name(f"{target.stem}-{end}{target.suffix}") for end in named]


def check_options(options: Options, more: Sequence[str] = ()) -> None:
    """Raise OptionError for a given option, or one of ``more``, that does not go with labels."""
    others = {name: value for name, value in vars(options).items() if name not in LABELS}
    usual = {name: (OPTIONS[name].default, MARCHING) for name in others}
    given = {name: f" {seen(x)}" for name, x in others.items() if x not in usual[name]}
    for name in (*given, *more):
        text = flag("open" if name == "cap" else name) + given.get(name, "") * (name != "cap")
        raise OptionError(
            f"{text} does not go with labels, which share their walls: "
            "leave it out, or mesh one label (--label)"
        )


def with_numbers(options: Options, names: Names | None) -> Options:
    """Return options with numbers in place of names of labels; OptionError if some do not go."""
    if options.labels is None:
        return options
    check_options(options)
    if isinstance(options.labels, str):
        return options
    numbers: dict[Any, int] = {entry.name: number for number, entry in (names or {}).items()}
    for label in options.labels:
        if isinstance(label, str) and label not in numbers:
            some = ", ".join(list(numbers)[:10]) or "none without --names"
            raise OptionError(
                f"--labels has {label!r}: give numbers, or names of the table ({some})"
            )
    chosen = in_order([numbers.get(label, label) for label in options.labels])
    return replace(options, labels=tuple(chosen or ()))


def names_of(labels: list[int], known: Names) -> Names:
    """Return what each label is called, by a name of its own."""
    entries = {label: known.get(label, LabelName(f"label {label}")) for label in labels}
    names = told_apart({label: entry.name for label, entry in entries.items()}, " ")
    return {label: entries[label]._replace(name=name) for label, name in names.items()}


def told_apart(names: dict[int, str], mark: str) -> dict[int, str]:
    """Return names to which the labels are added until no two are the same in any case."""
    times = Counter(name.casefold() for name in names.values())
    alike = {n: f"{name}{mark}{n}" for n, name in names.items() if times[name.casefold()] > 1}
    return told_apart({**names, **alike}, mark) if alike else names


def read_names(path: str | Path) -> Names:
    """Return the names of labels in a table; FileError if it is none."""
    path, names = check_regular_file(Path(path)), {}
    rows = _of_json if path.suffix.lower() == ".json" else _of_lines
    try:
        for label, name, parts in rows(path.read_text(encoding="utf-8-sig")):
            plain = "".join(letter if letter.isprintable() else " " for letter in name)
            rgb: Any = tuple(int(part) for part in parts if re.fullmatch(r"\d{1,3}", part))
            colour = rgb if len(rgb) == 3 and max(rgb) <= 255 else None
            if plain := plain[:LONGEST].strip():
                names[int(label)] = LabelName(plain, colour)
    except (OSError, ValueError, RecursionError, csv.Error) as error:
        raise FileError(f"{path} cannot be read as a table of labels: {error}") from error
    if not names:
        raise FileError(f"{path} names no label: give lines such as '1 liver'")
    return names


def _of_json(text: str) -> Iterator[tuple[Any, str, list[str]]]:
    """Yield the labels and names of an object that maps numbers to names, or names to numbers."""
    found = json.loads(text)
    found = found.get("labels", found) if isinstance(found, dict) else found
    if not isinstance(found, dict):
        raise ValueError("it is no object of names")
    for key, value in found.items():
        label, name = (key, value) if _is_whole(key) else (value, key)
        if not _is_whole(label) or not isinstance(name, str):
            raise ValueError(f"{seen(key)}: {seen(value)} is no label and name")
        yield label, name, []


def _of_lines(text: str) -> Iterator[tuple[Any, str, list[str]]]:
    """Yield labels, names and colours of lines that begin with a number; others are comments."""
    for line in text.splitlines():
        mark = next((mark for mark in "\t,;" if mark in line), " ")
        (fields,) = csv.reader([line.strip()], delimiter=mark, skipinitialspace=True) or [[]]
        fields = [field.strip() for field in fields]
        if mark == " ":
            fields = [*filter(None, fields[:-1]), *fields[-1:]]
        if len(fields) < 2 or not _is_whole(fields[0]):
            continue
        if len(fields) >= 5 and all(map(_is_whole, fields[1:4])) and not _is_whole(fields[-1]):
            yield fields[0], fields[-1], fields[1:4]  # ITK-SNAP
        else:
            yield fields[0], fields[1], fields[2:5]


def _is_whole(value: Any) -> bool:
    is_number = isinstance(value, int) and not isinstance(value, bool)
    return is_number or (isinstance(value, str) and bool(re.fullmatch(r"[-+]?\d{1,20}", value)))
