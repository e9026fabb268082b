"""Choices and defaults that belong to the library, looked up when an option needs them.

The modules that own them import NumPy or onnxruntime; ``super-sdf --help`` needs neither.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import click

from .common import one_line_errors

if TYPE_CHECKING:
    Choice = click.Choice[str]
else:
    Choice = click.Choice  # generic since click 8.2 only


class LazyChoice(Choice):
    """A choice whose values are loaded when a value is checked or its help is shown."""

    def __init__(self, load: Callable[[], Iterable[str]]) -> None:
        self.load = load
        self.case_sensitive = True

    @cached_property
    def choices(self) -> tuple[str, ...]:  # type: ignore[override]
        """All values, in the order of the help."""
        with one_line_errors():  # onnxruntime may be broken
            return tuple(self.load())


@dataclass(frozen=True)
class LazyDefault:
    """A default that is loaded when it is used (click calls it) or shown in the help."""

    load: Callable[[], Any]

    def __call__(self) -> Any:
        """Return the default."""
        with one_line_errors():
            return self.load()

    def __str__(self) -> str:
        return str(self())


def convert_default(name: str) -> LazyDefault:
    """Return the default of a field of ``ConvertOptions``."""

    def load() -> Any:
        from ..convert import ConvertOptions

        return getattr(ConvertOptions, name)

    return LazyDefault(load)


def devices() -> tuple[str, ...]:
    """Return the names of the devices; the first is the default."""
    from ..network.names import DEVICES

    return DEVICES


def precisions() -> tuple[str, ...]:
    """Return the precisions of a network; the first is the default."""
    from ..network.names import PRECISIONS

    return PRECISIONS


def qualities() -> tuple[str, ...]:
    """Return the names of the shipped networks, the fastest first."""
    from ..network.names import QUALITIES

    return tuple(QUALITIES)


def default_quality() -> str:
    """Return the shipped network that is used unless another is chosen."""
    from ..network.names import DEFAULT_QUALITY

    return DEFAULT_QUALITY


def axis_orders() -> tuple[str, ...]:
    """Return the axis orders of an array in a file."""
    from ..files.formats import AXES

    return AXES


def signs_inside() -> tuple[str, ...]:
    """Return the values of ``inside``: which sign the samples inside the solid have."""
    from ..grid.field import INSIDE

    return INSIDE


def fields() -> tuple[str, ...]:
    """Return what the values of a grid can be; the first is the default."""
    from ..grid.field import FIELDS

    return FIELDS


def meshers() -> tuple[str, ...]:
    """Return the names of the meshers."""
    from ..steps.mesher_names import MESHERS

    return MESHERS


def mesh_formats() -> tuple[str, ...]:
    """Return the mesh file formats, by suffix without its dot."""
    from ..files.meshes import MESH_SUFFIXES

    return tuple(suffix.removeprefix(".") for suffix in MESH_SUFFIXES)


def first(load: Callable[[], tuple[str, ...]]) -> LazyDefault:
    """Return the first of some choices as a default."""
    return LazyDefault(lambda: load()[0])


device_option = click.option(
    "--device",
    type=LazyChoice(devices),
    default=first(devices),
    show_default=True,
    help="Where the network runs; auto uses CUDA if it works here, else the CPU.",
)

precision_option = click.option(
    "--precision",
    type=LazyChoice(precisions),
    default=first(precisions),
    show_default=True,
    help="Arithmetic of the network: auto is int8 on the CPU if the network has it, otherwise "
    "float32. On the CPU int8 takes about half as long.",
)
