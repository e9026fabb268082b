"""What all commands share: help layout, one-line errors, output to stdout and stderr."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import click

from ..errors import OptionError, SuperSdfError, seen
from .interrupts import describe_interrupt, exit_code

CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100}


class InterruptedCommand(BaseException):  # as KeyboardInterrupt, no error
    """A signal ended the command: the message names the signal and what was kept."""

    def __init__(self, kept: str, interrupt: KeyboardInterrupt) -> None:
        self.exit_code = exit_code(interrupt)
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
    """Return which files are not those of before, as the end of a sentence; "" for no files."""
    written = [path for path, file in before.items() if _file_at(path) != file]
    if not written:
        return "; nothing was written" if before else ""
    return f"; {' and '.join(written)} {'is' if len(written) == 1 else 'are'} written"


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
    with suppress(OSError):
        click.echo(line.replace("\n", " "), err=True)


def print_warning(text: str) -> None:
    """Print a warning to stderr, in place of a progress line if one is shown there."""
    cleared = "\r\x1b[K" if sys.stderr is not None and sys.stderr.isatty() else ""
    print_stderr(f"{cleared}Warning: {text}")


def print_stdout(text: str, kept: str) -> None:
    """Print the result that the user asked for; ``kept`` says which output exists if that fails."""
    try:
        click.echo(text)
    except OSError as error:
        raise click.ClickException(
            f"stdout cannot be written: {error.strerror or error}; {kept}"
        ) from error
