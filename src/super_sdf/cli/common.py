"""What commands share: options from the table, one-line errors, output to stdout and stderr."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from ..errors import OptionError, SuperSdfError, seen
from ..machine.extras import check_modules
from ..options import MARCHING, OPTIONS, UPSAMPLE, ConvertOptions, Option
from .interrupts import describe_interrupt, exit_code

if TYPE_CHECKING:
    from ..network.network import Network

CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100}
PIPE_CLOSED = 141  # exit code of programs whose reader has ended: 128 and SIGPIPE
PAGES = (".html", ".htm")
CHECK_MODULES = ("igl",)  # of the extra report, for certificates

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]
"""Adds options to a command."""


GROUPS = {
    "The grid": ("spacing", "origin", "direction", "axes", "space"),
    "Its values": ("inside", "field", "label", "labels", "names", "level", "scale"),
    "The mesh": (
        "factor",
        "offset",
        "cap",
        "mesher",
        "simplify",
        "tolerance",
        "triangles",
        "keep_volume",
        "unit",
    ),
    "The work": (
        *("quality", "precision", "model", "device", "max_memory", "threads"),
        *("cluster", "jobs", "fail_fast", "retry", "dry_run"),
    ),
}
"""Options by what they are about; the others are about output."""


class GroupedCommand(click.Command):
    """A command with many options: its help lists them under headings."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, each under its heading."""
        rows: dict[str, list[tuple[str, str]]] = {heading: [] for heading in (*GROUPS, "Output")}
        for option in self.get_params(ctx):
            if not isinstance(option, click.Option):
                continue
            among = (heading for heading, names in GROUPS.items() if option.name in names)
            if row := option.get_help_record(ctx):
                rows[next(among, "Output")].append(row)
        for heading, some in rows.items():
            with formatter.section(heading):
                formatter.write_dl(some)


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
    if option.parse is bool:
        return click.option(word, is_flag=True, default=option.default, help=option.help)
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
labels_option = table_options("labels")
names_option = click.option(
    "--names",
    type=click.Path(path_type=Path),
    metavar="TABLE",
    help="With --labels: names and colours of the labels, from a table of 3D Slicer, ITK-SNAP or "
    "FreeSurfer, CSV, or JSON such as nnU-Net's dataset.json. --labels takes names then.",
)
cluster_option = click.option(
    "--cluster",
    metavar="ADDRESS",
    help="Convert on the workers of the Dask scheduler at ADDRESS, such as tcp://10.0.0.1:8786, or "
    "with 'local' on Dask workers of this machine. --max-memory is then the limit of each worker "
    "at an ADDRESS. Needs the extra cluster.",
)
report_option = click.option(
    "--report",
    type=click.Path(path_type=Path),
    metavar="PAGE.html",
    help="Also write a page for the browser: figures, times, warnings, the check of each mesh, and "
    "a 3-D view of it beside coarse marching cubes. Needs the extra report.",
)


class InterruptedCommand(BaseException):  # as KeyboardInterrupt, no error
    """A signal ended the command: the message names the signal and what was kept.

    ``facts`` are what ``--json`` prints of what was done.
    """

    def __init__(
        self, kept: str, interrupt: KeyboardInterrupt, facts: dict[str, Any] | None = None
    ) -> None:
        self.exit_code, self.facts = exit_code(interrupt), facts or {}
        super().__init__(f"{describe_interrupt(self.exit_code)}{kept}")


@contextmanager
def one_line_errors(*targets: str | os.PathLike[str] | None) -> Iterator[None]:
    """Turn errors into click's, one line each.

    The exit code is 2 for usage errors, 128 + n after signal n, and 1 for all others. After an
    interrupt the line says which of the targets, the output files, are written.
    """
    before = {str(target): _file_at(target) for target in targets if target is not None}
    try:
        yield
    except SuperSdfError as error:
        kind = click.UsageError if isinstance(error, OptionError) else click.ClickException
        line = " ".join(str(error).splitlines())  # names may have line breaks
        raise kind(_as_typed(line) if kind is click.UsageError else line) from error
    except MemoryError:
        raise click.ClickException("out of memory: use a smaller --factor or grid") from None
    except OSError as error:  # the system refused something, such as another file handle: no bug
        reason = error.strerror or str(error)
        named = f"{error.filename}: {reason}" if error.filename else reason
        raise click.ClickException(named) from error
    except KeyboardInterrupt as error:
        raise InterruptedCommand(_what_is_written(before), error) from None


