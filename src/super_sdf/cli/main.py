"""The group of commands, what commands share, and how a command ends.

Options come from the table in ``options``; an error is one line on stderr and an exit code.
"""

from __future__ import annotations

import io
import json
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any

import click

from .. import __version__
from ..errors import OptionError, SuperSdfError, check_modules, flag, in_a_line
from ..options import GRID, MESH, OPTIONS, VALUES, WORK, Options

COMMANDS = ("upsample", "batch", "check", "sample", "view", "info")
SIGNALS = [getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)]
CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100}
PIPE_CLOSED = 141  # exit code of programs whose reader has ended: 128 and SIGPIPE
OUTPUT = "Output"
FILE = click.Path(path_type=Path)

Paths = Iterable[str | Path]
Decorator = Callable[[Any], Any]
"""Adds options to a command."""


class Commands(click.Group):
    """The commands, each in a module of its name that is imported when it is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands, in the order of the help."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command; for a name that is none, name the nearest."""
        if cmd_name in COMMANDS:
            found: click.Command = import_module(f"..{cmd_name}", __name__).command
            return found
        from difflib import get_close_matches  # imported here, as few need it

        near = get_close_matches(cmd_name, COMMANDS, 1)
        way_out = f"did you mean {near[0]}?" if near else f"give one of {', '.join(COMMANDS)}"
        ctx.fail(f"there is no command {cmd_name!r}: {way_out}")


@click.group(cls=Commands, context_settings=CONTEXT, invoke_without_command=True)
@click.version_option(__version__, prog_name="super-sdf")
@click.pass_context
def cli(context: click.Context) -> None:
    """Turn coarse signed distance grids into fine meshes."""
    if context.invoked_subcommand is None:
        print_stdout(context.get_help())


class Command(click.Command):
    """A command whose help lists options under headings."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, each under its heading."""
        rows: dict[str, list[Any]] = {name: [] for name in (GRID, VALUES, MESH, WORK, OUTPUT)}
        for param in self.get_params(ctx):
            if isinstance(param, click.Option) and (record := param.get_help_record(ctx)):
                rows[getattr(param, "group", OUTPUT)].append(record)
        headings = [heading for heading, some in rows.items() if some]
        for heading in headings:
            with formatter.section(heading if len(headings) > 1 else "Options"):
                formatter.write_dl(rows[heading])


class GroupedOption(click.Option):
    """An option with the heading under which help lists it."""

    def __init__(self, *names: Any, group: str = OUTPUT, **more: Any) -> None:
        super().__init__(*names, **more)
        self.group = group


def make_command(short: str, text: str, *takes: Decorator) -> Decorator:
    """Return what makes a command of a function; examples in its text go below the options."""
    text, _, examples = text.partition("\b")

    def make(function: Callable[..., Any]) -> Command:
        for take in reversed(takes):
            function = take(function)
        told = {"help": text, "epilog": f"\b{examples}", "short_help": short}
        return click.command(None, Command, context_settings=CONTEXT, **told)(function)

    return make


def option(*names: str, **more: Any) -> Decorator:
    """Return what adds an option that is not in the table to a command."""
    return click.option(*names, cls=GroupedOption, **more)


def table_option(name: str, text: str = "") -> Decorator:
    """Return what adds an option of the table to a command, maybe with another help text."""
    row, word = OPTIONS[name], flag(name)
    more: dict[str, Any] = {"help": text or row.help, "group": row.group, "default": row.default}
    if isinstance(row.default, bool):
        return option(f"{word}/--{row.off}" if row.off else word, is_flag=True, **more)
    choices = f"[{'|'.join(row.kind.choices)}]" if row.kind.choices else None
    more |= {"show_default": row.default is not None, "metavar": row.metavar or choices}
    return option(word, type=click.UNPROCESSED, **more)


# fmt: off
SHARED = {
    "names": option("--names", type=FILE, metavar="TABLE", group=VALUES,
        help="With --labels: names and colours of the labels, from a table of 3D Slicer, ITK-SNAP "
        "or FreeSurfer, CSV, or JSON such as nnU-Net's. --label and --labels take names then."),
    "cluster": option("--cluster", metavar="ADDRESS", group=WORK,
        help="Convert on the workers of the Dask scheduler at ADDRESS, each within --max-memory, "
        "or with 'local' on Dask workers of this machine. Needs the extra cluster."),
    "jobs": option("--jobs", type=click.IntRange(0), default=0, metavar="N", group=WORK,
        help="Worker processes of a batch, or of --cluster local; 0 means one per core, or a "
        "single one on CUDA."),
    "check": option("--check", is_flag=True,
        help="Check each mesh against its samples, as check does. Needs the extra report."),
    "report": option("--report", type=FILE, metavar="PAGE.html",
        help="Also write a page for the browser, with figures, warnings, a check and a 3-D view of "
        "each mesh. The check needs the extra report."),
    "force": option("--force", is_flag=True, help="Replace output files that exist."),
    "json": option("--json", "as_json", is_flag=True, help="Print results as JSON."),
    "quiet": option("-q", "--quiet", is_flag=True, help="Print errors only."),
}
# fmt: on
"""Options of several commands that are not about a conversion."""


