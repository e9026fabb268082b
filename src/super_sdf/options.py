"""The table of options: name, type, default, check and help of each, and the names to choose from.

The command line, the lists of a batch and the arguments of Python functions follow it. Neither it
nor what it imports needs NumPy, so that help and wrong arguments are quick.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field, fields
from math import inf, isfinite
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypedDict, cast, get_args

from .errors import OptionError, OptionTypeError, seen

FieldKind = Literal["auto", "exact", "truncated", "mask", "scaled", "noisy"]
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
EXACT: Final = "exact"
TRUNCATED: Final = "truncated"
MASK: Final = "mask"
SCALED: Final = "scaled"
NOISY: Final = "noisy"
RAS: Final = "RAS"  # right, anterior, superior
LPS: Final = "LPS"  # left, posterior, superior
MARCHING: Final = "marching"
SHARP: Final = "sharp"
DEFAULT_MESHER: Final = AUTO
GOALS = ("simplify", "tolerance", "triangles")
"""Of these at most one may be given."""
MESH_FORMATS = ("ply", "stl", "obj", "off", "glb", "3mf")
LENGTHS = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254, "ft": 0.3048}
"""Units that mesh files state, in metres."""
FIELDS: tuple[FieldKind, ...] = get_args(FieldKind)
MESHERS: tuple[MesherName, ...] = get_args(MesherName)
DEVICES: tuple[Device, ...] = get_args(Device)
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
AUTO_PRECISION: Final = AUTO
FLOAT32: Final = "float32"
INT8: Final = "int8"
DEFAULT_QUALITY: Final = "base"
# The file of a shipped network, and the number of cube symmetries that are averaged.
QUALITIES = {"fast": ("fast", 1), "base": ("base", 1), "best": ("base", 4)}
MAX_FACTOR = 16
UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9}

Check = Callable[[Any, str], Any]  # returns a value; OptionError, by its name, if it is wrong


def _whole(least: float, way_out: str, kind: str = "a whole number") -> Check:
    """Return the check of a whole number, with what to give if it is less or no whole number."""

    def check(value: Any, name: str) -> int:
        if not isinstance(value, Integral) or isinstance(value, bool):
            raise OptionTypeError(f"{name} is {seen(value)}: give {kind}")
        if int(value) < least:
            raise OptionError(f"{name} is {seen(int(value))}: give {way_out}")
        return int(value)

    return check


def _number(kind: str = "a number", above: float = -inf, way_out: str = "a finite number") -> Check:
    """Return the check of a finite number, with what to give if it is none or not above another."""

    def check(value: Any, name: str) -> float:
        if not isinstance(value, Real) or isinstance(value, bool):
            raise OptionTypeError(f"{name} is {seen(value)}: give {kind}")
        try:
            number = float(value)
        except OverflowError:  # a whole number beyond 1.8e308
            number = inf
        if not (isfinite(number) and number > above):
            raise OptionError(f"{name} is {seen(value)}: give {way_out}")
        return number

    return check


def _numbers(counts: tuple[int, ...], way_out: str) -> Check:
    """Return the check of a number, or of several."""

    def check(value: Any, name: str) -> tuple[float, ...]:
        several = isinstance(value, Iterable) and not isinstance(value, str)
        numbers = tuple(value) if several else (value,)
        if len(numbers) not in counts:
            raise OptionError(f"{name} is {seen(value)}: give {way_out}")
        return tuple(_number()(number, name) for number in numbers)

    return check


def _one_of(choices: Iterable[str]) -> Check:
    """Return the check of a name."""
    names = tuple(choices)

    def check(value: Any, name: str) -> str:
        if isinstance(value, str) and value in names:
            return value
        kind = OptionError if isinstance(value, str) else OptionTypeError
        raise kind(f"{name} is {seen(value)}: give one of {', '.join(names)}")

    return check


def _flag(value: Any, name: str) -> bool:
    if not isinstance(value, bool) and type(value).__name__ not in ("bool_", "bool"):  # NumPy's
        raise OptionTypeError(f"{name} is {seen(value)}: give True or False, in JSON true or false")
    return bool(value)


def check_factor(factor: Any, name: str = "factor") -> int:
    """Return the factor; OptionError unless it is an even number from 2 to 16."""
    way_out = f"an even number from 2 to {MAX_FACTOR} (an odd one has no node on the samples)"
    whole: int = _whole(2, way_out)(factor, name)
    if whole > MAX_FACTOR or whole % 2:
        raise OptionError(f"{name} is {seen(whole)}: give {way_out}")
    return whole


def check_label(label: Any, name: str = "label") -> int:
    """Return a label; OptionError if no integer of 64 bits, signed or not, can be it."""
    is_whole = isinstance(label, Real) and not isinstance(label, bool) and isfinite(label)
    if not (is_whole and int(label) == label and -(2**63) <= int(label) < 2**64):
        raise OptionError(f"{name} is {seen(label)}: give a whole number, -2^63 to 2^64 - 1")
    return int(label)


def check_labels(labels: Any, name: str = "labels") -> str | tuple[int | str, ...]:
    """Return "all" or some labels, numbers or names; OptionError if it is neither."""
    if isinstance(labels, str) and labels == ALL:
        return ALL
    if isinstance(labels, (str, bytes)) or not hasattr(labels, "__iter__"):
        raise OptionError(f"{name} is {seen(labels)}: give all, or some labels such as 1,2,3")
    return tuple(each if isinstance(each, str) else check_label(each, name) for each in labels)


def check_path(path: Any, name: str) -> Path:
    """Return an argument as a path; OptionTypeError if it is neither a string nor a path."""
    if not isinstance(path, (str, PathLike)):
        raise OptionTypeError(f"{name} is {seen(path)}: give the path of a file")
    return Path(path)


def check_network(network: Any) -> None:
    """Raise OptionTypeError if it cannot be called."""
    if not callable(network):
        raise OptionTypeError(f"network is {seen(network)}: give one from load_network()")


def check_progress(progress: Any) -> None:
    """Raise OptionTypeError if it is neither None nor callable."""
    if progress is not None and not callable(progress):
        way_out = "give a function of (done, total), in thousandths"
        raise OptionTypeError(f"progress is {seen(progress)}: {way_out}")


def check_goal(error: Any, triangles: Any) -> tuple[float | None, int | None]:
    """Return to what a mesh is simplified: within an error, or to a number of triangles.

    OptionError unless one of them is given, and only one.
    """
    if error is None and triangles is None:
        raise OptionError("give error or triangles")
    check_one({"error": error, "triangles": triangles})
    error = OPTIONS["simplify"].check(error, "error")
    return error, OPTIONS["triangles"].check(triangles, "triangles")


def check_one(options: dict[str, Any]) -> None:
    """Raise OptionError if more than one is given; the others are None."""
    given = [f"{name} {seen(value)}" for name, value in options.items() if value is not None]
    if len(given) > 1:
        raise OptionError(f"{given[0]} and {given[1]}: give only one of them")


def _parse_numbers(counts: tuple[int, ...], way_out: str) -> Callable[[str], tuple[float, ...]]:
    """Return a parser of numbers separated by commas."""

    def parse(text: str) -> tuple[float, ...]:
        with suppress(ValueError):
            if len(numbers := tuple(map(float, text.split(",")))) in counts:
                return numbers
        raise ValueError(f"give {way_out}")

    return parse


_one_or_three = _parse_numbers((1, 3), "one number, or three separated by commas")


def parse_label(text: str) -> int | str:
    """Parse a whole number, never as a float; other text is left to the check."""
    return int(text) if re.fullmatch("[-+]?[0-9]{1,20}", text) else text


def _parse_plain(way_out: str) -> Callable[[str], float]:
    """Return what parses a number without a unit, with what to give instead of "0.01mm"."""

    def parse(text: str) -> float:
        try:
            return float(text)
        except ValueError:
            raise ValueError(way_out) from None

    return parse


def parse_labels(text: str) -> str | tuple[int | str, ...]:
    """Parse "all", or labels separated by commas."""
    return text if text == ALL else tuple(parse_label(part.strip()) for part in text.split(","))


def parse_size(text: str) -> int:
    """Parse a number of bytes, such as "1500M" or "4G"; the units are powers of ten."""
    number, unit = (text, "") if text[-1:].isdigit() else (text[:-1], text[-1:].upper())
    with suppress(KeyError, ValueError, OverflowError):
        if (size := int(float(number) * UNITS[unit])) > 0:
            return size
    raise ValueError("give a number of bytes such as 1500M or 4G")


class Option(NamedTuple):
    """A row of the table."""

    name: str  # in Python and in the lists of a batch
    default: Any
    help: str
    check_value: Check  # of a value that is not None
    parse: Callable[[str], Any]  # of text; ValueError says what to give instead
    metavar: str | None = None
    choices: tuple[str, ...] = ()  # all values, if there are only some
    off: str = ""  # a flag's opposite on the command line

    def check(self, value: Any, name: str = "") -> Any:
        """Return a value, by another name in messages; OptionError if it is wrong."""
        if value is None and self.default is None:
            return None
        return self.check_value(value, name or self.name)


def _option(default: Any, text: str, check: Check, parse: Any = str, **more: Any) -> Any:
    """Return a field of a dataclass that is a row of the table."""
    row = {"help": text, "check_value": check, "parse": parse, **more}
    return field(default=default, metadata=row)


def _choice(default: str | None, text: str, choices: Iterable[str]) -> Any:
    return _option(default, text, _one_of(choices), choices=tuple(choices))


class Values(TypedDict, total=False):
    """What the values of a grid are: keywords of ``read_grid`` and of others that make grids."""

    inside: Inside
    field: FieldKind
    label: int | None
    level: float | None
    scale: float | None


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """How a grid is read: where its samples lie, and what they are; see ``read_grid``."""

    spacing: tuple[float, ...] | None = _option(
        None,
        "World distance between neighbouring samples: one number, or X,Y,Z where it differs "
        "between axes; distances are resampled to the finest then. Default: from the file, else "
        "estimated from the values.",
        _numbers((1, 3), "one number, or three"),
        _one_or_three,
        metavar="H",
    )
    origin: tuple[float, ...] | None = _option(
        None,
        "World position of sample (0, 0, 0). Default: from the file, else 0,0,0.",
        _numbers((1, 3), "one number, or three"),
        _one_or_three,
        metavar="X,Y,Z",
    )
    direction: tuple[float, ...] | None = _option(
        None,
        "World directions of the axes x, y and z of the array: the columns of a rotation or "
        "mirrored rotation, as nine numbers with commas, row by row. Files of other formats than "
        "NumPy, TIFF, HDF5 and Zarr state it.",
        _numbers((9,), "nine numbers, row by row"),
        _parse_numbers((9,), "nine numbers separated by commas, row by row"),
        metavar="MATRIX",
    )
    axes: AxisOrder | None = _choice(
        None,
        "Axis order of the array in a NumPy, TIFF, HDF5 or Zarr file. Default: the names "
        "of the axes in the file, else xyz for NumPy, zyx for the others. Files of other formats "
        "state it.",
        get_args(AxisOrder),
    )
    space: Space | None = _choice(
        None,
        "Anatomical space of the mesh, for files that state theirs, as medical images do. Default: "
        "that of the file, which .ply, .stl and .obj name in their header.",
        get_args(Space),
    )
    inside: Inside = _choice(
        AUTO,
        "Sign of the values inside the solid; auto takes the border of the grid as outside.",
        get_args(Inside),
    )
    field: FieldKind = _choice(
        AUTO,
        "What the values are: exact distances, truncated near the surface, a mask (inside or "
        "outside, or its distance transform), scaled (a field of another slope than 1), or noisy "
        "distances; auto goes by what the samples show.",
        FIELDS,
    )
    label: int | None = _option(
        None,
        "Mesh the samples with the value N of a label image.",
        check_label,
        parse_label,
        metavar="N",
    )
    level: float | None = _option(
        None,
        "Mesh the surface at the value L of densities; what is above L is inside, unless "
        "--inside is negative.",
        _number(),
        float,
        metavar="L",
    )
    scale: float | None = _option(
        None,
        "World units per unit of the values, if they have another unit than the spacing.",
        _number(above=0, way_out="a number greater than 0"),
        float,
        metavar="S",
    )
    max_memory: int | None = _option(
        None,
        "Memory limit of the process, such as 1500M or 4G. Default: 60 % of the free memory. "
        "Larger grids are refined slab by slab, to the same mesh.",
        _whole(1, "a number of bytes greater than 0", "a whole number of bytes"),
        parse_size,
        metavar="SIZE",
    )

    def __post_init__(self) -> None:
        """Check the values; OptionError names the first that is wrong, or contradicts another."""
        for each in fields(self):
            if each.metadata:
                OPTIONS[each.name].check(getattr(self, each.name))
        if self.label is not None and self.level is not None:
            raise OptionError(f"label {self.label} and level {self.level:g}: give only one of them")
        if self.label is not None and self.field not in (AUTO, MASK):
            said = f"label {self.label} and field {self.field}"
            raise OptionError(f"{said}: the samples of a label are a mask")

    def reading(self) -> dict[str, Any]:
        """Return the keywords of ``read_grid``."""
        return {each.name: getattr(self, each.name) for each in fields(ReadOptions)}

    def values(self) -> Values:
        """Return what the values are: keywords of ``make_grid``."""
        return cast(Values, {name: getattr(self, name) for name in Values.__annotations__})


@dataclass(frozen=True)
class ConvertOptions(ReadOptions):
    """The options of a conversion; see ``read_grid``, ``reconstruct`` and ``simplify_mesh``.

    ``simplify`` is an error in voxels; at most one of it, ``tolerance`` and ``triangles`` may be
    given.
    """

    factor: int = _option(
        4, "Refinement per axis: 2, 4, 8 or 16 times finer than the grid.", check_factor, int
    )
    offset: float = _option(
        0.0,
        "Mesh the offset surface at distance D, in world units; a positive D grows the "
        "solid, whichever sign is inside.",
        _number("a number, in world units", way_out="a finite number, in world units"),
        float,
        metavar="D",
    )
    cap: bool = _option(
        True,
        "Where the solid runs out of the grid, close the surface along the border, which is "
        "the default, or leave it open. A surface that ends where samples are unknown needs "
        "--open.",
        _flag,
        bool,
        off="open",
    )
    mesher: MesherName = _choice(
        DEFAULT_MESHER,
        "Mesher: marching is marching cubes, which cuts off edges and corners; sharp also puts "
        "vertices on them; auto is sharp for distances, and marching for masks and noise.",
        MESHERS,
    )
    simplify: float | None = _option(
        None,
        "Simplify the mesh as far as it stays within ERROR of the unsimplified one, in voxels "
        "of the grid (such as 0.02), measured both ways. A closed mesh stays closed. Needs the "
        "extra simplify.",
        _number("a number greater than 0", above=0, way_out="a number greater than 0"),
        _parse_plain("give a number of voxels; --tolerance takes world units"),
        metavar="ERROR",
    )
    tolerance: float | None = _option(
        None,
        "Simplify as with --simplify, but within D in world units, such as millimetres.",
        _number("a number greater than 0", above=0, way_out="a number greater than 0"),
        _parse_plain("give a number without a unit; it is in world units"),
        metavar="D",
    )
    triangles: int | None = _option(
        None,
        "Simplify the mesh to at most N triangles, instead of --simplify. If the shape needs "
        "more, a warning says how many are left.",
        _whole(4, "4 or more, as a closed mesh has"),
        int,
        metavar="N",
    )
    unit: Unit | None = _choice(
        None,
        "Unit of the world, which .3mf and .glb state, so that other programs show the true size. "
        "Default: a .3mf says millimetres, a .glb metres. Coordinates stay as they are.",
        get_args(Unit),
    )
    keep_volume: bool = _option(
        False,
        "For masks and labels: move each surface along its normals, by a small part of a voxel, "
        "until the volume of the mesh is that of its samples, each of which counts as a box.",
        _flag,
        bool,
    )
    labels: str | tuple[int | str, ...] | None = _option(
        None,
        "Mesh all labels of a label image but 0, or those listed, each with a closed mesh; "
        "neighbours share their walls. A .glb or .3mf holds all as parts; of other formats each "
        "label N has its own file, NAME-N.ply. A listed label that an image lacks is left out, "
        "with a note.",
        check_labels,
        parse_labels,
        metavar="all|N,N",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.goals()
        check_one(given)
        for name, value in given.items():
            OPTIONS[name].check(value, name)

    def goals(self) -> dict[str, Any]:
        """Return what says how far the mesh is to be simplified, by its name: at most one."""
        return {name: value for name in GOALS if (value := getattr(self, name)) is not None}

    def error(self, voxel_size: float) -> float | None:
        """Return the error within which to simplify, in world units."""
        return self.tolerance if self.simplify is None else self.simplify * voxel_size

    def digest(self) -> dict[str, Any]:
        """Return all that the mesh depends on, which the memory is not, for JSON."""
        return {name: getattr(self, name) for name in BATCH_LISTS}


@dataclass(frozen=True)
class NetworkOptions:
    """Which network, and where it runs; see ``load_network``."""

    quality: Quality = _choice(
        DEFAULT_QUALITY,
        "Network: fast is smaller and quicker than base; best averages base over 4 turns of the "
        "grid, and takes 4 times as long.",
        get_args(Quality),
    )
    precision: Precision = _choice(
        AUTO_PRECISION,
        "Arithmetic of the network: auto is int8 on the CPU if the network has it, otherwise "
        "float32. On the CPU int8 takes about half as long.",
        PRECISIONS,
    )
    model: str | None = _option(
        None,
        "Use the network in this ONNX file instead of --quality.",
        lambda value, name: value,
        metavar="FILE",
    )
    device: Device = _choice(
        AUTO,
        "Where the network runs; auto uses CUDA if it works here, else the CPU.",
        DEVICES,
    )
    threads: int = _option(
        0,
        "CPU threads; 0 means one per core.",
        _whole(0, "1 or more, or 0 for one per core", "a whole number, 0 for one per core"),
        int,
    )


OPTIONS = {
    each.name: Option(each.name, each.default, **each.metadata)
    for each in (*fields(ConvertOptions), *fields(NetworkOptions))
}
GRID = tuple(each.name for each in fields(ReadOptions) if each.name != "max_memory")
MESH = ("factor", *GRID, "offset", "cap", "mesher")
UPSAMPLE = (
    *(*MESH, "quality", "precision", "model", "device", "max_memory", "threads"),
    *GOALS,
    "keep_volume",
    "unit",
)
"""What ``upsample``, ``batch`` and ``view`` take, in the order of their help."""
BATCH_LISTS = (*MESH, *GOALS, "keep_volume", "unit", "labels")
"""What a line of a batch's list may say."""
LABELS = (
    *("labels", "factor", "spacing", "origin", "direction", "axes", "space"),
    *("max_memory", "keep_volume", "unit"),
)
"""What of ``ConvertOptions`` goes with ``--labels``."""

check_distance = OPTIONS["offset"].check
check_cap = OPTIONS["cap"].check
check_mesher = OPTIONS["mesher"].check
check_max_memory = OPTIONS["max_memory"].check
check_space, check_unit = OPTIONS["space"].check, OPTIONS["unit"].check
check_threads = OPTIONS["threads"].check
