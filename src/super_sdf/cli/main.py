"""The group of commands, what commands share, and how a command ends.

Options come from the table in ``options``; an error is one line on stderr and an exit code.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from string import Template
from threading import Timer
from types import FrameType
from typing import Any

import click

# NumPy's BLAS has only small matrices to multiply, and its idle threads would keep cores busy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is imported

from .. import __version__
from ..errors import OptionError, SuperSdfError, check_modules, flag, in_a_line
from ..files.formats import LISTED, NAMED, files_of
from ..files.output import check_apart, check_free
from ..options import GRID, MESH, MESH_FORMATS, OPTIONS, VALUES, WORK, Options

COMMANDS = {
    "upsample": "Refine a grid and write its surface as a mesh.",
    "batch": "Convert many grids; can be stopped and resumed.",
    "check": "Check a mesh against the grid that it was made from.",
    "sample": "Sample a closed mesh as a signed distance grid.",
    "view": "Look at meshes and grids in the browser.",
    "info": "Show what is installed, or describe a grid file.",
}
SIGNALS = [getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)]
CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100}
HEADINGS = {name: row.group for name, row in OPTIONS.items()} | {"names": VALUES}
HEADINGS |= dict.fromkeys(("cluster", "jobs", "retry", "dry_run"), WORK)
FILE, NAME = click.Path(path_type=Path), click.Path(readable=False)  # the second as it is given

Paths = Iterable[str | Path]


class Commands(click.Group):
    """Commands in modules of their names: the docstring is the help, ``TAKES`` are parameters."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands, in the order of the help."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
        """Return a command; UsageError if there is none of this name."""
        if cmd_name not in COMMANDS:
            ctx.fail(f"{cmd_name!r} is no command: give one of {', '.join(COMMANDS)}")
        module: Any = import_module(f"..{cmd_name}", __name__)
        meshes = ", ".join(f".{name}" for name in MESH_FORMATS)
        text = Template(module.__doc__ or "").substitute(grids=LISTED, several=NAMED, meshes=meshes)
        text, _, examples = text.partition("\n  super-sdf")
        return Command(
            cmd_name,
            callback=module.command,
            params=[SHARED.get(each, each) for each in module.TAKES],
            help=text,
            epilog=f"\b\nExamples:\n  super-sdf{examples}",
            short_help=COMMANDS[cmd_name],
        )


@click.group(cls=Commands, context_settings=CONTEXT, invoke_without_command=True)
@click.version_option(__version__, prog_name="super-sdf")
@click.pass_context
def cli(context: click.Context) -> None:
    """Turn coarse signed distance grids into fine meshes."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


class Command(click.Command):
    """A command whose help lists options under headings."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, each under its heading."""
        rows: dict[str, list[Any]] = {name: [] for name in (GRID, VALUES, MESH, WORK)}
        for param in self.get_params(ctx):
            if isinstance(param, click.Option) and (record := param.get_help_record(ctx)):
                rows.setdefault(HEADINGS.get(str(param.name), "Output"), []).append(record)
        headings = [heading for heading, some in rows.items() if some]
        for heading in headings:
            with formatter.section(heading if len(headings) > 1 else "Options"):
                formatter.write_dl(rows[heading])


def table_option(name: str, text: str = "") -> click.Option:
    """Return an option of the table, maybe with another help text."""
    row, word = OPTIONS[name], flag(name)
    more: dict[str, Any] = {"help": text or row.help, "default": row.default}
    if isinstance(row.default, bool):
        return click.Option([f"{word}/--{row.off}" if row.off else word], is_flag=True, **more)
    choices = f"[{'|'.join(row.kind.choices)}]" if row.kind.choices else None
    more |= {"show_default": row.default is not None, "metavar": row.metavar or choices}
    more["shell_complete"] = lambda *at: [c for c in row.kind.choices if c.startswith(at[2])]
    return click.Option([word], type=click.UNPROCESSED, **more)


SHARED: dict[Any, click.Option] = {  # options of several commands, by their names
    "names": click.Option(["--names"], type=FILE, metavar="TABLE",
        help="Names and colours of labels, from a table of 3D Slicer, ITK-SNAP or FreeSurfer, CSV, "
        "or JSON such as nnU-Net's. --label and --labels then take names, too."),
    "cluster": click.Option(["--cluster"], metavar="ADDRESS",
        help="Convert on the workers of the Dask scheduler at ADDRESS, each within --max-memory, "
        "or with 'local' on Dask workers of this machine. Needs the extra cluster."),
    "jobs": click.Option(["--jobs"], type=click.IntRange(0), default=0, metavar="N",
        help="Worker processes of a batch, or of --cluster local; 0 means one per core, or a "
        "single process on CUDA."),
    "check": click.Option(["--check"], is_flag=True,
        help="Check each mesh against its grid, like the command check. Needs the extra report."),
    "report": click.Option(["--report"], type=FILE, metavar="PAGE.html",
        help="Also write a page for the browser, with figures, warnings, a check and a 3-D view of "
        "each mesh. The check needs the extra report."),
    "force": click.Option(["--force"], is_flag=True, help="Replace output files that exist."),
    "json": click.Option(["--json", "as_json"], is_flag=True, help="Print results as JSON."),
    "quiet": click.Option(["-q", "--quiet"], is_flag=True, help="Print errors only."),
}  # fmt: skip
SHARED |= {name: table_option(name) for name in OPTIONS}


