"""The laboratory: quality against the truth, speed, memory, faults, and pictures. Not in the wheel.

``python -m lab`` lists the commands. It needs the extra ``lab``.

    shapes, kinds -> methods -> measuring (metrics, edges) -> runner -> rows -> tables
    -> evaluate, figures -> documents

Methods on shapes go through one runner of tasks (``runner``), what is timed through processes of
its own (``processes``); all is kept in files of rows (``rows``) and shown by ``tables``.
"""

import argparse


def parser_of(text: str) -> argparse.ArgumentParser:
    """Return the parser of a command's options; its help is the text of its module."""
    return argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
