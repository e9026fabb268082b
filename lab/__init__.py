"""The laboratory: quality against the truth, speed, memory, faults, and pictures. Not in the wheel.

``python -m lab`` lists the commands. It needs the extra ``lab``.

    samples -> shapes, kinds -> methods -> measuring (metrics) -> rows -> tables -> documents
    -> evaluate -> figures (costs)
"""

import argparse


def parser_of(text: str) -> argparse.ArgumentParser:
    """Return the parser of a command's options; its help is the text of its module."""
    return argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
