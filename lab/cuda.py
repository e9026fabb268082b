"""Compare CUDA with the CPU: values, speed, memory over many shapes, whole runs. Needs a GPU.

    python -m lab cuda --sizes 64 128 256

Prints Markdown: the machine; for each network and size the largest difference and the microseconds
per voxel, copies to and from the GPU included; GPU memory after ever larger shapes; and the seconds
from a grid to its mesh. All grids are noisy balls. If CUDA does not run, one line says why.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from super_sdf import SdfGrid, load_network, reconstruct
from super_sdf.errors import DeviceError
from super_sdf.network.device import describe_gpu, onnxruntime_version, query_gpu
from super_sdf.network.network import Network
from super_sdf.options import QUALITIES
from super_sdf.refine.nodes import block_offsets
from super_sdf.refine.survey import survey

from . import parser_of
from .tables import markdown

RUNS = 3
SHAPES = 40  # for the memory


def noisy_ball(size: int) -> SdfGrid:
    """Return a ball that fills most of the grid, with noise on some samples: every branch runs."""
    rng = np.random.default_rng(0)
    ijk = np.indices((size,) * 3, np.float32)
    values = np.linalg.norm(ijk - (size / 2 - 0.37), axis=0) - 0.38 * size
    values[: size // 4] += rng.uniform(-0.2, 0.2, values[: size // 4].shape)
    return SdfGrid.trusted(values.astype(np.float32), (1.0, 1.0, 1.0))


def network_inputs(size: int) -> tuple[np.ndarray, ...]:
    """Return the inputs of the network for a ball at factor 4."""
    return *survey(noisy_ball(size)).network_inputs(), block_offsets(4)


def best_seconds(work: Callable[..., Any], *arguments: Any) -> float:
    """Return the seconds of the fastest of several runs, after a warm-up run."""
    work(*arguments)
    seconds = []
    for _ in range(RUNS):
        start = time.perf_counter()
        work(*arguments)
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def compare_values(device: str, sizes: Sequence[int]) -> str:
    """Return the difference between the values of CUDA and of the CPU, and both times."""
    rows, places = [], ("cpu", device)
    for quality, size in product(QUALITIES, sizes):
        networks = [load_network(quality, device=at, precision="float32") for at in places]
        inputs = network_inputs(size)
        here, there = (network(*inputs) for network in networks)
        seconds = [best_seconds(network, *inputs) for network in networks]
        rates = [f"{1e6 * value / len(inputs[0]):.2f}" for value in seconds]
        apart = f"{np.abs(here - there).max() / 2:.1e}"
        rows.append([quality, f"{size}^3", f"{len(inputs[0]):,}", *rates, apart])
    rates = [f"{at} us per voxel" for at in ("CPU", device)]
    return markdown(["network", "grid", "voxels", *rates, "difference, voxels"], rows)


def watch_memory(device: str, size: int) -> str:
    """Return GPU memory after many shapes, each with more voxels than the last, and a small one."""
    rows = [["nothing", used_memory()]]
    network = load_network("base", device=device)
    rows.append(["loaded", used_memory()])
    inputs = network_inputs(size)
    for count, share in enumerate([*np.linspace(0.2, 1, SHAPES), 0.2], 1):
        run_part(network, inputs, share)
        if count in (1, 2, 5, 10, 20, SHAPES, SHAPES + 1):
            rows.append([f"{count} shapes", used_memory()])
    return markdown(["after", "used"], rows)


def run_part(network: Network, inputs: Sequence[np.ndarray], share: float) -> None:
    """Run the network on the first part of a band, without the rest."""
    patches, table, voxels, offsets = inputs
    count = int(share * len(patches))
    table = np.where(table[:count] < count, table[:count], -1).astype(np.int32)
    network(patches[:count], table, voxels[voxels < count], offsets)


def used_memory() -> str:
    """Return the GPU memory in use, according to nvidia-smi."""
    return (query_gpu("memory.used") or ["unknown"])[0]


def compare_pipeline(device: str, sizes: Sequence[int]) -> str:
    """Return the seconds from a grid to its mesh, without loading the network."""
    networks = [load_network("base", device=place) for place in ("cpu", device)]
    rows = []
    for size in sizes:
        grid = noisy_ball(size)
        seconds = [best_seconds(reconstruct, grid, network) for network in networks]
        rows.append([f"{size}^3", *(f"{value:.2f}" for value in seconds)])
    return markdown(["grid", "CPU s", f"{device} s"], rows)


def main() -> None:
    """Print all tables, or one line that says why CUDA does not run."""
    parser = parser_of(__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128, 256])
    parser.add_argument("--device", default="cuda", help="cpu tries this command itself")
    given = parser.parse_args()
    device, largest = given.device, max(given.sizes)
    try:
        load_network("fast", device=device)
    except DeviceError as error:
        print(f"nothing to measure: {error}")
        return
    gpu = describe_gpu() or "no GPU"
    print(f"{gpu}; {os.cpu_count()} cores; {onnxruntime_version()}; least of {RUNS} runs each")
    for title, table in (
        ("Values and speed of the network", partial(compare_values, device, given.sizes)),
        (f"Memory of the GPU in MiB, up to {largest}^3", partial(watch_memory, device, largest)),
        ("From a grid to its mesh", partial(compare_pipeline, device, given.sizes)),
    ):
        print(f"\n{title}\n\n{table()}", flush=True)
