"""Conversion of a label image to the meshes of its labels, in one run: all files, or none.

Names and colours come from the tables that programs write:

3D Slicer, FreeSurfer   1 liver 221 130 101 255
ITK-SNAP                1 221 130 101 1 1 1 "liver"
JSON                    {"1": "liver"} or {"liver": 1}; also below "labels", as of nnU-Net
CSV, TSV                1,liver; or a header names the columns: id,r,g,b,name
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import FileError, MeshError, OptionError, flag
from ..files.formats import check_regular_file, files_of
from ..files.grids import names_in as names_in
from ..files.meshes import World, check_mesh_suffix, has_parts, write_meshes
from ..files.output import check_apart, check_free
from ..files.readers import PLACE, Names as Names
from ..grid.sdf_grid import describe_place
from ..network.contract import Decoder
from ..options import LABELS, OPTIONS, Options
from ..surface.mesh import Mesh
from ..threads import Progress, Steps
from .reconstruct import find_image, in_order, label_meshes
from .volumes import FAR, NOTED, volume_notes

LONGEST = 80  # characters of a name
ITK_SNAP = re.compile(r'^\s*(\d+)\s+(\d+)\s+(\d+)\s+(\d+)\s.*"(.*)"', re.MULTILINE)
RGB = r"(?:[ \t,;]+(\d{1,3})[ \t,;]+(\d{1,3})[ \t,;]+(\d{1,3})(?:[ \t,;].*)?|[\t,;].*)?"
LINE = re.compile(rf'^[ \t]*([-+]?\d+)[ \t,;]+"?([^",;\t\n]*?)"?{RGB}[ \t]*$', re.MULTILINE)

LABEL_AND_NAME = ["id", "index", "value", "labelvalue", "labelid", "label", "name"]
COLOURS = ["r", "g", "b", "red", "green", "blue", "colorr", "colorg", "colorb"]


class LabelConversion(NamedTuple):
    """The result of a conversion of a label image, as ``convert.Conversion`` of one mesh."""

    facts: dict[str, Any]  # as ``--json`` has them
    seconds: dict[str, float]  # per stage


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
    have their colours. Listed labels that the image lacks are left out. The other parameters and
    the errors are those of ``convert``; of the options only ``options.LABELS`` may be given.
    """
    watch, options, known = Steps(), options or Options(), names or names_in(source)
    options = with_numbers(replace(options, labels=options.labels or "all"), known)
    check_mesh_suffix(Path(target))
    image = find_image(source, options, [getattr(options, name) for name in PLACE], partly=True)
    unit = options.unit_for(Path(target), image.grid.flagged)
    called, lacking = names_of(image.volumes, known), names_of(image.missing, known)
    paths = paths_of(Path(target), called, known)
    for path in set(paths):
        check_free(path, force=force)
        check_apart(path, files_of(source))
    watch.lap("read")
    meshes, notes, warnings = label_meshes(image, network, options, progress)
    watch.lap("mesh")
    files: dict[Path, dict[str, Mesh]] = {path: {} for path in paths}
    rows = list[dict[str, Any]]()
    for (n, (name, _)), path, mesh in zip(called.items(), paths, meshes):
        files[path][name] = mesh
        if mesh.open_edges():
            raise MeshError(f"the mesh of label {n} is torn: run it again, and report it")
        row = {"label": n, "name": name, "output": str(path), "vertices": len(mesh.vertices)}
        row |= {"triangles": len(mesh.faces), "components": mesh.components()[0]}
        row |= {"cavities": mesh.cavities(), "closed": True, "volume": mesh.volume()}
        rows.append({**row, "sample_volume": image.volumes[n]})
    colours = {name: colour for name, colour in called.values() if colour}
    write_meshes(files, force=force, world=World(unit, image.grid.space, colours))
    watch.lap("write")
    pairs = {row["name"]: (row["volume"], row["sample_volume"]) for row in rows}
    notes += volume_notes(pairs, NOTED if options.keep_volume else FAR)
    missing = [{"label": n, "name": name} for n, (name, _) in lacking.items()]
    listed = ", ".join(name for name, _ in lacking.values())
    notes += [f"no sample has a label that was asked for: {listed}"] * bool(missing)
    facts = {"labels": rows, "missing": missing, "closed": True, "warnings": warnings}
    facts |= {"inferred": [*image.grid.flagged, *notes], **describe_place(image.grid)}
    return LabelConversion(facts, watch.seconds)