def chosen_options(given: dict[str, Any]) -> Options:
    """Return the options of a conversion, from all options of a command that may go with them."""
    if given.get("names") and given["label"] is not None:
        from ..labels.files import read_names

        numbers = {entry.name: number for number, entry in read_names(given["names"]).items()}
        given = {**given, "label": numbers.get(given["label"], given["label"])}
    chosen = Options(**{name: value for name, value in given.items() if name in OPTIONS})
    for name in chosen.goals():
        check_modules(flag(name), "simplify")
    if given.get("check"):
        check_modules("--check", "report", ("igl",))
    if (address := given.get("cluster")) is not None:
        if not address.strip():
            raise OptionError("--cluster is empty: give local or the address of a Dask scheduler")
        if given["jobs"] and address != "local":
            raise OptionError(f"--jobs {given['jobs']} and --cluster {address}: leave --jobs out")
        if given.get("save_field"):
            raise OptionError("--save-field needs the field in one place: leave out --cluster")
        check_modules("--cluster", "cluster")
    return chosen


def check_names(given: dict[str, Any], labels: Any) -> None:
    """Raise OptionError if there are names, and no labels are meshed, nor one by its name."""
    if given["names"] and not labels and given["label"] is None:
        raise OptionError(f"--names {given['names']} is for --labels: give that, too")


def check_page(word: str, page: Path, sources: Paths, others: Paths, *, force: bool) -> None:
    """Raise if a page cannot be written, is a file that a source is read from, or an output."""
    from ..files.formats import files_of
    from ..files.output import check_apart, check_free

    if page.suffix.lower() not in (".html", ".htm"):
        raise OptionError(f"{page} is not a page: give {word} a file .html or .htm")
    check_free(page, force=force)
    check_apart(page, [*(file for source in sources for file in files_of(source)), *others])


@contextmanager
def progress_bar(
    label: str, quiet: bool, before: str = ""
) -> Iterator[Callable[[int, int], None] | None]:
    """Draw a progress bar on a terminal's stderr, labelled ``before`` until there is progress."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    with click.progressbar(length=1000, label=before or label, file=sys.stderr) as shown:

        def show(done: int, total: int) -> None:
            shown.label = label
            shown.update(1000 * done // total - shown.pos)

        yield show


def print_stderr(*lines: str) -> None:
    """Print lines to stderr, if that can be written; line breaks of file names become spaces."""
    try:
        for line in lines:
            click.echo(line.replace("\n", " "), err=True)
    except OSError:
        _discard(2)


def print_stdout(text: str | dict[str, Any], kept: str = "") -> None:
    """Print a result, a dictionary as JSON; ``kept`` says which output exists if that fails.

    A reader that has seen enough, such as ``head``, is no error.
    """
    try:
        click.echo(text if isinstance(text, str) else json.dumps(text, indent=2))
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


def main() -> None:
    """Run the command line and exit with its exit code, 128 + n after signal n.

    A signal raises KeyboardInterrupt, so that files that were begun are removed; one that the
    parent process ignores, as ``nohup`` does, stays ignored. Every error is one line on stderr.
    """
    # NumPy's BLAS has only small matrices to multiply, and its idle threads would keep cores busy.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    heard: list[int] = []

    def hear(number: int, frame: FrameType | None) -> None:
        heard.append(number)
        raise KeyboardInterrupt

    before = {number: signal.getsignal(number) for number in SIGNALS}
    for number in SIGNALS:
        if before[number] not in (signal.SIG_IGN, None):
            signal.signal(number, hear)
    for number in range(3):  # a standard stream that is closed; else the next file gets its text
        with suppress(OSError):
            os.fstat(number)
            continue
        os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    sys.stdout, sys.stderr = sys.stdout or io.StringIO(), sys.stderr or io.StringIO()
    try:
        code = cli.main(standalone_mode=False)  # a number if a command ended early
    except (Exception, KeyboardInterrupt) as error:
        line, code = _fault(error, heard)
        if "--json" in sys.argv[1:]:
            with suppress(click.ClickException, click.exceptions.Exit):
                print_stdout({"error": line})
        print_stderr(f"Error: {line}")
    finally:
        for number in SIGNALS:
            signal.signal(number, before[number])
    if isinstance(code, int) and code:
        sys.exit(code)


def _fault(error: BaseException, heard: list[int]) -> tuple[str, int]:
    """Return the line and the exit code for an error, 2 for wrong usage; raise a bug again."""
    if heard:  # also what a library has made of the interrupt
        name = signal.Signals(heard[0]).name
        said = "interrupted" if name == "SIGINT" else f"ended by {name}"
        cause = error.__cause__ or error  # a command may say what it has kept
        kept = cause.args if isinstance(cause, KeyboardInterrupt) else ()
        return f"{said}: {kept[0]}" if kept else said, 128 + heard[0]
    if isinstance(error, click.ClickException):
        return error.format_message(), error.exit_code
    if isinstance(error, (SuperSdfError, MemoryError)):
        return in_a_line(error), 1 + isinstance(error, OptionError)
    if isinstance(error, OSError):  # the system refused something, such as a file handle
        named = f"{error.filename}: " if error.filename else ""
        return f"{named}{error.strerror or error}", 1
    raise error
