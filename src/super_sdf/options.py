"""The table of options: name, type, default, where each shows, check and help.

``Options`` holds a value of each and is passed whole. The options of the command line, what a line
of a batch's list may say, the JSON report and the checks of Python's arguments are made of its
rows, so a new option is a row here and the line that uses it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, fields
from math import inf, isfinite
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypedDict, get_args

from .errors import OptionError, OptionTypeError, flag, seen

FieldKind = Literal["auto", "distance", "noisy", "mask", "smooth"]
Inside = Literal["auto", "negative", "positive"]
AxisOrder = Literal["xyz", "zyx"]
Space = Literal["RAS", "LPS"]
MesherName = Literal["auto", "marching", "sharp"]
Unit = Literal["um", "mm", "cm", "m", "in", "ft"]
Quality = Literal["fast", "base", "best"]
Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["auto", "float32", "int8"]

ALL: Final = "all"
AUTO: Final = "auto"
DISTANCE: Final = "distance"
NOISY: Final = "noisy"
MASK: Final = "mask"
SMOOTH: Final = "smooth"
RAS: Final = "RAS"  # right, anterior, superior
LPS: Final = "LPS"  # left, posterior, superior
MARCHING: Final = "marching"
SHARP: Final = "sharp"
FLOAT32: Final = "float32"
INT8: Final = "int8"
DEFAULT_QUALITY: Final = "base"
FIELDS: tuple[FieldKind, ...] = get_args(FieldKind)
OTHER_FIELDS = {"exact": DISTANCE, "truncated": DISTANCE, "scaled": SMOOTH}  # and their names
MESHERS: tuple[MesherName, ...] = get_args(MesherName)
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
MESH_FORMATS = ("ply", "stl", "obj", "off", "glb", "3mf")
LENGTHS = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254, "ft": 0.3048}
"""Units that mesh files state, in metres."""
QUALITIES = {"fast": ("fast", 1), "base": ("base", 1), "best": ("base", 4)}
"""The file of each shipped network, and over how many turns of the grid it is averaged."""
GOALS = ("simplify", "tolerance", "triangles")
EXCLUSIVE = (GOALS, ("label", "level"), ("model", "quality"))
"""Of each of these at most one may be given."""


class Kind(NamedTuple):
    """What the values of an option are."""

    give: str  # what to give instead of a wrong value
    check: Callable[[Any, str], Any]  # returns the value; OptionError, by a name, if it is wrong
    parse: Callable[[str], Any] = str  # makes a value of text; ValueError if it can be none
    choices: tuple[str, ...] = ()  # all values, if there are only some


def wrong(value: Any, name: str, give: str, is_type: bool = False) -> OptionError:
    """Return the error for a value, which may be of a wrong type."""
    shown = f"{value:g}" if isinstance(value, float) else seen(value)
    return (OptionTypeError if is_type else OptionError)(f"{name} is {shown}: give {give}")


def number(give: str, above: float = -inf, most: float = inf, step: int | None = None) -> Kind:
    """Return the kind of numbers in a range, or of multiples of a step."""
    of: Any = Integral if step else Real
    make: Any = int if step else float

    def check(value: Any, name: str) -> Any:
        if not isinstance(value, of) or isinstance(value, bool):
            raise wrong(value, name, give, is_type=True)
        with suppress(OverflowError):  # a whole number beyond 1.8e308
            found = make(value)
            if isfinite(found) and above < found <= most and not (step and found % step):
                return found
        raise wrong(int(value) if step else value, name, give)

    return Kind(give, check, make)


def numbers(counts: tuple[int, ...], give: str) -> Kind:
    """Return the kind of several numbers, of which there may be one, separated by commas."""

    def check(value: Any, name: str) -> tuple[float, ...]:
        several = isinstance(value, Iterable) and not isinstance(value, str)
        found = tuple(value) if several else (value,)
        if len(found) not in counts:
            raise wrong(value, name, give)
        return tuple(number("a finite number").check(each, name) for each in found)

    def parse(text: str) -> tuple[float, ...]:
        if len(found := tuple(map(float, text.split(",")))) not in counts:
            raise ValueError(text)
        return found

    return Kind(give, check, parse)


def one_of(names: Iterable[str], others: Mapping[str, str] | None = None) -> Kind:
    """Return the kind of some names; messages name those for ``others``."""
    choices = tuple(names)
    give = f"one of {', '.join(choices)}"

    def check(value: Any, name: str) -> str:
        if isinstance(value, str) and value in choices:
            return value
        is_text = isinstance(value, str)
        instead = (others or {}).get(value, give) if is_text else give
        raise wrong(value, name, instead, is_type=not is_text)

    return Kind(give, check, choices=choices)


def _flag(value: Any, name: str) -> bool:
    if not isinstance(value, bool) and type(value).__name__ not in ("bool_", "bool"):  # NumPy's
        raise wrong(value, name, "True or False, in JSON true or false", is_type=True)
    return bool(value)


def check_label(label: Any, name: str = "--label") -> int:
    """Return a label; OptionError if no integer of 64 bits, signed or not, can be it."""
    is_whole = isinstance(label, Real) and not isinstance(label, bool) and isfinite(label)
    if not (is_whole and int(label) == label and -(2**63) <= int(label) < 2**64):
        raise wrong(label, name, "a whole number, -2^63 to 2^64 - 1")
    return int(label)


def check_labels(labels: Any, name: str = "--labels") -> str | tuple[int | str, ...]:
    """Return "all" or some labels, numbers or names; OptionError if it is neither."""
    if isinstance(labels, str) and labels == ALL:
        return ALL
    if isinstance(labels, (str, bytes)) or not hasattr(labels, "__iter__"):
        raise wrong(labels, name, "all, or some labels such as 1,2,3")
    return tuple(each if isinstance(each, str) else check_label(each, name) for each in labels)


def _parse_label(text: str) -> int | str:
    """Parse a whole number, never as a float; other text may be a name."""
    return int(text) if re.fullmatch("[-+]?[0-9]{1,20}", text) else text


def _parse_labels(text: str) -> str | tuple[int | str, ...]:
    return text if text == ALL else tuple(_parse_label(part.strip()) for part in text.split(","))


def parse_size(text: str) -> int:
    """Parse a number of bytes, such as "1500M" or "4G"; the units are powers of ten."""
    amount, unit = (text, "") if text[-1:].isdigit() else (text[:-1], text[-1:].upper())
    with suppress(KeyError, OverflowError):
        return int(float(amount) * {"": 1, "K": 10**3, "M": 10**6, "G": 10**9}[unit])
    raise ValueError(text)


# fmt: off
ABOVE_0, POINT = number("a number greater than 0", above=0), numbers((1, 3), "one number, or three")
FACTOR = number("an even number from 2 to 16 (an odd one has no node on the samples)",
    above=0, most=16, step=2)
VOXELS = number("a number greater than 0, in voxels (--tolerance takes world units)", above=0)
MEMORY = number("a number of bytes greater than 0, such as 1500M or 4G", above=0, step=1)
FLAG = Kind("", _flag)
# fmt: on


class Option(NamedTuple):
    """A row of the table."""

    name: str
    default: Any
    group: str  # the heading in the help of a command
    shows: frozenset[str]  # besides Options and upsample: in "read", "list", "labels"
    kind: Kind
    help: str
    metavar: str | None = None
    off: str = ""  # a flag's opposite on the command line

    def check(self, value: Any, name: str = "") -> Any:
        """Return a value as the program takes it; OptionError, by another name, if it is wrong."""
        is_left_out = value is None and self.default is None
        return None if is_left_out else self.kind.check(value, name or flag(self.name))

    def parse(self, text: str) -> Any:
        """Return the value, not checked, that a text on the command line stands for."""
        try:
            return self.kind.parse(text)
        except ValueError:
            raise wrong(text, flag(self.name), self.kind.give) from None


def _option(default: Any, group: str, shows: str, kind: Kind, text: str, **more: Any) -> Any:
    """Return a field of a dataclass that is a row of the table."""
    row = {"group": group, "shows": frozenset(shows.split()), "kind": kind, "help": text, **more}
    return field(default=default, metadata=row)


GRID, VALUES, MESH, WORK = "The grid", "Its values", "The mesh", "The work"


class Values(TypedDict, total=False):
    """What the values of a grid are: keywords of ``read_grid`` and of others that make grids."""

    inside: Inside
    field: FieldKind
    label: int | None
    level: float | None
    scale: float | None
    unknown: float | None


@dataclass(frozen=True)
class Options:
    """What a conversion may be told; see ``read_grid``, ``reconstruct``, ``load_network``.

    A row says where an option shows: "read" for ``read_grid`` and ``check``, "list" for the lists
    of a batch and what the mesh depends on, "labels" for what goes with ``labels``.
    """

    # fmt: off
    factor: int | None = _option(None, MESH, "list labels", FACTOR,
        "How many times finer than the grid per axis: an even number from 2 to 16. Default: 2 for "
        "masks and labels, else 4.", metavar="K")
    _: KW_ONLY
    spacing: tuple[float, ...] | None = _option(None, GRID, "read list labels", POINT,
        "World distance between neighbouring samples: one number, or X,Y,Z. Default: from the "
        "file, else estimated from the values.", metavar="H")
    origin: tuple[float, ...] | None = _option(None, GRID, "read list labels", POINT,
        "World position of sample (0, 0, 0). Default: from the file, else 0,0,0.", metavar="X,Y,Z")
    direction: tuple[float, ...] | None = _option(None, GRID, "read list labels",
        numbers((9,), "nine numbers, row by row"),
        "World directions of the array's axes: a rotation, maybe mirrored, as nine numbers row by "
        "row. For NumPy, TIFF, HDF5 and Zarr; other files state it.", metavar="MATRIX")
    axes: AxisOrder | None = _option(None, GRID, "read list labels", one_of(get_args(AxisOrder)),
        "Axis order of an array in NumPy, TIFF, HDF5 or Zarr. Default: by the names of the axes, "
        "else xyz for NumPy, zyx for the others.")
    space: Space | None = _option(None, GRID, "read list labels", one_of(get_args(Space)),
        "Anatomical space of the mesh, for files that state theirs. Default: that of the file.")
    inside: Inside = _option(AUTO, VALUES, "read list", one_of(get_args(Inside)),
        "Sign of the values inside the solid; auto takes the border of the grid as outside.")
    field: FieldKind = _option(AUTO, VALUES, "read list", one_of(FIELDS, OTHER_FIELDS),
        "What the values are: distances, distances with noise, a mask or its transform, or a "
        "smooth field, which has the surface of its own cubic spline; auto goes by the samples.")
    label: int | None = _option(None, VALUES, "read list", Kind("", check_label, _parse_label),
        "Mesh the samples with the value N of a label image, or its name by --names.",
        metavar="N")
    labels: str | tuple[int | str, ...] | None = _option(None, VALUES, "list labels",
        Kind("", check_labels, _parse_labels),
        "Mesh all labels of a label image but 0, or those listed, with shared walls: as parts of "
        "a .glb or .3mf, else each in its own file, NAME-N.ply.", metavar="all|N,N")
    level: float | None = _option(None, VALUES, "read list", number("a finite number"),
        "Mesh the surface at the value L of densities; above L is inside, unless --inside is "
        "negative.", metavar="L")
    scale: float | None = _option(None, VALUES, "read list", ABOVE_0,
        "World units per unit of the values, if they have another unit than the spacing.",
        metavar="S")
    unknown: float | None = _option(None, VALUES, "read list", number("a finite number"),
        "Samples with the value V are unknown, as those that are NaN.", metavar="V")
    offset: float = _option(0.0, MESH, "list",
        number("a finite number, in world units"),
        "Mesh the offset surface at distance D, in world units; a positive D grows the solid.",
        metavar="D")
    cap: bool = _option(True, MESH, "list", FLAG,
        "Close the surface along the border of the grid (default), or leave it open there, as one "
        "that ends at unknown samples must be.", off="open")
    mesher: MesherName = _option(AUTO, MESH, "list", one_of(MESHERS),
        "marching is marching cubes, which cuts off edges and corners; sharp puts vertices on "
        "them; auto is sharp for distances, marching for masks and noise.")
    simplify: float | None = _option(None, MESH, "list labels", VOXELS,
        "Simplify the mesh within ERROR voxels of the unsimplified one, such as 0.02, both ways. "
        "Needs the extra simplify.", metavar="ERROR")
    tolerance: float | None = _option(None, MESH, "list labels",
        number("a number greater than 0, in world units", above=0),
        "Simplify as with --simplify, but within D in world units.", metavar="D")
    triangles: int | None = _option(None, MESH, "list",
        number("a whole number, 4 or more, as a closed mesh has", above=3, step=1),
        "Simplify the mesh to at most N triangles, instead of --simplify.", metavar="N")
    keep_volume: bool = _option(False, MESH, "list labels", FLAG,
        "Of masks and labels: move each surface by a small part of a voxel until its volume is "
        "that of its samples, as boxes.")
    unit: Unit | None = _option(None, MESH, "list labels", one_of(LENGTHS),
        "Unit of the world, which .3mf (default: millimetres) and .glb (metres) state. "
        "Coordinates stay as they are.")
    quality: Quality | None = _option(None, WORK, "labels", one_of(QUALITIES),
        "Network: fast is quicker than base, the default; best averages base over 4 turns of the "
        "grid, and takes 4 times as long.")
    model: str | None = _option(None, WORK, "labels",
        Kind("", lambda value, name: str(check_path(value, name))),
        "Use the network in this ONNX file instead of --quality.", metavar="FILE")
    precision: Precision = _option(AUTO, WORK, "labels", one_of(PRECISIONS),
        "Arithmetic of the network: auto is int8, twice as fast, on the CPU if the network has "
        "it, else float32.")
    device: Device = _option(AUTO, WORK, "labels", one_of(get_args(Device)),
        "Where the network runs; auto uses CUDA if it works here, else the CPU.")
    threads: int = _option(0, WORK, "labels",
        number("1 or more, or 0 for one per core", above=-1, step=1),
        "CPU threads; 0 means one per core.", metavar="N")
    max_memory: int | None = _option(None, WORK, "labels", MEMORY._replace(parse=parse_size),
        "Memory limit of the process, such as 4G. Default: 60 % of the free memory. Larger grids "
        "are refined in boxes, whose meshes are joined.", metavar="SIZE")
    # fmt: on

    def __post_init__(self) -> None:
        """Check the values; OptionError names the first that is wrong, or contradicts another."""
        for name, row in OPTIONS.items():
            object.__setattr__(self, name, row.check(getattr(self, name)))
        check_alone(vars(self))
        if self.label is not None and self.field not in (AUTO, MASK):
            said = f"--label {self.label} and --field {self.field}"
            raise OptionError(f"{said}: the samples of a label are a mask")

    def reading(self) -> dict[str, Any]:
        """Return the keywords of ``read_grid``."""
        return {name: getattr(self, name) for name in (*READ, "max_memory")}

    def mesher_for(self, *, exact: bool) -> MesherName:
        """Return the mesher; by itself ``sharp`` if samples are exact: else it finds no edges."""
        automatic: MesherName = SHARP if exact else MARCHING
        return automatic if self.mesher == AUTO else self.mesher

    def factor_for(self, *, mask: bool) -> int:
        """Return the factor: masks show no details for which 2 is too few."""
        return self.factor or (2 if mask else 4)

    def goals(self) -> dict[str, Any]:
        """Return what says how far the mesh is to be simplified, by its name: at most one."""
        return {name: value for name in GOALS if (value := getattr(self, name)) is not None}

    def error(self, voxel_size: float) -> float | None:
        """Return the error within which to simplify, in world units."""
        return self.tolerance if self.simplify is None else self.simplify * voxel_size

    def digest(self) -> dict[str, Any]:
        """Return all that the mesh depends on besides the network, for JSON."""
        return {name: getattr(self, name) for name in BATCH_LISTS}

    def network(self) -> dict[str, Any]:
        """Return the keywords of ``load_network``."""
        names = ("device", "threads", "precision")
        chosen = self.model or self.quality or DEFAULT_QUALITY
        return {"model": chosen, **{name: getattr(self, name) for name in names}}


OPTIONS = {
    each.name: Option(each.name, each.default, **each.metadata)
    for each in fields(Options)
    if each.metadata
}
READ, BATCH_LISTS, LABELS = (
    tuple(name for name, row in OPTIONS.items() if where in row.shows)
    for where in ("read", "list", "labels")
)


def check_alone(given: Mapping[str, Any]) -> None:
    """Raise OptionError if two options are given that exclude each other; others are None."""
    for names in EXCLUSIVE:
        some = [f"{flag(n)} {seen(given[n])}" for n in names if given.get(n) is not None]
        if len(some) > 1:
            raise OptionError(f"{some[0]} and {some[1]}: give only one of them")


def check_path(path: Any, name: str) -> Path:
    """Return an argument as a path; OptionTypeError if it is neither a string nor a path."""
    if not isinstance(path, (str, PathLike)):
        raise wrong(path, name, "the path of a file", is_type=True)
    return Path(path)


def check_called(network: Any, progress: Any) -> None:
    """Raise OptionTypeError if a network, or a progress that is not None, cannot be called."""
    if not callable(network):
        raise wrong(network, "network", "one from load_network()", is_type=True)
    if progress is not None and not callable(progress):
        give = "a function of (done, total), in thousandths"
        raise wrong(progress, "progress", give, is_type=True)


def check_goal(error: Any, triangles: Any) -> tuple[float | None, int | None]:
    """Return to what a mesh is simplified, an error or a number; OptionError unless it is one."""
    if (error is None) == (triangles is None):
        raise OptionError("give error or triangles, and only one of them")
    found = None if error is None else ABOVE_0.check(error, "error")
    return found, OPTIONS["triangles"].check(triangles)
