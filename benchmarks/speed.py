"""Time and memory of a conversion.

    python -m benchmarks.speed MESHES --sizes 32 64 128 --shapes 10 [-- --precision int8]
    python -m benchmarks.speed MESHES --sizes 32 64 128 --shapes 10 --warm

Samples every shape at every size, converts it several times, and prints the machine and, for each
size, the mean over shapes of the median time, the slowest shape, and the highest peak memory. Whole
processes are measured, start included, and options after ``--`` are passed to the command; with
``--warm``, from file to file in this process, which has loaded the network.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

from benchmarks.options import parse
from super_sdf.convert import ConvertOptions, convert
from super_sdf.evaluation.cases import Setting, Shape
from super_sdf.evaluation.measuring import Measurement
from super_sdf.evaluation.scope import find_meshes, spread
from super_sdf.evaluation.timing import RUNS, describe_machine, grid_file, time_shape
from super_sdf.machine.memory import forget_peak, held_memory
from super_sdf.network.network import Network, load_network


def time_warm(shape: Shape, setting: Setting, network: Network) -> Measurement:
    """Time a conversion in this process, as ``time_shape`` times the command."""
    seconds, options = [], ConvertOptions(setting.factor, inside="negative")
    with grid_file(shape, setting) as grid:
        forget_peak()
        for _ in range(RUNS + 1):
            start = time.perf_counter()
            convert(grid, grid.with_suffix(".ply"), network, options, force=True)
            seconds.append(time.perf_counter() - start)
    peak = (held_memory(peak=True) or 0) / 1e6
    return {"seconds": statistics.median(seconds[1:]), "peak_mb": peak}


def main() -> None:
    """Print the machine and a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("meshes", type=Path, nargs="+", help="files or folders")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64, 128])
    parser.add_argument(
        "--shapes", type=int, default=10, help="number of shapes, spread over the list"
    )
    parser.add_argument("--factor", type=int, default=4)
    parser.add_argument("--warm", action="store_true", help="convert in this process")
    arguments, options = parse(parser)
    if arguments.warm and options:
        parser.error("with --warm the command is not run: leave its options away")
    paths = spread(find_meshes(arguments.meshes), arguments.shapes)
    network = load_network() if arguments.warm else None

    def measure(path: Path, setting: Setting) -> Measurement:
        shape = Shape.read(path)
        if network:
            return time_warm(shape, setting, network)
        return time_shape(shape, setting, options)

    print(
        f"{describe_machine()}; {len(paths)} shapes, factor {arguments.factor}, median of {RUNS}\n"
    )
    print("| grid | mean s | slowest s | peak MB |\n| --- | ---: | ---: | ---: |")
    for size in arguments.sizes:
        rows = [measure(path, Setting(size, arguments.factor)) for path in paths]
        seconds, peak = [row["seconds"] for row in rows], max(row["peak_mb"] for row in rows)
        mean = statistics.mean(seconds)
        print(f"| {size}^3 | {mean:.3f} | {max(seconds):.3f} | {peak:.0f} |", flush=True)


if __name__ == "__main__":
    main()
