"""The option ``--report`` of ``upsample`` and ``batch``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import click

from ..errors import OptionError

PAGES = (".html", ".htm")

report_option = click.option(
    "--report",
    type=click.Path(path_type=Path),
    metavar="PAGE.html",
    help="Also write a page for the browser: figures, times, warnings, the check of each mesh, and "
    "a 3-D view of it beside coarse marching cubes. Needs the extra report.",
)


def check_page(option: str, page: Path, others: Iterable[str | Path], *, force: bool) -> None:
    """Raise if a page cannot be written; called before the work starts.

    Raises
    ------
    SuperSdfError
        If the suffix is another, the file exists and ``force`` is not set, or it is one of
        the others, the inputs and outputs.
    """
    from ..files.output import check_apart, check_free

    if page.suffix.lower() not in PAGES:
        raise OptionError(f"{page} is not a page: give {option} a file {' or '.join(PAGES)}")
    check_free(page, force=force)
    check_apart(page, others)
