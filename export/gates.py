"""What a gated network loses at other thresholds, and what its gate knows of that.

    python -m export.gates gated.onnx --store training/store

The errors on the held-out windows of a store as in the log of a run, for shares of the voxels that
can hold the surface, those on which the gate says that most is lost. So a threshold is chosen.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from scipy.stats import spearmanr

from export.arguments import Parser, share
from export.augment import Prepared
from export.batches import batch_of, encode, predict, singly
from export.network import Encoded, SuperSdfNet
from export.recipe import RECIPE, Errors, batch_losses, sample_errors
from export.store import Store
from export.to_onnx import read_network
from super_sdf.errors import OptionError
from super_sdf.network.neighbourhood import CENTRE
from super_sdf.refine.band import DECODE_LIMIT

SHARES = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0)
NEVER = 1e9  # a threshold that nothing exceeds
HEADER = (
    "| threshold | share of the band | everywhere | near | normal |\n"
    "| ---: | ---: | ---: | ---: | ---: |"
)


@torch.no_grad()
def encode_first(net: SuperSdfNet, samples: list[Prepared]) -> list[Encoded]:
    """Return the voxels of each sample after the first blocks."""
    net.gate.threshold.fill_(NEVER)
    return [encode(net, batch) for batch in singly(net, samples)]


def threshold_of(encoded: list[Encoded], share: float) -> float:
    """Return the threshold that this share of the voxels that can hold the surface exceeds."""
    near = [part.doubts[part.patches[:, CENTRE].abs() <= DECODE_LIMIT] for part in encoded]
    return float(np.quantile(torch.cat(near), 1 - share)) if share else NEVER


@torch.no_grad()
def measure_at(
    net: SuperSdfNet, samples: list[Prepared], encoded: list[Encoded], threshold: float
) -> tuple[float, Errors]:
    """Return the share of the band on which the last blocks run, and the errors."""
    net.gate.threshold.fill_(threshold)
    errors, count = [], 0
    for sample, first in zip(samples, encoded):
        rows = net.gate.rows(first.doubts, first.patches)
        batch = batch_of([sample])
        deep = net.blend(first, batch.table, rows)
        errors.append(sample_errors(predict(net, batch, deep), batch.targets))
        count += len(rows)
    band = sum(len(sample.patches) for sample in samples)
    return count / band, Errors(*np.nanmean(errors, axis=0).tolist())


@torch.no_grad()
def correlation(net: SuperSdfNet, samples: list[Prepared], encoded: list[Encoded]) -> float:
    """Return the rank correlation between what the gate says and the loss of each voxel."""
    losses = [batch_losses(net, batch_of([s]), first, RECIPE) for s, first in zip(samples, encoded)]
    said = [first.doubts[s.voxels] for s, first in zip(samples, encoded)]
    return float(spearmanr(torch.cat(said), torch.cat(losses)).statistic)


def rows_of_table(file: Path, folder: Path, shares: tuple[float, ...]) -> Iterator[str]:
    net = read_network(file)
    if not net.config.gated:
        raise OptionError(f"{file} has no gate: give a network that was trained with --gated")
    samples = Store(folder, most=0).held_out
    encoded = encode_first(net, samples)
    for part in shares:
        threshold = threshold_of(encoded, part)
        band, errors = measure_at(net, samples, encoded, threshold)
        yield f"| {threshold:.4g} | {band:.3f} | {' | '.join(errors.cells())} |"
    found = correlation(net, samples, encoded)
    yield f"Rank correlation of what the gate says with the loss of a voxel: {found:.2f}"


def main() -> None:
    """Print the table."""
    parser = Parser(description=__doc__.split("\n")[0])
    parser.add_argument("file", type=Path, help="a file of export.to_onnx")
    parser.add_argument("--store", type=Path, required=True, help="folder of shards")
    parser.add_argument("--shares", type=share, nargs="+", default=SHARES, metavar="SHARE")
    options = parser.parse_args()
    with parser.one_line_errors():
        print(HEADER)
        for row in rows_of_table(options.file, options.store, options.shares):
            print(row, flush=True)


if __name__ == "__main__":
    main()
