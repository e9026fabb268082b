"""Run all commands on thousands of bad and odd inputs: no traceback, no hang, no bad mesh.

    python -m benchmarks.corpus                       # a seeded sample
    python -m benchmarks.corpus --whole               # all
    python -m benchmarks.corpus --only grids/header   # names that contain this
    python -m benchmarks.corpus --fields 10000        # random fields: manifolds?

The cases are in ``tests/corpus``; the tests run a sample of them.
"""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    from corpus.command import main

    sys.exit(main())
