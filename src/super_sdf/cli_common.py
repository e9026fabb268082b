"""What commands share: how help looks, errors in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import click

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
