"""Time ONNX files on the band of a ball: microseconds a voxel.

python -m export.latency src/super_sdf/models/base.onnx
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from super_sdf.grid.sdf_grid import SdfGrid
from super_sdf.network.network import load_network
from super_sdf.refine.nodes import block_offsets
from super_sdf.refine.survey import survey

RUNS = 5
RADIUS = 35.0  # of the ball, voxels


def time_file(path: Path, threads: int) -> float:
    """Return the microseconds per voxel of the fastest run.

    They are processor time on one thread, else elapsed time.
    """
    network = load_network(path, device="cpu", threads=threads)
    shape = (int(2 * RADIUS + 8),) * 3
    distance = np.linalg.norm(np.indices(shape) - (shape[0] - 1) / 2, axis=0) - RADIUS
    inputs = survey(SdfGrid.trusted(distance.astype(np.float32), 1.0)).network_inputs()
    clock = time.process_time if threads == 1 else time.perf_counter
    spent = []
    for _ in range(RUNS):
        start = clock()
        network(*inputs, block_offsets(4))
        spent.append(clock() - start)
    return min(spent) / len(inputs[0]) * 1e6


def main() -> None:
    """Time shipped ONNX files."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("models", nargs="+", type=Path, help="ONNX files")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    for path in options.models:
        print(f"{path.name}: {time_file(path, options.threads):.1f} us per voxel of the band")


if __name__ == "__main__":
    main()
