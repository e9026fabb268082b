"""The group of commands, and how a command ends: exit code, one line on stderr, signals."""

from __future__ import annotations

import difflib
import io
import json
import os
import signal
import sys
from contextlib import suppress
from importlib import import_module
from types import FrameType

import click

from .. import __version__
from .common import CONTEXT, print_stderr, print_stdout

COMMANDS = ("upsample", "batch", "check", "sample", "view", "info")
SIGNALS = [getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)]


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
        near = difflib.get_close_matches(cmd_name, COMMANDS, 1)
        way_out = f"did you mean {near[0]}?" if near else f"give one of {', '.join(COMMANDS)}"
        ctx.fail(f"there is no command {cmd_name!r}: {way_out}")


@click.group(cls=Commands, context_settings=CONTEXT, invoke_without_command=True)
@click.version_option(__version__, prog_name="super-sdf")
@click.pass_context
def cli(context: click.Context) -> None:
    """Turn coarse signed distance grids into fine meshes."""
    if context.invoked_subcommand is None:
        print_stdout(context.get_help())


def main() -> None:
    """Run the command line and exit with its exit code; every error is one line on stderr."""
    if code := run():
        sys.exit(code)


def run() -> int:
    """Run a command; return the exit code: 2 for usage errors, 128 + n after signal n.

    A signal raises KeyboardInterrupt, so that files that were begun are removed; one that the
    parent process ignores, as ``nohup`` does, stays ignored.
    """
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
        return code if isinstance(code, int) else 0
    except OSError as error:  # while help is printed
        return end(f"stdout cannot be written: {error.strerror or error}", 1)
    except (Exception, KeyboardInterrupt) as error:
        if heard:  # also what a library has made of the interrupt
            name = signal.Signals(heard[0]).name
            said = "interrupted" if name == "SIGINT" else f"ended by {name}"
            cause = error.__cause__  # a command may say what it has kept
            kept = cause.args if isinstance(cause, KeyboardInterrupt) else ()
            return end(f"{said}: {kept[0]}" if kept else said, 128 + heard[0])
        if isinstance(error, click.ClickException):
            return end(error.format_message(), error.exit_code)
        raise
    finally:
        for number in SIGNALS:
            signal.signal(number, before[number])


def end(line: str, code: int) -> int:
    """Print an error, with ``--json`` also as JSON to stdout; return the exit code."""
    if "--json" in sys.argv[1:]:
        with suppress(click.ClickException, click.exceptions.Exit):
            print_stdout(json.dumps({"error": line}, indent=2))
    print_stderr(f"Error: {line}")
    return code
