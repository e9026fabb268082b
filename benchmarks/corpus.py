"""Thousands of bad and odd inputs, all commands: none may end in a traceback, a hang or a bad mesh.

    python -m benchmarks.corpus                       # a seeded sample
    python -m benchmarks.corpus --whole               # all
    python -m benchmarks.corpus --only grids/header   # those with this in their names
    python -m benchmarks.corpus --fields 10000        # random fields: closed manifolds?

The cases are those of ``tests/corpus``, of which the tests run a sample.
"""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    from corpus.command import main

    sys.exit(main())
