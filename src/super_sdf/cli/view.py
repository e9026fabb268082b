"""The command ``view``: a page for the browser, in one file."""

from __future__ import annotations

from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from click import argument, option

from ..options import OPTIONS
from . import main
from .main import SHARED, table_option

HELP = """Look at meshes, and at grids refined as by upsample, in the browser.

MESH is any mesh file that trimesh reads. GRID is what upsample takes; its refined mesh is shown
beside coarse marching cubes of the samples, with the residuals of its samples as colours (extra
report). The page is one file, which needs no server; its address is printed.

\b
Examples:
  super-sdf view part.npz
  super-sdf view part.ply other.stl --out page.html --no-browser
"""

# fmt: off
TAKES = (
    argument("sources", metavar="MESH|GRID...", nargs=-1, required=True),
    option("--out", type=main.FILE, metavar="PAGE.html",
        help="File for the page. Default: one in the temporary folder that only you can read."),
    SHARED["force"],
    option("--no-browser", is_flag=True, help="Print the address and open no browser."),
    *(table_option(name) for name in OPTIONS if name != "labels"),
)
# fmt: on


@main.make_command("Look at meshes and grids in the browser.", HELP, *TAKES)
def command(sources: tuple[str, ...], out: Path | None, **given: Any) -> None:
    """Write the page, print its address and open it."""
    from ..pages.html import viewed_page, write_page

    if out:
        main.check_page("--out", out, sources, (), force=given["force"])
    text = viewed_page(sources, main.chosen_options(given))
    page = out or Path(mkdtemp(prefix="super-sdf-"), "view.html")  # only this user can read it
    write_page(text, page, force=given["force"])
    address = page.absolute().as_uri()
    main.print_stderr(address)
    if not given["no_browser"]:
        import webbrowser

        webbrowser.open(address)
