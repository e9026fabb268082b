"""What commands share: how help looks, errors in one line."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import click

from .interrupts import describe_interrupt, exit_code

CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100}


class InterruptedCommand(Exception):  # noqa: N818, it is no error
    """A signal ended the command: says which, and what a user has."""

    def __init__(self, kept: str, interrupt: KeyboardInterrupt) -> None:
        super().__init__(f"{describe_interrupt(interrupt)}{kept}")
        self.exit_code = exit_code(interrupt)


@contextmanager
def one_line_errors(kept: str = "nothing was written") -> Iterator[None]:
    """Turn errors into click's: one line, exit code 2 for usage, else 1; 128 + n for signal n.

    ``kept`` says what a user has if the command is interrupted.
    """
    from ..errors import OptionError, SuperSdfError

    try:
        yield
    except OptionError as error:
        raise click.UsageError(in_a_line(error)) from error
    except SuperSdfError as error:
        raise click.ClickException(in_a_line(error)) from error
    except MemoryError:
        raise click.ClickException("out of memory: use a smaller --factor or grid") from None
    except OSError as error:  # what the system refuses is no bug: too few file handles, say
        raise click.ClickException(describe_os_error(error)) from error
    except KeyboardInterrupt as error:
        raise InterruptedCommand(f"; {kept}", error) from None


def in_a_line(error: Exception) -> str:
    """Return what an error says in one line, whatever names of files or keys it repeats."""
    return " ".join(str(error).splitlines())


def describe_os_error(error: OSError) -> str:
    """Say in a line what the system refused, and of which file if it tells."""
    reason = error.strerror or str(error)
    return f"{error.filename}: {reason}" if error.filename else reason


@contextmanager
def progress_bar(label: str, quiet: bool) -> Iterator[Callable[[int, int], None] | None]:
    """Draw a bar on stderr, with the time that is left; None if nobody is there to see it."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    with click.progressbar(length=1000, label=label, file=sys.stderr) as shown:
        yield lambda done, total: shown.update(1000 * done // total - shown.pos)


def tell(line: str) -> None:
    """Print a line to stderr; where that cannot be written there is nobody to tell.

    It stays one line, whatever the names of files and of what is in them hold.
    """
    with suppress(OSError):
        click.echo(line.replace("\n", " "), err=True)


def print_result(text: str, kept: str) -> None:
    """Print to stdout what was asked for; ``kept`` says what a user has if that fails."""
    try:
        click.echo(text)
    except OSError as error:
        raise click.ClickException(
            f"stdout cannot be written: {error.strerror or error}; {kept}"
        ) from error
