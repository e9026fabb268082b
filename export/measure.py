"""The errors of networks on the windows held out of a store; of those for masks bias and reach.

    python -m export.measure --store training/store src/super_sdf/models/base.onnx training/run

So a shipped network can be compared with one in training, of which the averaged weights are
measured. Errors are those of the log of a run, which has a third of these windows.
``lab figures --only masks`` has whole bodies. ``--time examples/part.npz`` adds what a voxel of
that grid costs in the int8 variant of a file, if it has one.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from export.arguments import Parser
from export.augment import DISTANCES, Prepared, of_mask
from export.dataset import Sample
from export.losses import measure
from export.network import SuperSdfNet
from export.store import HELD_OUT, held_out
from export.to_onnx import load_run, read_network
from super_sdf import SdfGrid, load_network, read_grid
from super_sdf.errors import OptionError
from super_sdf.grid.derived import mask_distances
from super_sdf.network import contract
from super_sdf.refine.band import neighbour_table, survey
from super_sdf.refine.nodes import block_offsets

STEP, STEPPED = 16, 9  # samples to a step in a plane; those beside it, by which reach is measured
OF_MASKS = "smooth", "bias", "reach"
FACTOR, RUNS = 4, 11  # of the refinement that is timed, and how often it is


def cells_of_masks(net: SuperSdfNet, smooth: Sequence[Prepared]) -> list[str]:
    """Return the error near the surface and the bias on smooth bodies, and the reach.

    The bias is over 0 where the surface is made too flat. Nothing without smooth bodies, or if the
    network is for distances.
    """
    if net.config.keeps_samples or not smooth:
        return []
    found = measure(net, smooth)
    return [f"{found.near:.5f}", f"{found.bias:.5f}", f"{reach_of(net):.2f}"]


@torch.no_grad()
def reach_of(net: SuperSdfNet) -> float:
    """Return how far a step of a voxel in a plane of a mask moves the surface, in voxels.

    It is the sum over ``STEPPED`` voxels beside the step: .5 if none but the first moves, which
    goes half of the way, and half of ``STEPPED`` if all do.
    """
    x, _, z = np.indices((2 * STEP, 2 * STEP, 2 * STEP))
    inside = z < STEP + (x >= STEP)
    voxel_ijk = np.argwhere(np.abs(mask_distances(inside)) < 1)  # beside the plane
    nowhere = np.zeros((1, 3), np.float32), voxel_ijk, np.zeros((len(voxel_ijk), 1), np.float32)
    device = net.correction.weight.device.type
    plane = of_mask(Sample(inside, *nowhere), inside).on(device)
    values = np.full(inside.shape, np.nan)
    at_samples = net(plane.patches, plane.table, plane.voxels, plane.offsets)
    values[tuple(voxel_ijk.T)] = at_samples[:, 0].cpu()
    inside, outside = values[STEP : STEP + STEPPED, STEP, STEP : STEP + 2].T
    return float((0.5 - inside / (inside - outside)).sum())


def microseconds(paths: Sequence[Path], grid: SdfGrid) -> dict[Path, float]:
    """Return the processor time a voxel of the band of a grid, on one thread, head included.

    It is the median for the int8 variant beside a file, and the files are run in turn. A run, or a
    file without the variant, has none.
    """
    band = survey(grid)
    table = neighbour_table(band.voxel_ijk, grid.shape)
    decoded, seconds = np.flatnonzero(band.decoded).astype(np.int32), {}
    int8 = {path: path.with_name(f"{path.stem}-int8.onnx") for path in paths}
    networks = {p: load_network(file, threads=1) for p, file in int8.items() if file.is_file()}
    for path, network in list(networks.items()) * RUNS:
        patches = np.pad(band.patches, ((0, 0), (0, network.card.get("wide", 0))))
        clock = time.process_time()
        network(patches, table, decoded, block_offsets(FACTOR))
        seconds.setdefault(path, []).append(time.process_time() - clock)
    return {path: 1e6 * float(np.median(some)) / len(table) for path, some in seconds.items()}


def main(words: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = Parser(description=__doc__.split("\n")[0])
    parser.add_argument("files", type=Path, nargs="+", help=".onnx files and folders of runs")
    parser.add_argument("--store", type=Path, required=True, help="folder of shards")
    parser.add_argument("--time", type=Path, metavar="GRID", help="time files on a grid, too")
    options = parser.parse_args(words)
    with parser.one_line_errors():
        nets = {f: load_run(f) if f.is_dir() else read_network(f) for f in options.files}
        masks = {not net.config.keeps_samples for net in nets.values()}
        if len(masks) > 1:
            raise OptionError("networks for masks and for distances: measure them apart")
        (masks,) = masks
        kind = contract.MASKS if masks else DISTANCES
        samples = held_out(options.store, kind, HELD_OUT)
        smooth = held_out(options.store, kind, 1, "smooth") if masks else []
        columns = ["network", "everywhere", "near", "normal", *OF_MASKS[: 3 * bool(smooth)]]
        times = microseconds(options.files, read_grid(options.time)) if options.time else None
        columns += ["us a voxel"] * (times is not None)
        print(f"| {' | '.join(columns)} |\n| --- {'| ---: ' * (len(columns) - 1)}|")
        for path, net in nets.items():
            cells = measure(net, samples).cells() + cells_of_masks(net, smooth)
            if times is not None:
                cells.append(f"{times[path]:.2f}" if path in times else "-")
            print(f"| {path.name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
