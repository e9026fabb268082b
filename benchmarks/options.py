"""What follows ``--`` on a benchmark's command line: options of ``super-sdf`` itself."""

from __future__ import annotations

import argparse
import sys


def parse(parser: argparse.ArgumentParser) -> tuple[argparse.Namespace, list[str]]:
    """Return what the parser makes of the words before ``--``, and those after it."""
    words = sys.argv[1:]
    end = words.index("--") if "--" in words else len(words)
    return parser.parse_args(words[:end]), words[end + 1 :]
