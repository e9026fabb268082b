"""The option ``--report`` of ``upsample`` and ``batch``."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import click

from ..errors import OptionError
from ..machine.extras import check_modules

PAGES = (".html", ".htm")

report_option = click.option(
    "--report",
    type=click.Path(path_type=Path),
    metavar="PAGE.html",
    help="Also write a page for the browser: figures, times, warnings, the check of each mesh, and "
    "a 3-D view of it beside coarse marching cubes. Needs the extra report.",
)


def check_report(page: Path, others: Iterable[str | Path], *, force: bool) -> None:
    """Raise if a page cannot be written; called before the work starts.

    ``others`` are the inputs and outputs, which it must not replace.

    Raises
    ------
    SuperSdfError
        If the extra is missing, the suffix is another, the file exists and ``force`` is not set, or
        it is one of the others.
    """
    from ..files.output import check_free

    check_modules("--report", "report")
    if page.suffix.lower() not in PAGES:
        raise OptionError(f"{page} is not a page: give --report a file {' or '.join(PAGES)}")
    check_free(page, force=force)
    for other in others if page.exists() else ():
        if os.path.exists(other) and os.path.samefile(page, other):
            raise OptionError(f"--report {page} is {other}: give another file")
