"""What commands share: how help looks, errors in one line, extras that must be there."""

from __future__ import annotations

from collections.abc import Iterator
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


def check_extra(command: str) -> None:
    """Raise if the packages of the extra are not there."""
    from importlib.util import find_spec

    from .errors import FileError

    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise FileError(f"{command} needs {', '.join(missing)}: pip install 'super-sdf[eval]'")
