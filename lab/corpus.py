"""Run all commands on thousands of bad and odd inputs: no traceback, no hang, no bad mesh.

    python -m lab corpus                       # a seeded sample
    python -m lab corpus --whole               # all
    python -m lab corpus --only grids/header   # names that contain this
    python -m lab corpus --fields 10000        # random fields: manifolds?

The cases are in ``tests/corpus``; the tests run a sample of them.
"""

import sys
from pathlib import Path


def main() -> int:
    """Run the command of the corpus."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from corpus.command import main

    return main()
