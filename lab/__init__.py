"""The laboratory: quality against the truth, speed, memory, faults, and pictures. Not in the wheel.

``python -m lab`` lists the commands. It needs the extra ``lab``.

    shapes, kinds -> methods -> measuring (metrics, edges) -> runner -> rows -> tables
    -> evaluate, figures -> documents

Everything that is measured goes through one runner of processes (``runner``, ``processes``), one
file of rows (``rows``) and one module of tables (``tables``).
"""

import argparse


def parser_of(text: str) -> argparse.ArgumentParser:
    """Return the parser of a command's options; its help is the text of its module."""
    return argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
