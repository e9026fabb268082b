"""Options of commands, made from the table of options, and what several commands do with them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from ..errors import OptionError
from ..machine.extras import check_modules
from ..options import OPTIONS, UPSAMPLE, ConvertOptions, Option, parse_labels

if TYPE_CHECKING:
    from ..network.network import Network

CHECK_MODULES = ("igl",)  # of the extra report, for certificates

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]
"""Adds options to a command."""


class Parsed(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.2
    """A value that a function makes of text; its ValueError says what to give instead."""

    name = "text"

    def __init__(self, parse: Callable[[str], Any]) -> None:
        self.parse = parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the value of text."""
        try:
            return self.parse(value)
        except ValueError as error:
            self.fail(f"{value!r}: {error}", param, ctx)


def table_options(*names: str) -> Decorator:
    """Return what adds options of the table to a command, in this order."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for name in reversed(names):
            command = _from_table(OPTIONS[name])(command)
        return command

    return add


def _from_table(option: Option) -> Decorator:
    """Return an option of a command; flags are off by their opposite."""
    word = f"--{option.name.replace('_', '-')}"
    if option.off:
        return click.option(f"{word}/--{option.off}", default=option.default, help=option.help)
    kind: Any = option.parse
    if option.choices:
        kind = click.Choice(option.choices)
    elif kind is int and option.default == 0:  # as many as there are
        kind = click.IntRange(0)
    elif kind not in (int, float, str):
        kind = Parsed(kind)
    return click.option(
        word,
        type=kind,
        default=option.default,
        show_default=option.default is not None,
        metavar=option.metavar,
        help=option.help,
    )


conversion_options = table_options(*UPSAMPLE)
check_option = click.option(
    "--check",
    is_flag=True,
    help="Check each mesh against its samples, as check does. Needs the extra report.",
)
labels_option = click.option(
    "--labels",
    type=Parsed(parse_labels),
    metavar="all|N,N",
    help="Mesh all labels of a label image but 0, or those listed, each with a closed mesh; "
    "neighbours share their walls. OUT.glb and OUT.3mf hold all as parts; for OUT.ply and others "
    "each label N has its own file, OUT-N.ply.",
)
cluster_option = click.option(
    "--cluster",
    metavar="ADDRESS",
    help="Convert on the workers of the Dask scheduler at ADDRESS, such as tcp://10.0.0.1:8786, or "
    "with 'local' on Dask workers of this machine. --max-memory is then the limit of each worker "
    "at an ADDRESS. Needs the extra cluster.",
)


def check_can_check() -> None:
    """Raise FileError if the library for ``--check`` is missing."""
    check_modules("--check", "report", CHECK_MODULES)


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


def chosen_model(options: dict[str, Any]) -> str:
    """Return the value of ``--model`` or ``--quality``; OptionError if both were given."""
    if options["model"] is None:
        return str(options["quality"])
    given = click.get_current_context().get_parameter_source("quality")
    if given is not ParameterSource.DEFAULT:
        raise OptionError(
            f"--model {options['model']} replaces --quality {options['quality']}: give only one "
            "of them"
        )
    return str(options["model"])


def load_chosen(options: dict[str, Any]) -> Network:
    """Load the network that the options of a command choose."""
    from ..network.network import load_network

    chosen = {name: options[name] for name in ("device", "threads", "precision")}
    return load_network(chosen_model(options), **chosen)


def start_loading(options: dict[str, Any]) -> Future[Network]:
    """Load the network that the options choose in a thread, while other modules are imported."""
    from ..network.network import load_network

    chosen = {name: options[name] for name in ("device", "threads", "precision")}
    return ThreadPoolExecutor(1).submit(load_network, chosen_model(options), **chosen)


def make_options(options: dict[str, Any]) -> ConvertOptions:
    """Return the conversion's options, picked from all options of a command."""
    taken = [name for name in UPSAMPLE if hasattr(ConvertOptions, name)]
    chosen = ConvertOptions(**{name: options[name] for name in taken})
    if chosen.simplifies:
        word = "--simplify" if chosen.triangles is None else "--triangles"
        check_modules(word, "simplify")
    return chosen
