"""How long the command takes and how much memory: whole processes, start included.

    python -m benchmarks.speed MESHES --sizes 32 64 128 --shapes 10 [-- --factor 8]

Samples every shape at every size, runs ``super-sdf upsample`` on it several times, and prints the
machine and, for each size, the mean over shapes of the median time, the slowest shape, and the
highest peak of memory. What follows ``--`` goes to the command.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path

from super_sdf.evaluation.cases import Setting, Shape
from super_sdf.evaluation.plan import find_meshes, spread
from super_sdf.evaluation.timing import RUNS, describe_machine, time_shape


def main() -> None:
    """Print the machine and a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("meshes", type=Path, nargs="+", help="files or folders")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64, 128])
    parser.add_argument("--shapes", type=int, default=10, help="how many, spread over them")
    parser.add_argument("--factor", type=int, default=4)
    parser.add_argument("options", nargs="*", help="further options of the command, after --")
    asked = parser.parse_args()
    paths = spread(find_meshes(asked.meshes), asked.shapes)
    print(f"{describe_machine()}; {len(paths)} shapes, factor {asked.factor}, median of {RUNS}\n")
    print("| grid | mean s | slowest s | peak MB |\n| --- | ---: | ---: | ---: |")
    for size in asked.sizes:
        setting = Setting(size, asked.factor)
        rows = [time_shape(Shape.read(path), setting, asked.options) for path in paths]
        seconds, peak = [row["seconds"] for row in rows], max(row["peak_mb"] for row in rows)
        mean = statistics.mean(seconds)
        print(f"| {size}^3 | {mean:.2f} | {max(seconds):.2f} | {peak:.0f} |", flush=True)


if __name__ == "__main__":
    main()
