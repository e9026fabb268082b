"""The entry point: what must be right before anything large is imported.

That is signals, missing streams, and a processor that NumPy can run on.
"""

from __future__ import annotations

import os

from ..machine.processor import check_processor
from .interrupts import ending_at_once
from .streams import open_missing_streams


def main() -> None:
    """Run the command line and end the process.

    All is written by then. Python would first take apart what it has loaded, for 30 ms.
    """
    with ending_at_once():
        open_missing_streams()
        check_processor()
        from .main import run

        code = run()
    os._exit(code)
