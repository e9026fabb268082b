"""Look at meshes, and at grids refined as by upsample, in the browser.

MESH is any mesh file that trimesh reads. GRID is a grid file as for upsample. The refined mesh of a
grid is shown beside marching cubes of the samples, with residuals as colours (extra report). The
page is a single file without a server, whose address is printed.

  super-sdf view part.npz
  super-sdf view part.ply other.stl --out page.html --no-browser
"""

from __future__ import annotations

import webbrowser
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from click import Argument, Option

from ..options import OPTIONS
from . import main

TAKES = (
    Argument(["sources"], metavar="MESH|GRID...", nargs=-1, required=True, type=main.NAME),
    Option(["--out"], type=main.FILE, metavar="PAGE.html",
        help="File for the page. Default: a file that only you can read, in the temporary folder."),
    "force",
    Option(["--no-browser"], is_flag=True, help="Print the address and open no browser."),
    *(name for name in OPTIONS if name != "labels"),
)  # fmt: skip


def command(sources: tuple[str, ...], out: Path | None, **given: Any) -> None:
    """Write the page, print its address and open it."""
    from ..pages.html import viewed_page, write_page

    if out:
        main.check_page("--out", out, sources, (), force=given["force"])
    text = viewed_page(sources, main.chosen_options(given))
    page = out or Path(mkdtemp(prefix="super-sdf-"), "view.html")  # only this user can read it
    write_page(text, page, force=given["force"])
    main.print_stderr(address := page.absolute().as_uri())
    if not given["no_browser"]:
        webbrowser.open(address)
