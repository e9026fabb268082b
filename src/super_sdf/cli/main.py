"""The command group, and what a failed or interrupted command prints and returns.

Only click is imported at the top, so that ``super-sdf --help`` is quick.
"""

from __future__ import annotations

import difflib
import json
import sys
from contextlib import suppress
from typing import Any

import click

from .. import __version__
from .common import CONTEXT, PIPE_CLOSED, InterruptedCommand, print_stderr, print_stdout
from .interrupts import wants_json

COMMANDS = ("upsample", "batch", "check", "sample", "view", "info")


class LazyGroup(click.Group):
    """A group that imports a command when it is used, so that one does not wait for the others."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands, in the order of the help."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command, None if there is none of this name."""
        match cmd_name:
            case "upsample":
                from .upsample import upsample_command

                return upsample_command
            case "batch":
                from .batch import batch_command

                return batch_command
            case "check":
                from .check import check_command

                return check_command
            case "sample":
                from .sample import sample_command

                return sample_command
            case "view":
                from .view import view_command

                return view_command
            case "info":
                from .info import info_command

                return info_command
        return None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that is meant; for a name that is none, name the nearest."""
        name = args[0]
        if name not in COMMANDS and not name.startswith("-"):
            near = difflib.get_close_matches(name, COMMANDS, 1)
            way_out = f"did you mean {near[0]}?" if near else f"give one of {', '.join(COMMANDS)}"
            ctx.fail(f"there is no command {name!r}: {way_out}")
        return super().resolve_command(ctx, args)


@click.group(cls=LazyGroup, context_settings=CONTEXT, invoke_without_command=True)
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
    """Run a command; return the exit code."""
    try:
        code = cli.main(standalone_mode=False)  # a number if a command ended early
    except click.ClickException as error:
        return _end(error.format_message(), error.exit_code)
    except InterruptedCommand as error:
        return _end(str(error), error.exit_code, error.facts)
    except click.Abort:  # an interrupt outside of a command's work
        return _end("interrupted", 130)
    except OSError as error:  # outside of a command's work, while help is printed
        if isinstance(error, BrokenPipeError):
            return PIPE_CLOSED
        print_stderr(f"Error: stdout cannot be written: {error.strerror or error}")
        return 1
    return code if isinstance(code, int) else 0


def _end(line: str, code: int, facts: dict[str, Any] | None = None) -> int:
    """Print an error, with ``--json`` also as JSON to stdout; return the exit code."""
    if wants_json():
        with suppress(click.ClickException, click.exceptions.Exit):
            print_stdout(json.dumps({**(facts or {}), "error": line}, indent=2))
    print_stderr(f"Error: {line}")
    return code
