"""The command group, and what a failed or interrupted command prints and returns.

Only click is imported at the top, so that ``super-sdf --help`` is quick.
"""

from __future__ import annotations

import sys

import click

from .. import __version__
from .common import CONTEXT, InterruptedCommand, print_stderr

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
                from .upsample import upsample_command as command
            case "batch":
                from .batch import batch_command as command
            case "check":
                from .check import check_command as command
            case "sample":
                from .sample import sample_command as command
            case "view":
                from .view import view_command as command
            case "info":
                from .info import info_command as command
            case _:
                return None
        return command


@click.group(cls=LazyGroup, context_settings=CONTEXT)
@click.version_option(__version__, prog_name="super-sdf")
def cli() -> None:
    """Turn coarse signed distance grids into fine meshes."""


def main() -> None:
    """Run the command line and exit with its exit code; every error is one line on stderr."""
    if code := run():
        sys.exit(code)


def run() -> int:
    """Run a command; return the exit code."""
    try:
        cli.main(standalone_mode=False)
    except click.ClickException as error:
        print_stderr(f"Error: {error.format_message()}")
        return error.exit_code
    except InterruptedCommand as error:
        print_stderr(f"Error: {error}")
        return error.exit_code
    except click.Abort:  # an interrupt outside of a command's work
        print_stderr("Error: interrupted")
        return 130
    except OSError as error:  # outside of a command's work, while help is printed
        print_stderr(f"Error: stdout cannot be written: {error.strerror or error}")
        return 1
    return 0
