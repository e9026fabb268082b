"""The entry point: handles signals and missing streams before anything large is imported."""

from __future__ import annotations

import os

from .interrupts import ending_at_once
from .streams import open_missing_streams


def main() -> None:
    """Run the command line and end the process.

    All is written by then. Python would first take apart what it has loaded, for 30 ms.
    """
    with ending_at_once():
        open_missing_streams()
        from .main import run

        code = run()
    os._exit(code)
