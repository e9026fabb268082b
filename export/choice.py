"""Split the validation shapes: one half to choose a network on, one to measure once at the end.

    python -m lab evaluate $(python -m export.choice FOLDER choose) --sizes 32 --model new.onnx ...
    python -m lab evaluate $(python -m export.choice FOLDER final) --sizes 32 64 128 --out report/

Figures on shapes that were used to choose a network are too good. So the shapes of a folder are
split by a seed into two halves: candidates are compared on the first only, and the model card gives
the figures of both.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from lab.shapes import HALVES, HALVES_SEED, draw_halves, find_meshes


def main() -> None:
    """Print the paths of one half, one per line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("meshes", nargs="+", type=Path, help="files or folders")
    parser.add_argument("half", choices=HALVES)
    parser.add_argument("--seed", type=int, default=HALVES_SEED)
    options = parser.parse_args()
    paths = {path.stem: path for path in find_meshes(options.meshes)}
    for name in draw_halves(list(paths), options.seed)[options.half]:
        print(paths[name])


if __name__ == "__main__":
    main()
