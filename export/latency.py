"""Time networks of any architecture in onnxruntime, all exported in the same way.

    python -m export.latency src/super_sdf/models/base.onnx

PyTorch's exporter gathers all rows of a convolution at once; the shipped graph works chunk by chunk
(``to_onnx``) and is faster.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import torch

from export.augment import Prepared
from export.network import SuperSdfNet
from export.variants import UNet
from super_sdf.grid.sdf_grid import SdfGrid
from super_sdf.network.network import load_network
from super_sdf.network.onnx import ort
from super_sdf.steps.nodes import block_offsets
from super_sdf.steps.survey import survey

NAMES = ["patches", "neighbours", "voxels", "offsets"]
RUNS = 5


def ball(radius: float = 35.0) -> Prepared:
    """Return the band of a ball; the targets are empty."""
    shape = (int(2 * radius + 8),) * 3
    distance = np.linalg.norm(np.indices(shape) - (shape[0] - 1) / 2, axis=0) - radius
    band = survey(SdfGrid.trusted(distance.astype(np.float32), 1.0))
    patches, table, voxels = band.network_inputs()
    targets = np.zeros((len(voxels), 0), np.float32)
    return Prepared(band.voxel_ijk, patches, table, voxels, block_offsets(4), targets)


def microseconds(net: SuperSdfNet, sample: Prepared, threads: int) -> float:
    """Return a network's microseconds per voxel of a band, decoding what can hold the surface."""
    arrays = (sample.patches, sample.table, sample.voxels, sample.offsets)
    tensors = [torch.from_numpy(array) for array in arrays]
    if isinstance(net, UNet):
        tables, parents = net.levels([sample])
        tensors += [*tables[1:], *parents]
    names = NAMES + [f"level_{n}" for n in range(len(tensors) - len(NAMES))]
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # warnings of the exporter about fixed shapes
        path = Path(folder) / "net.onnx"
        torch.onnx.export(
            net.eval(), tuple(tensors), path, input_names=names, output_names=["values"],
            opset_version=17, dynamo=False,
        )  # fmt: skip
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        session = ort.InferenceSession(str(path), options)
    wanted = {given.name for given in session.get_inputs()}
    feeds = {n: t.numpy() for n, t in zip(names, tensors) if n in wanted}
    return least_seconds(lambda: session.run(None, feeds), threads) / len(sample.patches) * 1e6


def time_file(path: Path, threads: int) -> float:
    """Return the microseconds per voxel of a band that a shipped file takes."""
    sample, network = ball(), load_network(path, device="cpu", threads=threads)
    arrays = (sample.patches, sample.table, sample.voxels, sample.offsets)
    return least_seconds(lambda: network(*arrays), threads) / len(sample.patches) * 1e6


def least_seconds(run, threads: int) -> float:
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