def _as_typed(line: str) -> str:
    """Return a message with the options that it begins with as the user typed them."""
    context = click.get_current_context(silent=True)
    given = context.params if context else {}
    for option in context.command.params if context else ():
        word, value = option.opts[0], given.get(option.name or "")
        for part in (value, *value) if isinstance(value, tuple) else (value,):
            typed = part if isinstance(part, str) else repr(part).removesuffix(".0")
            name, shown = word.lstrip("-").replace("-", "_"), re.escape(seen(part))
            shown += f"|{re.escape(typed)}"
            found = re.match(rf"(.* and )?{name} (is )?(?:{shown})(?=[:,]| and )", line)
            if found and word.startswith("-"):
                head = f"{found[1] or ''}{word} {found[2] or ''}{typed}"
                line = head + line[found.end() :]
    return line


def _file_at(path: str | os.PathLike[str]) -> tuple[int, int] | None:
    """Return what tells the file at a path from one that replaces it; None without a file."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):  # ValueError: a NUL in the name
        return None
    return found.st_dev, found.st_ino


def _what_is_written(before: dict[str, tuple[int, int] | None]) -> str:
    """Return which files are not those of before, as the end of a sentence."""
    written = [path for path, file in before.items() if _file_at(path) != file]
    if not written:
        return "; nothing was written" if before else ""
    return f"; {' and '.join(written)} {'is' if len(written) == 1 else 'are'} written"


@contextmanager
def progress_bar(
    label: str, quiet: bool, then: tuple[float, str] | None = None
) -> Iterator[Callable[[int, int], None] | None]:
    """Draw a progress bar with the remaining time on stderr; None if stderr is no terminal.

    ``then`` is another label, and the share of the work from which on it is right.
    """
    if quiet or not sys.stderr.isatty():
        yield None
        return
    with click.progressbar(length=1000, label=label, file=sys.stderr) as shown:

        def show(done: int, total: int) -> None:
            if then and done >= then[0] * total:
                shown.label = then[1]
            shown.update(1000 * done // total - shown.pos)

        yield show


def print_stderr(line: str) -> None:
    """Print a line to stderr, if that can be written; line breaks of file names become spaces."""
    with suppress(OSError):
        click.echo(line.replace("\n", " "), err=True)


def print_stdout(text: str, kept: str = "") -> None:
    """Print the result that the user asked for; ``kept`` says which output exists if that fails.

    A reader that has seen enough, such as ``head``, is no error.
    """
    try:
        click.echo(text)
    except BrokenPipeError:
        raise click.exceptions.Exit(PIPE_CLOSED) from None
    except OSError as error:
        said = f"stdout cannot be written: {error.strerror or error}"
        raise click.ClickException(f"{said}; {kept}" if kept else said) from error


def check_page(option: str, page: Path, others: Iterable[str | Path], *, force: bool) -> None:
    """Raise if a page cannot be written, or is one of the others, the inputs and outputs."""
    from ..files.output import check_apart, check_free

    if page.suffix.lower() not in PAGES:
        raise OptionError(f"{page} is not a page: give {option} a file {' or '.join(PAGES)}")
    check_free(page, force=force)
    check_apart(page, others)


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


def check_names(table: Path | None, labels: Any) -> None:
    """Raise OptionError if a table of names was given, but no labels."""
    if table is not None and labels is None:
        raise OptionError(f"--names {table} is for --labels: give that, too")


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


def load_chosen(options: dict[str, Any], meanwhile: Callable[[], None] = lambda: None) -> Network:
    """Load the network that a command's options choose; import the rest, and more, meanwhile."""
    from ..network.network import load_network

    chosen = {name: options[name] for name in ("device", "threads", "precision")}
    with ThreadPoolExecutor(1) as pool:
        loading = pool.submit(load_network, chosen_model(options), **chosen)
        from .. import convert  # noqa: F401  # onnxruntime needs no interpreter while it loads
        from ..surface.cell_cases import loop_table, triangle_table

        meanwhile()
        triangle_table()  # it is kept
        if options.get("mesher") != MARCHING:
            from ..surface.sharp import features  # noqa: F401

            loop_table()
        return loading.result()


def make_options(options: dict[str, Any]) -> ConvertOptions:
    """Return the conversion's options, picked from all options of a command."""
    taken = options.keys() & ConvertOptions.__dataclass_fields__.keys()
    chosen = ConvertOptions(**{name: options[name] for name in taken})
    for name in chosen.goals():
        check_modules(f"--{name}", "simplify")
    return chosen
