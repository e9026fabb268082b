"""The command group, and what a failed or interrupted command prints and returns.

Only click is imported at the top, so that ``super-sdf --help`` is quick.
"""

from __future__ import annotations

import sys

import click

from .. import __version__
from .common import CONTEXT, InterruptedCommand, print_stderr
from .interrupts import ending_at_once
from .streams import discard_unwritable_output


def _upsample() -> click.Command:
    from .upsample import upsample_command

    return upsample_command


def _batch() -> click.Command:
    from .batch import batch_command

    return batch_command


def _check() -> click.Command:
    from .check import check_command

    return check_command


def _sample() -> click.Command:
    from .sample import sample_command

    return sample_command


def _view() -> click.Command:
    from .view import view_command

    return view_command


def _info() -> click.Command:
    from .info import info_command

    return info_command


COMMANDS = {
    "upsample": _upsample,
    "batch": _batch,
    "check": _check,
    "sample": _sample,
    "view": _view,
    "info": _info,
}


class LazyGroup(click.Group):
    """A group that imports a command when it is used, so that one does not wait for the others."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands, in the order of the help."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command, None if there is none of this name."""
        return COMMANDS[cmd_name]() if cmd_name in COMMANDS else None


@click.group(cls=LazyGroup, context_settings=CONTEXT)
@click.version_option(__version__, prog_name="super-sdf")
def cli() -> None:
    """Turn coarse signed distance grids into fine meshes."""


def main() -> None:
    """Run the command line and exit with its exit code; every error is one line on stderr."""
    if code := run():
        sys.exit(code)


def run() -> int:
    """Run a command and write its output; return the exit code."""
    with ending_at_once():
        try:
            return run_command()
        finally:
            discard_unwritable_output()


def run_command() -> int:
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


if __name__ == "__main__":
    main()
