"""What commands share: options from the table, one-line errors, output to stdout and stderr."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import click

from ..errors import OptionError, SuperSdfError, check_modules
from ..options import EXCLUSIVE, GRID, MESH, OPTIONS, VALUES, WORK, Option, Options, check_one

CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100}
PIPE_CLOSED = 141  # exit code of programs whose reader has ended: 128 and SIGPIPE
OUTPUT = "Output"
FILE = click.Path(path_type=Path)

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]
"""Adds options to a command."""


class Command(click.Command):
    """A command whose help lists many options under headings, and whose errors are one line."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, each under its heading."""
        rows: dict[str, list[Any]] = {name: [] for name in (GRID, VALUES, MESH, WORK, OUTPUT)}
        for option in self.get_params(ctx):
            if record := option.get_help_record(ctx):
                rows[getattr(option, "group", OUTPUT)].append(record)
        headings = [heading for heading, some in rows.items() if some]
        for heading in headings:
            with formatter.section(heading if len(headings) > 1 else "Options"):
                formatter.write_dl(rows[heading])

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; turn errors into click's, one line each."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            raise click.ClickException("interrupted") from error
        except OptionError as error:
            raise click.UsageError(str(error)) from error
        except SuperSdfError as error:
            raise click.ClickException(" ".join(str(error).splitlines())) from error
        except MemoryError:
            raise click.ClickException("out of memory: use a smaller --factor or grid") from None
        except OSError as error:  # the system refused something, such as another file handle
            named = f"{error.filename}: " if error.filename else ""
            raise click.ClickException(f"{named}{error.strerror or error}") from error


def make_command(
    short: str, examples: str, *takes: Decorator, text: str | None = None
) -> Decorator:
    """Return what makes a command of a function, with its arguments and options in this order."""

    def make(function: Callable[..., Any]) -> Command:
        for take in reversed(takes):
            function = take(function)
        told = {"epilog": examples, "short_help": short, "help": text}
        return click.command(None, Command, context_settings=CONTEXT, **told)(function)

    return make


class GroupedOption(click.Option):
    """An option with the heading under which help lists it."""

    def __init__(self, *names: Any, group: str = OUTPUT, **more: Any) -> None:
        super().__init__(*names, **more)
        self.group = group


