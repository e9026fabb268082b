"""Time ONNX files on the band of a ball: microseconds a voxel.

python -m export.latency src/super_sdf/models/base.onnx
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

from export.calibration import ball
from super_sdf.network.network import load_network

RUNS = 5


def time_file(path: Path, threads: int) -> float:
    """Return the microseconds per voxel of a band that a shipped file takes."""
    sample, network = ball(), load_network(path, device="cpu", threads=threads)
    arrays = (sample.patches, sample.table, sample.voxels, sample.offsets)
    return least_seconds(lambda: network(*arrays), threads) / len(sample.patches) * 1e6


def least_seconds(run: Callable[[], object], threads: int) -> float:
    """Return the fastest of ``RUNS`` runs: processor time on one thread, else elapsed time."""
    clock = time.process_time if threads == 1 else time.perf_counter
    spent = []
    for _ in range(RUNS):
        start = clock()
        run()
        spent.append(clock() - start)
    return min(spent)


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
