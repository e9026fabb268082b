"""Dormant units, which never react: finding, counting and restarting them during training.

A rectified unit whose input is negative for every voxel returns 0 and has no gradient: it never
recovers. The features of all 27 neighbours have nearly the same mean, so a step of the optimiser
may shift the input of a unit by much more than its spread. Dormant units get new incoming weights,
centred on a batch so that they react to half of it, and outgoing weights of 0, so that the values
of the network do not change.

References
----------
Sokar, Agarwal, Castro, Evci: The Dormant Neuron Phenomenon in Deep Reinforcement Learning, 2023.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from export.batches import Batch, encode
from export.network import NeighbourConv, SuperSdfNet


@dataclass(frozen=True, eq=False)
class Rectified:
    """A layer followed by a rectifier, and the weights into and out of its units.

    ``incoming`` (units, inputs) and ``outgoing`` (units, outputs) are views of the parameters
    ``weight`` and ``reader``; row ``first`` of ``reader`` belongs to unit 0.
    """

    layer: nn.Module
    weight: nn.Parameter
    reader: nn.Parameter
    units_first: bool  # whether rows of ``reader`` are units; else columns are
    first: int = 0

    @property
    def bias(self) -> nn.Parameter:
        return self.layer.bias

    def incoming(self, array: Tensor) -> Tensor:
        """Return ``weight``, or an optimiser's state for it, as (units, inputs)."""
        return array.T if isinstance(self.layer, NeighbourConv) else array

    def outgoing(self, array: Tensor) -> Tensor:
        """Return the units' part of ``reader``, or of an optimiser's state for it."""
        rows = array if self.units_first else array.T
        return rows[self.first : self.first + len(self.bias)]


def rectified_layers(net: SuperSdfNet) -> list[Rectified]:
    """Return the layers that a rectifier follows."""
    first, _, second = net.stem
    layers = [Rectified(first, first.weight, second.weight, False)]
    for block in net.all_blocks():
        layers.append(Rectified(block.conv, block.conv.weight, block.expand.weight, False))
        layers.append(Rectified(block.expand, block.expand.weight, block.reduce.weight, False))
    if net.config.gated:
        first, _, second = net.gate.layers
        layers.append(Rectified(first, first.weight, second.weight, False))
    functions, channels = net.trunk.layers[-1].weight, net.config.channels
    return [*layers, Rectified(net.branch, net.branch.weight, functions, True, channels)]


@contextmanager
def watching(layers: Sequence[Rectified]) -> Iterator[list[Tensor]]:
    """Yield a list with the inputs of each layer's rectifier in the last forward pass."""
    seen: list[Tensor] = [torch.empty(0) for _ in layers]

    def keep(number: int) -> Any:
        return lambda module, given, made: seen.__setitem__(number, made.detach())

    hooks = [entry.layer.register_forward_hook(keep(n)) for n, entry in enumerate(layers)]
    try:
        yield seen
    finally:
        for hook in hooks:
            hook.remove()


@torch.no_grad()
def reacting(net: SuperSdfNet, batches: Sequence[Batch]) -> list[Tensor]:
    """Return, for each rectified layer, which of its units react to any voxel, (units,) bool."""
    layers = rectified_layers(net)
    found = [torch.zeros_like(entry.bias, dtype=torch.bool) for entry in layers]
    with watching(layers) as seen:
        for batch in batches:
            net.decode(encode(net, batch), torch.zeros(1, 3, device=found[0].device))
            for known, inputs in zip(found, seen):
                known |= (inputs > 0).any(0)
    return found


def dormant_share(net: SuperSdfNet, batches: Sequence[Batch]) -> float:
    return 1 - float(torch.cat(reacting(net, batches)).float().mean())


@torch.no_grad()
def revive(
    net: SuperSdfNet,
    optimisers: Sequence[torch.optim.Optimizer],
    batches: Sequence[Batch],
) -> int:
    """Restart the units that react to no voxel of these samples; return their number.

    On other samples the network's values change by the contribution of these units, which is small
    because they react rarely.
    """
    layers = rectified_layers(net)
    asleep = [torch.nonzero(~units)[:, 0] for units in reacting(net, batches)]
    for entry, units in zip(layers, asleep):
        restart(entry, units, optimisers)
    with watching(layers) as seen:
        net.decode(encode(net, batches[0]), torch.zeros(1, 3, device=layers[0].bias.device))
        for entry, units, inputs in zip(layers, asleep, seen):
            entry.bias[units] -= inputs[:, units].float().mean(0)
    return sum(map(len, asleep))


def restart(entry: Rectified, units: Tensor, optimisers: Sequence[torch.optim.Optimizer]) -> None:
    """Give units of a layer random incoming weights and outgoing weights of 0."""
    incoming, outgoing = entry.incoming(entry.weight), entry.outgoing(entry.reader)
    incoming[units] = torch.randn_like(incoming[units]) * incoming.std()
    entry.bias[units] = 0
    outgoing[units] = 0
    for optimiser in optimisers:
        for parameter, part in ((entry.weight, entry.incoming), (entry.reader, entry.outgoing)):
            for kept in moments(optimiser, parameter):
                part(kept)[units] = 0
        for kept in moments(optimiser, entry.bias):
            kept[units] = 0


def moments(optimiser: torch.optim.Optimizer, parameter: nn.Parameter) -> list[Tensor]:
    """Return the running means of the gradient that an optimiser keeps for a parameter."""
    kept = optimiser.state.get(parameter, {})
    return [array for array in kept.values() if getattr(array, "shape", ()) == parameter.shape]
