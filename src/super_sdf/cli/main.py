"""The command group, and what a failed or interrupted command prints and returns.

Only click is imported at the top, so that ``super-sdf --help`` is quick.
"""

from __future__ import annotations

import sys

import click

from .. import __version__
from .batch import batch_command
from .common import CONTEXT, InterruptedCommand, print_stderr
from .evaluate import evaluate_command
from .info import info_command
from .interrupts import ending_at_once
from .render import render_command
from .sample import sample_command
from .streams import discard_unwritable_output
from .upsample import upsample_command


@click.group(context_settings=CONTEXT)
@click.version_option(__version__, prog_name="super-sdf")
def cli() -> None:
    """Turn coarse signed distance grids into fine meshes."""


for command in (
    upsample_command,
    batch_command,
    sample_command,
    evaluate_command,
    render_command,
    info_command,
):
    cli.add_command(command)


def main() -> None:
    """Run the command line and exit with its exit code; every error is one line on stderr."""
    with ending_at_once():
        try:
            code = run()
        finally:
            discard_unwritable_output()
    if code:
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
        print_stderr("Error: interrupted; nothing was written")
        return 130
    except OSError as error:  # outside of a command's work, while help is printed
        print_stderr(f"Error: stdout cannot be written: {error.strerror or error}")
        return 1
    return 0


if __name__ == "__main__":
    main()
