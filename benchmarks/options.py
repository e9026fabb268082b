"""Options after ``--`` on the command line of a benchmark, which are passed to ``super-sdf``."""

from __future__ import annotations

import argparse
import sys


def parse(parser: argparse.ArgumentParser) -> tuple[argparse.Namespace, list[str]]:
    """Parse the words before ``--``; return the result, and the words after it."""
    words = sys.argv[1:]
    end = words.index("--") if "--" in words else len(words)
    return parser.parse_args(words[:end]), words[end + 1 :]
