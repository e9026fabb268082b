"""The table of options: name, type, default, where each shows, check and help.

``Options`` holds a value of each and is passed whole. The options of the command line, what a line
of a batch's list may say, the JSON report and the checks of Python's arguments are made of its
rows. So a new option is a row here, the line that uses it, and a parameter of ``reconstruct``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import KW_ONLY, dataclass, field, fields
from functools import partial
from math import inf, isfinite
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypedDict, get_args

import numpy as np

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

DEFAULT_QUALITY: Final = "base"
MESH_FORMATS = ("ply", "stl", "obj", "off", "glb", "3mf")
LENGTHS = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254, "ft": 0.3048}
"""Units that mesh files state, in metres."""
STATED = re.compile("(?i)it states, (?:(?P<mm>mm|milli)|(?P<um>[uµμ]m|micro)|(?P<cm>c)|(?P<m>m))")
QUALITIES = {"fast": ("fast", 1), "base": ("base", 1), "best": ("base", 4)}
"""The file of each shipped network, and over how many turns of the grid it is averaged."""
GOALS = ("simplify", "tolerance", "triangles")
EXCLUSIVE = (GOALS, ("label", "level"), ("model", "quality"))
"""Of each of these at most one may be given."""


class Kind(NamedTuple):
    """What the values of an option are. Text is taken as on the command line."""

    give: str  # what to give instead of a wrong value
    make: Callable[[Any], Any]  # returns the value as the program takes it; TypeError, ValueError
    types: Any = object  # what the value must be, a class or several
    choices: tuple[str, ...] = ()  # all values, if there are only some

    def check(self, value: Any, name: str) -> Any:
        """Return a value as the program takes it; OptionError, by a name, if it is wrong."""
        try:
            if not isinstance(value, self.types):
                raise TypeError
            return self.make(value)
        except (TypeError, ValueError, OverflowError) as error:
            shown = f"{value}" if isinstance(value, Real) else seen(value)
            kind = OptionTypeError if isinstance(error, TypeError) else OptionError
            raise kind(f"{name} is {shown}: give {self.give}") from None


BOOLEANS = bool, np.bool_
FLAG = Kind("True or False, in JSON true or false", bool, BOOLEANS)
PATH = Kind("the path of a file", Path, (str, PathLike))
NETWORK = Kind("one from load_network()", lambda network: network, Callable)


def one_of(names: Any) -> Kind:
    """Return the kind of the names in a ``Literal``."""
    choices = get_args(names)
    give = f"one of {', '.join(choices)}"
    return Kind(give, lambda value: choices[choices.index(value)], str, choices)


def number(give: str, above: float = -inf, most: float = inf, step: int = 0) -> Kind:
    """Return the kind of numbers in a range, or of whole ones that are multiples of a step."""

    def make(value: Any) -> Any:
        found = int(value) if step else float(value)
        if isinstance(value, BOOLEANS) or (step and found != value and not isinstance(value, str)):
            raise TypeError
        if not isfinite(found) or not above < found <= most or (step and found % step):
            raise ValueError
        return found

    return Kind(give, make)


def numbers(counts: tuple[int, ...], value: Any) -> tuple[float, ...]:
    """Return numbers, as many as one of the counts; there may be one, or text with commas."""
    parts = value.split(",") if isinstance(value, str) else value
    found = tuple(map(ANY.make, parts if isinstance(parts, Iterable) else [parts]))
    if len(found) not in counts:
        raise ValueError
    return found


ANY, ABOVE_0 = number("a finite number"), number("a number greater than 0", above=0)
COUNT, POINT = number("", above=0, step=1), Kind("one number, or three", partial(numbers, (1, 3)))
LABEL = number("a whole number, -2^63 to 2^64 - 1", -(2**63) - 1, 2**64 - 1, step=1)


def _labels(value: Any) -> str | tuple[int | str, ...]:
    """Return "all", or some labels, numbers or names; in text with commas."""
    if not isinstance(value, str):
        return tuple(each if isinstance(each, str) else LABEL.make(each) for each in value)
    parts = [part.strip() for part in value.split(",")]
    is_number = re.compile("[-+]?[0-9]+").fullmatch
    return "all" if value == "all" else tuple(int(n) if is_number(n) else n for n in parts)


def _bytes(value: Any) -> int:
    """Return a number of bytes, in text such as "1500M" or "4G"; the units are powers of ten."""
    if isinstance(value, str):
        power = "KMG".find(value[-1:].upper()) + 1
        value = int(float(value[:-1] if power else value) * 1000**power)
    return int(COUNT.make(value))


class Option(NamedTuple):
    """A row of the table."""

    group: str  # the heading in the help of a command
    shows: str  # besides Options and upsample: of "read", "list", "labels" those that hold
    kind: Kind
    help: str
    metavar: str | None = None
    off: str = ""  # a flag's opposite on the command line
    name: str = ""
    default: Any = None

    def check(self, value: Any) -> Any:
        """Return a value as the program takes it; OptionError if it is wrong."""
        is_left_out = value is None and self.default is None
        return None if is_left_out else self.kind.check(value, flag(self.name))


def _option(default: Any, *row: Any, **more: Any) -> Any:
    """Return a field of a dataclass that is a row of the table."""
    return field(default=default, metadata={"row": Option(*row, **more)})


GRID, VALUES, MESH, WORK = "The grid", "The values", "The mesh", "The work"


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
    factor: int | None = _option(None, MESH, "list labels", number(
        "an even number from 2 to 16 (an odd one has no node on the samples)", 0, 16, step=2),
        "How many times finer than the grid per axis: an even number from 2 to 16. Default: 2 for "
        "masks and labels, else 4.", "K")
    _: KW_ONLY
    spacing: tuple[float, ...] | None = _option(None, GRID, "read list labels", POINT,
        "World distance between neighbouring samples: one number, or X,Y,Z. Default: from the "
        "file, else estimated from the values.", "H")
    origin: tuple[float, ...] | None = _option(None, GRID, "read list labels", POINT,
        "World position of sample (0, 0, 0). Default: from the file, else 0,0,0.", "X,Y,Z")
    direction: tuple[float, ...] | None = _option(None, GRID, "read list labels",
        Kind("nine numbers, row by row", partial(numbers, (9,))),
        "World directions of the array's axes: a matrix with a unit vector in each column, as nine "
        "numbers row by row. For NumPy, TIFF, HDF5 and Zarr; other formats state axes.", "MATRIX")
    axes: AxisOrder | None = _option(None, GRID, "read list labels", one_of(AxisOrder),
        "Axis order of an array in NumPy, TIFF, HDF5 or Zarr. Default: by the names of the axes, "
        "else xyz for NumPy, zyx for the others.")
    space: Space | None = _option(None, GRID, "read list labels", one_of(Space),
        "Anatomical space of the mesh, for files that state a space. Default: the file's space.")
    inside: Inside = _option("auto", VALUES, "read list", one_of(Inside),
        "Sign of the values inside the solid; auto takes the border of the grid as outside.")
    field: FieldKind = _option("auto", VALUES, "read list", one_of(FieldKind),
        "What the values are: distances, distances with noise, a mask or a distance transform of a "
        "mask, or a smooth field, meshed by its cubic spline; auto decides by the values.")
    label: int | None = _option(None, VALUES, "read list", LABEL,
        "Mesh the samples with the value N of a label image.", "N")
    labels: str | tuple[int | str, ...] | None = _option(None, VALUES, "list labels",
        Kind("all, or some labels such as 1,2,3", _labels),
        "Mesh all labels of a label image but 0, or the listed labels, with shared walls: as parts "
        "of a .glb or .3mf, else as a file for each label, NAME-N.ply.", "all|N,N")
    level: float | None = _option(None, VALUES, "read list", ANY,
        "Mesh the surface at the value L of densities; above L is inside, unless --inside is "
        "negative.", "L")
    scale: float | None = _option(None, VALUES, "read list", ABOVE_0,
        "World units per unit of the values, if values and spacing have different units.", "S")
    unknown: float | None = _option(None, VALUES, "read list", ANY,
        "Take samples with the value V as unknown, like NaN.", "V")
    offset: float = _option(0.0, MESH, "list", number("a finite number, in world units"),
        "Mesh the offset surface at distance D, in world units; a positive D grows the solid.", "D")
    cap: bool = _option(True, MESH, "list", FLAG,
        "Close the surface along the border of the grid (default), or leave the surface open. A "
        "surface that ends at unknown samples needs --open.", off="open")
    mesher: MesherName = _option("auto", MESH, "list", one_of(MesherName),
        "marching is marching cubes, which cuts off edges; sharp puts vertices on edges and "
        "corners; auto is sharp for distances, marching for masks and noise.")
    simplify: float | None = _option(None, MESH, "list labels",
        number("a number greater than 0, in voxels (--tolerance takes world units)", above=0),
        "Simplify the mesh to within ERROR voxels, such as 0.02, of the unsimplified mesh. Needs "
        "the extra simplify.", "ERROR")
    tolerance: float | None = _option(None, MESH, "list labels",
        number("a number greater than 0, in world units", above=0),
        "Simplify as with --simplify, but to within D in world units.", "D")
    triangles: int | None = _option(None, MESH, "list",
        number("a whole number, 4 or more, as a closed mesh has", above=3, step=1),
        "Simplify the mesh to at most N triangles, instead of --simplify.", "N")
    keep_volume: bool = _option(False, MESH, "list labels", FLAG,
        "For masks and labels: move each surface, by an eighth of a voxel at most, until the mesh "
        "has the volume of the voxels inside.")
    unit: Unit | None = _option(None, MESH, "list labels", one_of(Unit),
        "Unit of the world coordinates, stated in .3mf (default: that of IN, else mm) and .glb "
        "(default: metres). Coordinates stay as they are.")
    quality: Quality | None = _option(None, WORK, "labels", one_of(Quality),
        "Network: fast is quicker than base, the default; best averages base over 4 rotations of "
        "the grid, and takes 4 times as long.")
    model: str | None = _option(None, WORK, "labels",
        PATH._replace(make=lambda value: str(Path(value))),
        "Use the network in this ONNX file instead of --quality.", "FILE")
    precision: Precision = _option("auto", WORK, "labels", one_of(Precision),
        "Arithmetic of the network: auto is int8, twice as fast, on the CPU for networks that have "
        "int8 weights, else float32.")
    device: Device = _option("auto", WORK, "labels", one_of(Device),
        "Where the network runs; auto uses CUDA if it works here, else the CPU.")
    threads: int = _option(0, WORK, "labels",
        number("1 or more, or 0 for one per core", above=-1, step=1),
        "CPU threads; 0 means one per core.", "N")
    max_memory: int | None = _option(None, WORK, "labels",
        Kind("a number of bytes greater than 0, such as 1500M or 4G", _bytes),
        "Memory limit of the process, such as 4G. Default: 60 % of the free memory. Larger grids "
        "are refined in tiles, whose meshes are joined.", "SIZE")
    # fmt: on

    def __post_init__(self) -> None:
        """Check the values; OptionError names the first that is wrong, or contradicts another."""
        for name, row in OPTIONS.items():
            object.__setattr__(self, name, row.check(getattr(self, name)))
        for names in EXCLUSIVE:
            given = [name for name in names if getattr(self, name) is not None]
            some = [f"{flag(name)} {seen(getattr(self, name))}" for name in given]
            if len(some) > 1:
                raise OptionError(f"{some[0]} and {some[1]}: give only one of them")
        if self.label is not None and self.field not in ("auto", "mask"):
            said = f"--label {self.label} and --field {self.field}"
            raise OptionError(f"{said}: the samples of a label are a mask")

    def reading(self) -> dict[str, Any]:
        """Return the keywords of ``read_grid``."""
        return {name: getattr(self, name) for name in (*READ, "max_memory")}

    def mesher_for(self, *, exact: bool) -> MesherName:
        """Return the mesher; by itself ``sharp`` if samples are exact: else it finds no edges."""
        automatic: MesherName = "sharp" if exact else "marching"
        return automatic if self.mesher == "auto" else self.mesher

    def factor_for(self, *, mask: bool) -> int:
        """Return the factor: masks show no details for which 2 is too few."""
        return self.factor or (2 if mask else 4)

    def unit_for(self, target: Path, notes: Iterable[str]) -> str | None:
        """Return the unit of a mesh file: of a .3mf by default that of the grid, as notes state."""
        found = None if self.spacing else STATED.search("; ".join(notes))
        unit = found.lastgroup if found else self.unit
        if self.unit not in (None, unit):
            raise OptionError(f"--unit {self.unit}: the file states {unit}, leave it out")
        return unit if target.suffix.lower() == ".3mf" else self.unit

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


OPTIONS: dict[str, Option] = {
    each.name: each.metadata["row"]._replace(name=each.name, default=each.default)
    for each in fields(Options)
}
READ, BATCH_LISTS, LABELS = (
    tuple(name for name, row in OPTIONS.items() if where in row.shows)
    for where in ("read", "list", "labels")
)
