"""The options that ``upsample`` and ``batch`` share, some of them with ``check``."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from ..errors import OptionError
from ..machine.extras import check_modules
from .choices import (
    LazyChoice,
    LazyDefault,
    axis_orders,
    convert_default,
    default_quality,
    device_option,
    fields,
    meshers,
    precision_option,
    qualities,
    signs_inside,
)
from .common import one_line_errors

if TYPE_CHECKING:
    from ..convert import ConvertOptions


CHECK_MODULES = ("igl", "scipy")  # of the extra eval, for certificates

Option = Callable[[Callable[..., Any]], Callable[..., Any]]
"""Adds an option to a command."""


def _floats(value: str) -> tuple[float, ...]:
    """Return numbers separated by commas, none if one is no number."""
    try:
        return tuple(float(part) for part in value.split(","))
    except ValueError:
        return ()


def parse_numbers(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | None:
    """Parse one number or three separated by commas: "0.5" or "0.5,0.5,0.5"."""
    if value is None:
        return None
    numbers = _floats(value)
    if len(numbers) not in (1, 3):
        raise click.BadParameter(f"{value!r}: give one number, or three separated by commas")
    return numbers


def parse_direction(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | None:
    """Parse nine numbers separated by commas."""
    if value is None:
        return None
    numbers = _floats(value)
    if len(numbers) != 9:
        raise click.BadParameter(f"{value!r}: give nine numbers separated by commas, row by row")
    return numbers


def parse_label(ctx: click.Context, param: click.Parameter, value: str | None) -> int | None:
    """Parse a whole number of up to 64 bits, never as a float."""
    if value is None:
        return None
    from ..grid.field import check_label

    with one_line_errors():
        is_whole = re.fullmatch("[-+]?[0-9]{1,20}", value)
        return check_label(int(value) if is_whole else value, str(param.opts[0]))


def parse_labels(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> str | list[int] | None:
    """Parse "all", or labels separated by commas."""
    if value is None or value == "all":
        return value
    found = [parse_label(ctx, param, part.strip()) for part in value.split(",")]
    return [label for label in found if label is not None]


UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9}


def parse_size(ctx: click.Context, param: click.Parameter, value: str | None) -> int | None:
    """Parse a number of bytes, such as "1500M" or "4G"; the units are powers of ten."""
    if value is None:
        return None
    number, unit = value[:-1], value[-1:].upper()
    if unit.isdigit():
        number, unit = value, ""
    try:
        size = int(float(number) * UNITS[unit])
    except (KeyError, ValueError, OverflowError):
        size = 0
    if size <= 0:
        raise click.BadParameter(f"{value!r}: give a number of bytes such as 1500M or 4G")
    return size


def _usual(name: str, text: str, **more: Any) -> Option:
    """Return an option with the default of ``ConvertOptions``, which its help shows."""
    default = convert_default(name.removeprefix("--"))
    return click.option(name, default=default, show_default=True, help=text, **more)


def _choice(name: str, text: str, load: Callable[[], tuple[str, ...]], default: Any) -> Option:
    """Return an option with some choices and a default, which its help shows."""
    return click.option(name, type=LazyChoice(load), default=default, show_default=True, help=text)


def _number(name: str, metavar: str, text: str, kind: type = float) -> Option:
    """Return an option that is a number, and missing by default."""
    return click.option(name, type=kind, metavar=metavar, help=text)


def _parsed(name: str, metavar: str, text: str, parse: Callable[..., Any]) -> Option:
    """Return an option that a function parses, and that is missing by default."""
    return click.option(name, callback=parse, metavar=metavar, help=text)


GRID_OPTIONS: tuple[Option, ...] = (
    _parsed(
        "--spacing",
        "H",
        "World distance between neighbouring samples: one number, or X,Y,Z where it differs "
        "between axes; distances are resampled to the finest then. Default: from the file, else "
        "estimated from the values.",
        parse_numbers,
    ),
    _parsed(
        "--origin",
        "X,Y,Z",
        "World position of sample (0, 0, 0). Default: from the file, else 0,0,0.",
        parse_numbers,
    ),
    _parsed(
        "--direction",
        "MATRIX",
        "World directions of the axes x, y and z of the array: the columns of a rotation or "
        "mirrored rotation, as nine numbers with commas, row by row. Files of other formats than "
        "NumPy, TIFF, HDF5 and Zarr state it.",
        parse_direction,
    ),
    click.option(
        "--axes",
        type=LazyChoice(axis_orders),
        help="Axis order of the array in a NumPy, TIFF, HDF5 or Zarr file. Default: the names "
        "of the axes in the file, else xyz for NumPy, zyx for the others. Files of other formats "
        "state it.",
    ),
    _usual(
        "--inside",
        "Sign of the values inside the solid; auto takes the border of the grid as outside.",
        type=LazyChoice(signs_inside),
    ),
    _usual(
        "--field",
        "What the values are: exact distances, truncated near the surface, a mask (inside or "
        "outside, or its distance transform), scaled (a field of another slope than 1), or noisy "
        "distances; auto goes by what the samples show.",
        type=LazyChoice(fields),
    ),
    _parsed("--label", "N", "Mesh the samples with the value N of a label image.", parse_label),
    _number(
        "--level",
        "L",
        "Mesh the surface at the value L of densities; what is above L is inside, unless "
        "--inside is negative.",
    ),
    _number(
        "--scale",
        "S",
        "World units per unit of the values, if they have another unit than the spacing.",
    ),
)

OPTIONS: tuple[Option, ...] = (
    _usual(
        "--factor",
        "Refinement per axis: 2, 4, 8 or 16 times finer than the grid.",
        type=int,
    ),
    *GRID_OPTIONS,
    _usual(
        "--offset",
        "Mesh the offset surface at distance D, in world units; a positive D grows the "
        "solid, whichever sign is inside.",
        type=float,
        metavar="D",
    ),
    click.option(
        "--cap/--open",
        default=convert_default("cap"),
        help="Where the solid runs out of the grid, close the surface along the border, which is "
        "the default, or leave it open. A surface that ends where samples are unknown needs "
        "--open.",
    ),
    _usual(
        "--mesher",
        "Mesher: marching is marching cubes, which cuts off edges and corners; sharp also "
        "puts vertices on them and takes longer.",
        type=LazyChoice(meshers),
    ),
    _choice(
        "--quality",
        "Network: fast is smaller and quicker than base; best averages base over 4 turns of the "
        "grid, and takes 4 times as long.",
        qualities,
        LazyDefault(default_quality),
    ),
    precision_option,
    click.option(
        "--model", metavar="FILE", help="Use the network in this ONNX file instead of --quality."
    ),
    device_option,
    _parsed(
        "--max-memory",
        "SIZE",
        "Memory limit of the process, such as 1500M or 4G. Default: 60 % of the free memory. "
        "Larger grids are refined slab by slab, to the same mesh.",
        parse_size,
    ),
    click.option(
        "--threads",
        type=click.IntRange(0),
        default=0,
        show_default=True,
        help="CPU threads; 0 means one per core.",
    ),
)


SIMPLIFY_OPTIONS: tuple[Option, ...] = (
    _number(
        "--simplify",
        "ERROR",
        "Simplify the mesh as far as it stays within ERROR of the unsimplified one, in voxels "
        "of the grid (such as 0.02), measured both ways. A closed mesh stays closed. Needs the "
        "extra simplify.",
    ),
    _number(
        "--triangles",
        "N",
        "Simplify the mesh to at most N triangles, instead of --simplify. If the shape needs "
        "more, a warning says how many are left.",
        int,
    ),
)

check_option = click.option(
    "--check",
    is_flag=True,
    help="Check each mesh against its samples, as check does. Needs the extra eval.",
)


labels_option = _parsed(
    "--labels",
    "all|N,N",
    "Mesh all labels of a label image but 0, or those listed, each with a closed mesh; neighbours "
    "share their walls. OUT.glb and OUT.3mf hold all as parts; for OUT.ply and others each label N "
    "has its own file, OUT-N.ply.",
    parse_labels,
)

cluster_option = click.option(
    "--cluster",
    metavar="ADDRESS",
    help="Convert on the workers of the Dask scheduler at ADDRESS, such as tcp://10.0.0.1:8786, or "
    "with 'local' on Dask workers of this machine. --max-memory is then the limit of each worker "
    "at an ADDRESS. Needs the extra cluster.",
)


def conversion_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options to a command, in the order of ``OPTIONS`` and ``SIMPLIFY_OPTIONS``."""
    return _with_options(command, OPTIONS + SIMPLIFY_OPTIONS)


