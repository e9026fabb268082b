"""Split the validation shapes: one half to choose a network on, one to measure once at the end.

    super-sdf evaluate $(python -m export.choice FOLDER choose) --sizes 32 --model new.onnx ...
    super-sdf evaluate $(python -m export.choice FOLDER final) --sizes 32 64 128 --out report/

Figures on shapes that were used to choose a network are too good. So the shapes of a folder are
split by a seed into two halves: candidates are compared on the first only, and the model card gives
the figures of both.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from super_sdf.evaluation.scope import find_meshes

HALVES = ("choose", "final")
SEED = 0


def draw_halves(paths: Sequence[Path], seed: int = SEED) -> dict[str, list[Path]]:
    """Return the two halves of the shapes; of an odd number the second gets one more.

    The split depends on the names of the files only, not on their order or folder.
    """
    names = sorted(path.stem for path in paths)
    chosen = set(np.random.default_rng(seed).permutation(names)[: len(names) // 2].tolist())
    return {
        "choose": [path for path in paths if path.stem in chosen],
        "final": [path for path in paths if path.stem not in chosen],
    }


def main() -> None:
    """Print the paths of one half, one per line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("meshes", nargs="+", type=Path, help="files or folders")
    parser.add_argument("half", choices=HALVES)
    parser.add_argument("--seed", type=int, default=SEED)
    options = parser.parse_args()
    for path in draw_halves(find_meshes(options.meshes), options.seed)[options.half]:
        print(path)


if __name__ == "__main__":
    main()
