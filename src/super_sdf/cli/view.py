"""The command ``view``: a page for the browser, in one file."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from ..errors import check_modules
from .common import (CONTEXT, check_page, conversion_options, load_chosen, make_options, one_line_errors, print_stderr)
from .interrupts import raising_interrupts

EXAMPLES = """\b
Examples:
  super-sdf view part.npz
  super-sdf view part.ply other.stl --out page.html --no-browser
"""


@click.command(
    "view",
    context_settings=CONTEXT,
    epilog=EXAMPLES,
    short_help="Look at meshes and grids in the browser.",
)
@click.argument("sources", metavar="MESH|GRID...", nargs=-1, required=True)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="PAGE.html",
    help="File for the page. Default: one in the temporary folder that only you can read.",
)
@click.option("--force", is_flag=True, help="Replace PAGE.html if it exists.")
@click.option("--no-browser", is_flag=True, help="Print the address and open no browser.")
@conversion_options
def view_command(sources: tuple[str, ...], **options: Any) -> None:
    """Look at meshes, and at grids refined as by upsample, in the browser.

    MESH is any mesh file that trimesh reads. GRID is what upsample takes; its refined mesh is shown
    beside coarse marching cubes of the samples, from one camera, with the residuals of its samples
    as colours. The options below apply to grids.

    The page is one file, which shows all of it without a server; its address is printed. Needs the
    extra report.
    """
    with one_line_errors():
        page = write_view(sources, options)
    print_stderr(page.as_uri())
    if not options["no_browser"]:
        import webbrowser

        if not webbrowser.open(page.as_uri()):
            print_stderr("Note: no browser can be started here: open that address in yours")


def write_view(sources: tuple[str, ...], options: dict[str, Any]) -> Path:
    """Read and refine the files and write their page; return its absolute path."""
    from tempfile import mkdtemp

    from ..pages.html import viewed_page, write_page

    check_modules("view", "report")
    page: Path | None = options["out"]
    if page:
        check_page("--out", page, sources, force=options["force"])
    chosen = make_options(options)
    with raising_interrupts():
        text = viewed_page(sources, partial(load_chosen, options), chosen)
        # a folder that only this user can read
        page = page or Path(mkdtemp(prefix="super-sdf-"), "view.html")
        write_page(text, page, force=options["force"])
    return page.absolute()
