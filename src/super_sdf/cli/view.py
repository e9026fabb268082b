"""The command ``view``: meshes and grids in the browser, from a server on this machine."""

from __future__ import annotations

from typing import Any

import click

from ..machine.extras import EXTRAS, check_modules
from .common import CONTEXT, InterruptedCommand, one_line_errors, print_stderr
from .conversion import check_simplification, chosen_model, conversion_options, make_options
from .interrupts import raising_interrupts

NEEDED = (*EXTRAS["eval"], *EXTRAS["simplify"])  # of the extra report: nothing is drawn here
EXAMPLES = """\b
Examples:
  super-sdf view part.npz
  super-sdf view part.ply other.stl --port 8000 --no-browser
"""


@click.command(
    "view",
    context_settings=CONTEXT,
    epilog=EXAMPLES,
    short_help="Look at meshes and grids in the browser.",
)
@click.argument("sources", metavar="MESH|GRID...", nargs=-1, required=True)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    show_default=True,
    help="Port of the server; 0 means any that is free.",
)
@click.option("--no-browser", is_flag=True, help="Print the address and open no browser.")
@conversion_options
def view_command(sources: tuple[str, ...], **options: Any) -> None:
    """Look at meshes, and at grids refined as by upsample, in the browser.

    MESH is any mesh file that trimesh reads. GRID is what upsample takes; its refined mesh is shown
    beside coarse marching cubes of the samples, from one camera, with the residuals of its samples
    as colours. Nothing is written; the options below apply to grids.

    The page comes from a server that only this machine can reach, at an address with a secret
    token. Ctrl-C ends it. Needs the extra report.
    """
    with one_line_errors(), raising_interrupts():
        check_modules("view", "report", NEEDED)
        serve(viewed(sources, options), options)


def viewed(sources: tuple[str, ...], options: dict[str, Any]) -> dict[str, str]:
    """Read and refine the files; return the texts to serve."""
    from ..network.network import Network, load_network
    from ..pages.viewing import viewed_texts

    check_simplification(options)
    model = chosen_model(options)

    def load() -> Network:
        chosen = {name: options[name] for name in ("device", "threads", "precision")}
        return load_network(model, **chosen)

    return viewed_texts(sources, load, make_options(options))


def serve(texts: dict[str, str], options: dict[str, Any]) -> None:
    """Serve the texts until a signal ends it."""
    import threading
    import webbrowser

    from ..pages.server import PageServer

    with PageServer(texts, options["port"]) as server:
        print_stderr(f"{server.address} (Ctrl-C ends it)")
        if not options["no_browser"]:
            open_beside = threading.Thread(target=webbrowser.open, args=[server.address])
            open_beside.daemon = True  # a browser in the terminal returns when it is closed
            open_beside.start()
        try:
            server.serve_forever()
        except KeyboardInterrupt as error:
            raise InterruptedCommand("; the page is closed", error) from None