class Parsed(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.2
    """What the kind of an option makes of text."""

    name = "text"

    def __init__(self, row: Option, word: str) -> None:
        self.row, self.word = row, word

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the value of text."""
        try:
            parsed = self.row.kind.parse(value) if isinstance(value, str) else value
            return self.row.check(parsed, self.word)
        except OptionError as error:
            raise click.UsageError(str(error)) from error
        except ValueError as error:
            raise click.UsageError(f"{self.word} is {value!r}: {error}") from error


def option(*names: str, **more: Any) -> Decorator:
    """Return what adds an option that is not in the table to a command."""
    return click.option(*names, cls=GroupedOption, **more)


def table_options(*names: str, **helps: str) -> Decorator:
    """Return what adds options of the table to a command, in this order; some with another help."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for name in reversed(names):
            row, word = OPTIONS[name], f"--{name.replace('_', '-')}"
            more: dict[str, Any] = {"is_flag": True}
            if not isinstance(row.default, bool):
                kind: Any = (
                    click.Choice(row.kind.choices) if row.kind.choices else Parsed(row, word)
                )
                shown = row.default is not None
                more = {"type": kind, "metavar": row.metavar, "show_default": shown}
            word, text = f"{word}/--{row.off}" if row.off else word, helps.get(name, row.help)
            command = option(word, default=row.default, help=text, group=row.group, **more)(command)
        return command

    return add


# fmt: off
SHARED = {
    "names": option("--names", type=FILE, metavar="TABLE", group=VALUES,
        help="With --labels: names and colours of the labels, from a table of 3D Slicer, ITK-SNAP "
        "or FreeSurfer, CSV, or JSON such as nnU-Net's dataset.json. --labels takes names then."),
    "cluster": option("--cluster", metavar="ADDRESS", group=WORK,
        help="Convert on the workers of the Dask scheduler at ADDRESS, such as "
        "tcp://10.0.0.1:8786, or with 'local' on Dask workers of this machine. --max-memory is "
        "then the limit of each worker at an ADDRESS. Needs the extra cluster."),
    "jobs": option("--jobs", type=click.IntRange(0), default=0, metavar="N", group=WORK,
        help="Worker processes of a batch, or of --cluster local; 0 means one per core, or a "
        "single one on CUDA. They share the cores unless --threads is given."),
    "check": option("--check", is_flag=True,
        help="Check each mesh against its samples, as check does. Needs the extra report."),
    "report": option("--report", type=FILE, metavar="PAGE.html",
        help="Also write a page for the browser: figures, times, warnings, the check of each mesh, "
        "and a 3-D view of it beside coarse marching cubes. The check needs the extra report."),
    "force": option("--force", is_flag=True, help="Replace output files that exist."),
    "json": option("--json", "as_json", is_flag=True, help="Print results as JSON."),
    "quiet": option("-q", "--quiet", is_flag=True, help="Print errors only."),
}
# fmt: on
"""Options of several commands that are not about a conversion."""


def shared(*names: str) -> Decorator:
    """Return what adds shared options to a command, in this order."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for name in reversed(names):
            command = SHARED[name](command)
        return command

    return add


def chosen_options(given: dict[str, Any]) -> Options:
    """Return the options of a conversion, from all options of a command that may go with them."""
    for names in EXCLUSIVE:
        check_one({f"--{name}": given.get(name) for name in names})
    chosen = Options(**{name: value for name, value in given.items() if name in OPTIONS})
    for name in chosen.goals():
        check_modules(f"--{name}", "simplify")
    if given.get("check"):
        check_modules("--check", "report", ("igl",))
    if (address := given.get("cluster")) is not None:
        if not address.strip():
            raise OptionError("--cluster is empty: give local or the address of a Dask scheduler")
        if given["jobs"] and address != "local":
            raise OptionError(f"--jobs {given['jobs']} and --cluster {address}: leave --jobs out")
        check_modules("--cluster", "cluster")
    return chosen


def check_page(word: str, page: Path, others: Iterable[str | Path], *, force: bool) -> None:
    """Raise if a page cannot be written, or is one of the others, the inputs and outputs."""
    from ..files.output import check_apart, check_free

    if page.suffix.lower() not in (".html", ".htm"):
        raise OptionError(f"{page} is not a page: give {word} a file .html or .htm")
    check_free(page, force=force)
    check_apart(page, others)


@contextmanager
def progress_bar(label: str, quiet: bool) -> Iterator[Callable[[int, int], None] | None]:
    """Draw a progress bar with the remaining time on stderr; None if stderr is no terminal."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    with click.progressbar(length=1000, label=label, file=sys.stderr) as shown:
        yield lambda done, total: shown.update(1000 * done // total - shown.pos)


def print_stderr(line: str) -> None:
    """Print a line to stderr, if that can be written; line breaks of file names become spaces."""
    try:
        click.echo(line.replace("\n", " "), err=True)
    except OSError:
        _discard(2)


def print_stdout(text: str, kept: str = "") -> None:
    """Print the result that the user asked for; ``kept`` says which output exists if that fails.

    A reader that has seen enough, such as ``head``, is no error.
    """
    try:
        click.echo(text)
    except OSError as error:
        _discard(1)
        if isinstance(error, BrokenPipeError):
            raise click.exceptions.Exit(PIPE_CLOSED) from None
        said = f"stdout cannot be written: {error.strerror or error}"
        raise click.ClickException(f"{said}; {kept}" if kept else said) from error


def _discard(number: int) -> None:
    """Let what a stream still holds go nowhere: Python would complain about it at its end."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), number)