def chosen_options(given: dict[str, Any], source: str = "-") -> Options:
    """Return the options of a conversion, of all of a command; names are of a table or a source."""
    is_name = not (label := str(given.get("label") or 0)).lstrip("+-").replace(".", "").isdigit()
    if given.get("names") or (is_name and source != "-"):
        from ..labels.files import names_in, read_names

        names = given["names"] = read_names(given["names"]) if given["names"] else names_in(source)
        known = ", ".join(name for name, _ in [*names.values()][:10]) or "none without --names"
        alike = [n for n, (name, _) in names.items() if name == label]
        if len(alike) != 1 and is_name:
            some = f", or a name ({known})" * (not alike)
            raise OptionError(f"--label {label} names {len(alike)} labels: give a number{some}")
        given["label"] = alike[0] if alike else given["label"]
    chosen = Options(**{name: value for name, value in given.items() if name in OPTIONS})
    for name in chosen.goals():
        check_modules(flag(name), "simplify")
    if given.get("check"):
        check_modules("--check", "report", ("igl",))
    if given.get("cluster"):
        check_modules("--cluster", "cluster")
        if given.get("save_field"):
            raise OptionError("--save-field needs the field in one place: leave out --cluster")
    return chosen


def check_page(word: str, page: Path, sources: Paths, others: Paths, *, force: bool) -> None:
    """Raise if a page cannot be written, is a file that a source is read from, or an output."""
    if page.suffix.lower() not in (".html", ".htm"):
        raise OptionError(f"{page} is not a page: give {word} a file .html or .htm")
    check_free(page, force=force)
    check_apart(page, [*(file for source in sources for file in files_of(source)), *others])


@contextmanager
def progress_bar(label: str, quiet: bool, first: str = "") -> Iterator[Any]:
    """Draw a progress bar on a terminal's stderr; its label is ``first`` until it moves."""
    if quiet or not (sys.stderr and sys.stderr.isatty()):
        yield None
        return
    with click.progressbar(length=1000, label=first or label, file=sys.stderr) as shown:

        def show(done: int, total: int) -> None:
            shown.label = label
            shown.update(1000 * done // total - shown.pos)

        yield show


def print_stderr(*lines: str) -> None:
    """Print lines to stderr, if that can be written."""
    with suppress(OSError):
        print_stdout(*lines, err=True)


def print_stdout(*lines: str | dict[str, Any], err: bool = False) -> None:
    """Print lines, with escapes for what names may hold, such as line breaks, or JSON."""
    for line in lines:
        text = (c if c.isprintable() else ascii(c)[1:-1] for c in line)
        click.echo(json.dumps(line, indent=2) if isinstance(line, dict) else "".join(text), err=err)


def hear_signals() -> list[int]:
    """Have a signal raise KeyboardInterrupt, so that files that were begun are removed; list it.

    A signal that the parent process ignores, as ``nohup`` does, stays ignored. A signal is sent
    again if it comes during an import, or in a callback, where Python drops exceptions.
    """
    # not KeyboardInterrupt itself: after one within exec() Python ends itself by SIGINT
    heard, ended = list[int](), type("Ended", (KeyboardInterrupt,), {})

    def hear(number: int, frame: FrameType | None) -> None:
        heard.append(number)
        while frame and not frame.f_code.co_filename.startswith("<frozen importlib"):
            frame = frame.f_back
        if not frame:
            raise ended
        send_again()  # a module in C++ makes ImportError of an exception, or aborts

    def hear_again(dropped: Any) -> None:
        send_again() if dropped.exc_type is ended else sys.__unraisablehook__(dropped)

    def send_again() -> None:
        Timer(0.01, os.kill, (os.getpid(), heard[0])).start()

    sys.unraisablehook = hear_again
    for number in SIGNALS:
        if signal.getsignal(number) not in (signal.SIG_IGN, None):
            signal.signal(number, hear)
    return heard


def main() -> None:
    """Run the command line and exit with its exit code, 128 + n after signal n."""
    while (number := os.open(os.devnull, os.O_RDWR)) < 3:
        pass  # a standard stream was closed, and the next file would get its text
    os.close(number)
    heard = hear_signals()
    try:
        code = cli.main(standalone_mode=False)  # a number if a command ended early
    except (Exception, KeyboardInterrupt) as error:
        cause = error.__cause__ or error  # a command may say what it has kept, and its results
        kept = cause.args if isinstance(cause, KeyboardInterrupt) else ()
        line, code = _fault(error, heard, *kept[:1])
        if "--json" in sys.argv[1:]:
            with suppress(OSError):
                print_stdout({"error": line, **dict(*kept[1:])})
        print_stderr(f"Error: {line}")
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        try:
            if stream:
                stream.flush()
        except OSError:  # Python would complain at its end about what is left
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
    if code:
        sys.exit(code)


def _fault(error: BaseException, heard: list[int], kept: str = "") -> tuple[str, int]:
    """Return the line and the exit code for an error, 2 for wrong usage; raise a bug again."""
    if heard:  # also what a library has made of the interrupt
        name = signal.Signals(heard[0]).name
        said = "interrupted" if name == "SIGINT" else f"ended by {name}"
        return f"{said}: {kept}" if kept else said, 128 + heard[0]
    if isinstance(error, click.NoSuchOption) and error.ctx and error.possibilities is not None:
        known = [name for each in error.ctx.command.params for name in each.opts]
        longer = [name for name in known if name.startswith(error.option_name)]
        error.possibilities[:] = longer or error.possibilities[:1]  # the most similar
    if isinstance(error, click.ClickException):
        return error.format_message(), error.exit_code
    if isinstance(error, (SuperSdfError, MemoryError)):
        return in_a_line(error), 1 + isinstance(error, OptionError)
    if isinstance(error, OSError):  # the system refused something, such as a file handle
        return str(error), 1
    raise error
