"""Start a larger network from a smaller one: more units, more blocks, the same values at first.

A new unit reads what its layer reads with random weights, as in a fresh network, and no old unit
reads it: those weights are 0. So the values do not change, and since the new units are not 0, the
first step of the optimiser already changes what reads them. A new block adds 0 to the features.

References
----------
Chen, Goodfellow, Shlens: Net2Net: Accelerating Learning via Knowledge Transfer, ICLR 2016, for the
idea; there units are copied, here they are new.
"""

from __future__ import annotations

from collections.abc import Collection

import torch
from torch import Tensor

from export.network import SuperSdfNet
from super_sdf.errors import OptionError

FUNCTIONS = "trunk.layers.4."  # the last layer of the trunk: a row for each coefficient


@torch.no_grad()
def grow_from(net: SuperSdfNet, weights: dict[str, Tensor]) -> None:
    """Give a fresh network the values of a smaller one, or of one of its sizes.

    OptionError if that has more blocks, or a layer of it more units.
    """
    blocks = len({name.split(".")[1] for name in weights if name.startswith("blocks.")})
    if blocks > net.config.blocks:
        raise OptionError(
            f"--start has a network of {blocks} blocks, more than the {net.config.blocks} of this "
            f"size: give --blocks {blocks}"
        )
    channels = len(weights["correction.weight"][0])
    for name, parameter in net.named_parameters():
        if name not in weights:
            if ".reduce." in name:  # of a new block
                parameter.zero_()
        elif name.startswith(FUNCTIONS):
            # the first rows belong to the channels, the rest to the units of the branch
            kept, moved = weights[name][:channels], weights[name][channels:]
            parameter.zero_()
            parameter[:channels] = kept
            parameter[net.config.channels : net.config.channels + len(moved)] = moved
        elif ".conv.weight" in name:
            places = net.blocks[0].conv.weight.shape[0] // net.config.channels
            by_place = parameter.view(places, -1, parameter.shape[1])
            place_units(by_place.mT, weights[name].view(places, channels, -1).mT, name)
        else:
            place_units(parameter, weights[name], name)


def without_blocks(weights: dict[str, Tensor], left_out: Collection[int]) -> dict[str, Tensor]:
    """Return weights without some blocks, counted from 0; those after them move up."""
    kept = {}
    for name, array in weights.items():
        kind, number, *rest = name.split(".")
        if kind != "blocks":
            kept[name] = array
        elif int(number) not in left_out:
            moved = int(number) - sum(block < int(number) for block in left_out)
            kept[".".join([kind, str(moved), *rest])] = array
    return kept


def place_units(new: Tensor, old: Tensor, name: str) -> None:
    """Write weights (..., outputs, inputs), or biases (outputs,), of the old units among the new.

    The old units read nothing from new ones.
    """
    if any(n < o for n, o in zip(new.shape, old.shape, strict=True)):
        raise OptionError(
            f"--start has a network whose {name} is {tuple(old.shape)}, more than the "
            f"{tuple(new.shape)} of this size: give a larger --size"
        )
    if new.ndim == 1:
        new[: len(old)] = old
        return
    outputs, inputs = old.shape[-2:]
    new[..., :outputs, :inputs] = old
    new[..., :outputs, inputs:] = 0
