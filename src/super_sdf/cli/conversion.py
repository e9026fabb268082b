"""The options that ``upsample`` and ``batch`` share, some of them with ``check``."""

from __future__ import annotations

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
    first,
    meshers,
    precisions,
    qualities,
    signs_inside,
)

if TYPE_CHECKING:
    from ..convert import ConvertOptions


CHECK_MODULES = ("igl", "scipy")  # of the extra eval, for certificates

Option = Callable[[Callable[..., Any]], Callable[..., Any]]
"""Adds an option to a command."""


def parse_numbers(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | None:
    """Parse one number or three separated by commas: "0.5" or "0.5,0.5,0.5"."""
    if value is None:
        return None
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (1, 3):
        raise click.BadParameter(f"{value!r}: give one number, or three separated by commas")
    return numbers


def parse_direction(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | None:
    """Parse nine numbers separated by commas."""
    if value is None:
        return None
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 9:
        raise click.BadParameter(f"{value!r}: give nine numbers separated by commas, row by row")
    return numbers


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


GRID_OPTIONS: tuple[Option, ...] = (
    click.option(
        "--spacing",
        callback=parse_numbers,
        metavar="H",
        help="World distance between neighbouring samples: one number, or X,Y,Z where it differs "
        "between axes; distances are resampled to the finest then. Default: from the file, else "
        "estimated from the values.",
    ),
    click.option(
        "--origin",
        callback=parse_numbers,
        metavar="X,Y,Z",
        help="World position of sample (0, 0, 0). Default: from the file, else 0,0,0.",
    ),
    click.option(
        "--direction",
        callback=parse_direction,
        metavar="MATRIX",
        help="World directions of the axes x, y and z of the array: the columns of a rotation or "
        "mirrored rotation, as nine numbers with commas, row by row. Files of other formats than "
        "NumPy, TIFF, HDF5 and Zarr state it.",
    ),
    click.option(
        "--axes",
        type=LazyChoice(axis_orders),
        help="Axis order of the array in a NumPy, TIFF, HDF5 or Zarr file. Default: xyz for NumPy, "
        "zyx for the others. Files of other formats state it.",
    ),
    click.option(
        "--inside",
        type=LazyChoice(signs_inside),
        default=convert_default("inside"),
        show_default=True,
        help="Sign of the values inside the solid; auto takes the border of the grid as outside.",
    ),
    click.option(
        "--field",
        type=LazyChoice(fields),
        default=convert_default("field"),
        show_default=True,
        help="What the values are: exact distances, truncated near the surface, a mask (inside or "
        "outside, or its distance transform), scaled (a field of another slope than 1), or noisy "
        "distances; auto goes by what the samples show.",
    ),
    click.option(
        "--label",
        type=float,
        metavar="N",
        help="Mesh the samples with the value N of a label image.",
    ),
    click.option(
        "--level",
        type=float,
        metavar="L",
        help="Mesh the surface at the value L of densities; what is above L is inside, unless "
        "--inside is negative.",
    ),
    click.option(
        "--scale",
        type=float,
        metavar="S",
        help="World units per unit of the values, if they have another unit than the spacing.",
    ),
)

OPTIONS: tuple[Option, ...] = (
    click.option(
        "--factor",
        type=int,
        default=convert_default("factor"),
        show_default=True,
        help="Refinement per axis: 2, 4, 8 or 16 times finer than the grid.",
    ),
    click.option(
        "--iterations",
        type=int,
        default=convert_default("iterations"),
        show_default=True,
        metavar="N",
        help="Refine N times, each time by the factor and from the refined field before, for "
        "lattices finer than factor 16. Twice factor 4 is no better than factor 16, and slower.",
    ),
    *GRID_OPTIONS,
    click.option(
        "--offset",
        type=float,
        default=convert_default("offset"),
        show_default=True,
        metavar="D",
        help="Mesh the offset surface at distance D, in world units; a positive D grows the "
        "solid, whichever sign is inside.",
    ),
    click.option(
        "--cap/--open",
        default=convert_default("cap"),
        help="Where the solid runs out of the grid, close the surface along the border, which is "
        "the default, or leave it open.",
    ),
    click.option(
        "--mesher",
        type=LazyChoice(meshers),
        default=convert_default("mesher"),
        show_default=True,
        help="Mesher: marching is marching cubes, which cuts off edges and corners; sharp also "
        "puts vertices on them and takes longer.",
    ),
    click.option(
        "--quality",
        type=LazyChoice(qualities),
        default=LazyDefault(default_quality),
        show_default=True,
        help="Network: fast is smaller and quicker; best averages base over 8 reflections and "
        "takes 8 times as long.",
    ),
    click.option(
        "--precision",
        type=LazyChoice(precisions),
        default=first(precisions),
        show_default=True,
        help="Arithmetic of the network: int8 is quicker on the CPU and slightly less accurate.",
    ),
    click.option(
        "--model", metavar="FILE", help="Use the network in this ONNX file instead of --quality."
    ),
    device_option,
    click.option(
        "--max-memory",
        callback=parse_size,
        metavar="SIZE",
        help="Memory limit of the process, such as 1500M or 4G. Default: 60 % of the free memory. "
        "Larger grids are refined slab by slab, to the same mesh.",
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
    click.option(
        "--simplify",
        type=float,
        metavar="ERROR",
        help="Simplify the mesh as far as it stays within ERROR of the unsimplified one, in voxels "
        "of the grid (such as 0.02), measured both ways. A closed mesh stays closed. Needs the "
        "extra simplify.",
    ),
    click.option(
        "--triangles",
        type=int,
        metavar="N",
        help="Simplify the mesh to at most N triangles, instead of --simplify. If the shape needs "
        "more, a warning says how many are left.",
    ),
)

check_option = click.option(
    "--check",
    is_flag=True,
    help="Check each mesh against its samples, as check does. Needs the extra eval.",
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
