"""The options that ``upsample`` and ``batch`` share: one text, one meaning."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from ..errors import OptionError

if TYPE_CHECKING:
    from ..convert import ConvertOptions


def parse_numbers(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | None:
    """Parse one number, or three with commas between: "0.5" or "0.5,0.5,0.5"."""
    if value is None:
        return None
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (1, 3):
        raise click.BadParameter(f"{value!r}: give one number, or three with commas between")
    return numbers


UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9}


def parse_size(ctx: click.Context, param: click.Parameter, value: str | None) -> int | None:
    """Parse a number of bytes: "1500M" or "4G", powers of ten."""
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


OPTIONS = (
    click.option(
        "--factor",
        type=int,
        default=4,
        show_default=True,
        help="How many times finer: 2, 4, 8 or 16.",
    ),
    click.option(
        "--spacing",
        callback=parse_numbers,
        metavar="H",
        help="World distance between samples; from the file or the values if not given.",
    ),
    click.option(
        "--origin",
        callback=parse_numbers,
        metavar="X,Y,Z",
        help="World position of sample (0, 0, 0); from the file, else 0.",
    ),
    click.option(
        "--inside",
        type=click.Choice(["negative", "positive", "auto"]),
        default="auto",
        show_default=True,
        help="The sign of values inside; auto takes the grid's border for outside.",
    ),
    click.option(
        "--offset",
        type=float,
        default=0.0,
        show_default=True,
        metavar="D",
        help="Mesh the surface at distance D, in world units: a positive one grows the solid, "
        "whichever sign is inside.",
    ),
    click.option("--cap", is_flag=True, help="Close a surface that runs out of the grid."),
    click.option(
        "--quality",
        type=click.Choice(["fast", "base", "best"]),
        default="base",
        show_default=True,
        help="The network: fast is small, best asks base eight times.",
    ),
    click.option(
        "--precision",
        type=click.Choice(["float32", "int8"]),
        default="float32",
        show_default=True,
        help="Of the network: int8 is quicker on the CPU, and a little less exact.",
    ),
    click.option(
        "--model", metavar="FILE", help="Another network, an ONNX file, in place of these."
    ),
    click.option(
        "--device",
        type=click.Choice(["auto", "cpu", "cuda"]),
        default="auto",
        show_default=True,
        help="Where the network runs; auto takes CUDA where it can.",
    ),
    click.option(
        "--max-memory",
        callback=parse_size,
        metavar="SIZE",
        help="What the process may hold, such as 1500M or 4G; 60 % of what is free if not given. "
        "Larger grids are refined slab by slab, to the same mesh.",
    ),
    click.option(
        "--threads", type=click.IntRange(0), default=0, help="CPU threads; 0: one a core."
    ),
)


def conversion_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command these options, in this order."""
    for option in reversed(OPTIONS):
        command = option(command)
    return command


def chosen_model(asked: dict[str, Any]) -> str:
    """Return the network of ``--quality`` or ``--model``; both together are an error."""
    if asked["model"] is None:
        return str(asked["quality"])
    given = click.get_current_context().get_parameter_source("quality")
    if given is not ParameterSource.DEFAULT:
        raise OptionError(
            f"--model {asked['model']} takes the place of --quality {asked['quality']}: give one "
            "of them"
        )
    return str(asked["model"])


def make_options(asked: dict[str, Any]) -> ConvertOptions:
    """Return what is asked of a conversion, out of all options of a command."""
    from dataclasses import fields

    from ..convert import ConvertOptions

    return ConvertOptions(**{field.name: asked[field.name] for field in fields(ConvertOptions)})
