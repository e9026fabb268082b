"""What commands share: how help looks, errors in one line, extras that must be there."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import click

# Modules of the extra ``eval``.
NEEDED = ("igl", "matplotlib", "scipy", "skimage")
CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100}


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Turn this package's errors into click's: one line, exit code 2 for usage, else 1."""
    from .errors import OptionError, SuperSdfError

    try:
        yield
    except OptionError as error:
        raise click.UsageError(str(error)) from error
    except SuperSdfError as error:
        raise click.ClickException(str(error)) from error
    except MemoryError:
        raise click.ClickException("out of memory: use a smaller --factor or grid") from None


@contextmanager
def progress_bar(label: str, quiet: bool) -> Iterator[Callable[[int, int], None] | None]:
    """Draw a bar on stderr, with the time that is left; None if nobody is there to see it."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    with click.progressbar(length=1000, label=label, file=sys.stderr) as shown:
        yield lambda done, total: shown.update(1000 * done // total - shown.pos)


def check_extra(command: str) -> None:
    """Raise if the packages of the extra are not there."""
    from importlib.util import find_spec

    from .errors import FileError

    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise FileError(f"{command} needs {', '.join(missing)}: pip install 'super-sdf[eval]'")