def grid_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that say how a grid is read, in the order of ``GRID_OPTIONS``."""
    return _with_options(command, GRID_OPTIONS)


def _with_options(command: Callable[..., Any], options: tuple[Option, ...]) -> Callable[..., Any]:
    for option in reversed(options):
        command = option(command)
    return command


def check_can_check(target: str) -> None:
    """Raise FileError if meshes like ``target`` cannot be read again for ``--check``."""
    check_modules("--check", "eval", CHECK_MODULES)
    if target.lower().endswith(".3mf"):
        check_modules("--check of .3mf files", "3mf")


def check_cluster(options: dict[str, Any]) -> None:
    """Raise an error if ``--cluster`` cannot be used, or not with the other options."""
    address, jobs = options["cluster"], options.get("jobs", 0)
    if address is None:
        return
    if not address.strip():
        raise OptionError("--cluster is empty: give local or the address of a Dask scheduler")
    if jobs and address != "local":
        raise OptionError(
            f"--jobs {jobs} is for workers of this machine: those at {address} are as many as "
            "were started there; give only one of --jobs and that --cluster"
        )
    check_modules("--cluster", "cluster")


def check_simplification(options: dict[str, Any]) -> None:
    """Raise an error if ``--simplify`` or ``--triangles`` has a wrong value or cannot be done."""
    from ..options import check_goal
    from ..simplification.simplify import check_can_simplify

    names = ("--simplify", "--triangles")
    values = options["simplify"], options["triangles"]
    if values == (None, None):
        return
    check_goal(*values, names)
    check_can_simplify(names[values[0] is None])


def chosen_model(options: dict[str, Any]) -> str:
    """Return the value of ``--model`` or ``--quality``.

    Raises
    ------
    OptionError
        If both were given.
    """
    if options["model"] is None:
        return str(options["quality"])
    given = click.get_current_context().get_parameter_source("quality")
    if given is not ParameterSource.DEFAULT:
        raise OptionError(
            f"--model {options['model']} replaces --quality {options['quality']}: give only one "
            "of them"
        )
    return str(options["model"])


def make_options(options: dict[str, Any]) -> ConvertOptions:
    """Return the conversion's options, picked from all options of a command."""
    import dataclasses

    from ..convert import ConvertOptions

    return ConvertOptions(
        **{field.name: options[field.name] for field in dataclasses.fields(ConvertOptions)}
    )
