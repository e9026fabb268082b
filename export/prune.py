"""Remove the blocks of a network that never react: they add a constant to every voxel.

    python -m export.prune src/super_sdf/models/base.onnx --out pruned.onnx

A block whose first rectifier is always 0, whatever the neighbours are, adds a constant. This is
moved to the bias of the layer before it, and the values stay the same.
"""

from __future__ import annotations

import argparse
import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from export.calibration import (
    Ranges,
    distance_apart,
    draw_samples,
    find_ranges,
)
from export.network import SuperSdfNet
from export.to_onnx import PARITY, read_card, read_network, write_model


@torch.no_grad()
def without_idle_blocks(net: SuperSdfNet, ranges: list[Ranges]) -> SuperSdfNet:
    """Return the network without the blocks whose first rectifier is always 0.

    Those behind a gate stay: what they add is not added to every voxel.
    """
    pruned = copy.deepcopy(net)
    before, kept = pruned.stem[2], []
    for number, (block, block_ranges) in enumerate(zip(pruned.blocks, ranges)):
        if block_ranges.mixed.any() or number >= net.config.blocks - net.config.gated:
            before = block.reduce
            kept.append(block)
        else:
            before.bias += block.reduce(torch.relu(block.expand.bias))
    pruned.blocks = nn.ModuleList(kept)
    pruned.config = replace(net.config, blocks=len(kept))
    return pruned


def card_of(source: Path, net: SuperSdfNet, **changed: str) -> dict[str, Any]:
    """Return the metadata of a file, updated for a network that was made from it."""
    size = sum(parameter.numel() for parameter in net.parameters())
    field = net.config.receptive_field
    return {**read_card(source), "parameters": size, "receptive_field": field, **changed}


def main() -> None:
    """Write the file; keep it only if its values are the same."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("source", type=Path, help="an .onnx file of export.to_onnx")
    parser.add_argument("--out", type=Path, required=True, help="the new .onnx file")
    options = parser.parse_args()
    whole = read_network(options.source)
    net = without_idle_blocks(whole, find_ranges(whole, draw_samples()))
    write_model(net, options.out, card_of(options.source, net))
    apart = distance_apart(options.source, options.out).max()
    if apart > PARITY / 2:
        options.out.unlink()
        raise SystemExit(f"{apart:.1e} voxels from {options.source}: not kept")
    blocks = f"{net.config.blocks} of {whole.config.blocks} blocks"
    print(f"{options.out}: {blocks}, {apart:.1e} voxels from {options.source}")


if __name__ == "__main__":
    main()
