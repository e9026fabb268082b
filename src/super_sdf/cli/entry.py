"""The entry point: handles signals and missing streams before anything large is imported."""

from __future__ import annotations

from .interrupts import ending_at_once
from .streams import open_missing_streams


def main() -> None:
    """Run the command line."""
    with ending_at_once():
        open_missing_streams()
        from .main import main as run

        run()