def paths_of(target: Path, called: Names, known: Names) -> list[Path]:
    """Return the file of each label: the target, if that holds several meshes, or its own."""
    if has_parts(target):
        return [target] * len(called)
    ends = {n: name if n in known else str(n) for n, (name, _) in called.items()}
    ends = {n: re.sub(r"[^\w.-]+", "_", end).strip("._") or "label" for n, end in ends.items()}
    named = told_apart(ends, "-").values()
    return [target.with_name(f"{target.stem}-{end}{target.suffix}") for end in named]


def check_options(options: Options, more: Sequence[str] = ()) -> None:
    """Raise OptionError for a given option, or one of ``more``, that does not go with labels."""
    usual = {name: (OPTIONS[name].default, "marching") for name in OPTIONS if name not in LABELS}
    given = [name for name, values in usual.items() if getattr(options, name) not in values]
    for name in (*given, *more):
        option = flag("open" if name == "cap" else name)
        said = f"{option} does not go with labels, which share their walls"
        raise OptionError(f"{said}: leave it out, or mesh one label (--label)")


def with_numbers(options: Options, names: Names | None) -> Options:
    """Return options with numbers in place of names of labels; OptionError if some do not go."""
    if options.labels is None:
        return options
    check_options(options)
    if options.labels == "all":
        return options
    numbers: dict[Any, list[int]] = {}  # a name may be that of several labels
    for number, (name, _) in (names or {}).items():
        numbers.setdefault(name, []).append(number)
    chosen = [number for label in options.labels for number in numbers.get(label, [label])]
    if other := [label for label in chosen if isinstance(label, str)]:
        some = ", ".join(list(numbers)[:10]) or "none without --names"
        raise OptionError(
            f"--labels has {other[0]!r}: give numbers, or names of the table ({some})"
        )
    return replace(options, labels=tuple(in_order(chosen) or ()))


def names_of(labels: Iterable[int], known: Names) -> Names:
    """Return what each label is called, by a name of its own, and its colour."""
    entries = {label: known.get(label, (f"label {label}", None)) for label in labels}
    names = told_apart({label: name for label, (name, _) in entries.items()}, " ")
    return {label: (name, entries[label][1]) for label, name in names.items()}


def told_apart(names: dict[int, str], mark: str) -> dict[int, str]:
    """Return names to which the labels are added until no two are the same in any case."""
    times = Counter(name.casefold() for name in names.values())
    alike = {n: f"{name}{mark}{n}" for n, name in names.items() if times[name.casefold()] > 1}
    return told_apart({**names, **alike}, mark) if alike else names


def read_names(path: str | Path) -> Names:
    """Return the names of labels in a table; FileError if it is none."""
    path, names, rows = check_regular_file(Path(path)), {}, list[Any]()
    try:
        text = path.read_text(encoding="utf-8-sig")
        if path.suffix.lower() == ".json":
            pairs = (found := json.loads(text)).get("labels", found).items()
            rows = [(x, y, ()) if isinstance(y, str) else (y, x, ()) for x, y in pairs]
        else:
            head, *table = [re.split("[,;\t]", line) for line in text.strip().splitlines()]
            at = {re.sub("[^a-z]", "", word.lower()): n for n, word in enumerate(head)}
            named = [at[word] for word in LABEL_AND_NAME if word in at]
            if len(named) > 1 and (named[0], named[-1]) != (0, 1):  # else the lines are as others
                order = [named[0], named[-1], *(at[word] for word in COLOURS if word in at)]
                whole = [row for row in table if len(row) == len(head)]
                text = "\n".join("\t".join(row[n] for n in order) for row in whole)
            rows = [(row[0], row[4], row[1:4]) for row in ITK_SNAP.findall(text)]
            rows = rows or [(row[0], row[1], row[2:]) for row in LINE.findall(text)]
        for label, name, rgb in rows:
            plain = "".join(letter if letter.isprintable() else " " for letter in name)
            if plain := plain[:LONGEST].strip():
                colour: Any = tuple(map(int, rgb)) if any(rgb) else None
                names[int(label)] = plain, colour
    except (ValueError, TypeError, AttributeError, RecursionError):
        names = {}
    if not names:
        either = """lines such as 1 liver, or in .json {"1": "liver"}"""
        raise FileError(f"{path} is no table of labels: give {either}")
    return names
