"""Units that never react: found, counted, and started again while a network is trained.

A rectified unit whose input is negative for every voxel gives 0 and has no gradient: it is lost for
good. Neighbours' features have nearly the same mean, 27 times over, so that a step of the optimiser
moves a unit's input much farther up or down than its spread. Such dormant units are given new
incoming weights, centred on a batch so that they react to half of it, and outgoing weights of 0, so
that the network's values stay what they were.

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

from export.augment import Prepared
from export.network import Block, NeighbourConv, SuperSdfNet


@dataclass(frozen=True, eq=False)
class Rectified:
    """A layer before a rectifier, and where its units' weights are.

    ``incoming`` is (units, inputs), ``outgoing`` (units, outputs): views of the parameters, which
    are ``weight`` and ``reader``; ``first`` is the row of ``reader`` that belongs to unit 0.
    """

    layer: nn.Module
    weight: nn.Parameter
    reader: nn.Parameter
    units_first: bool  # in ``reader``: rows are units; else columns are
    first: int = 0

    @property
    def bias(self) -> nn.Parameter:
        """The units' biases, (units,)."""
        return self.layer.bias

    def incoming(self, array: Tensor) -> Tensor:
        """Return ``weight``, or what an optimiser keeps of it, as (units, inputs)."""
        return array.T if isinstance(self.layer, NeighbourConv) else array

    def outgoing(self, array: Tensor) -> Tensor:
        """Return the units' part of ``reader``, or of what an optimiser keeps of it."""
        rows = array if self.units_first else array.T
        return rows[self.first : self.first + len(self.bias)]


def rectified_layers(net: SuperSdfNet) -> list[Rectified]:
    """Return the layers of a network that a rectifier follows; of variants, those as in ours."""
    first, _, second = net.stem
    layers = [Rectified(first, first.weight, second.weight, False)]
    for block in net.modules():
        if type(block) is Block:  # others may have rectifiers of another kind, or elsewhere
            layers.append(Rectified(block.conv, block.conv.weight, block.expand.weight, False))
            layers.append(Rectified(block.expand, block.expand.weight, block.reduce.weight, False))
    if type(net).residual is SuperSdfNet.residual:
        functions, channels = net.trunk.layers[-1].weight, net.config.channels
        layers.append(Rectified(net.branch, net.branch.weight, functions, True, channels))
    return layers


@contextmanager
def watching(layers: Sequence[Rectified]) -> Iterator[list[Tensor]]:
    """Yield a list that holds, for each layer, the inputs of its rectifier in the last pass."""
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
def reacting(net: SuperSdfNet, batches: Sequence[Sequence[Prepared]]) -> list[Tensor]:
    """Return, for each rectified layer, which of its units react to any voxel, (units,) bool."""
    layers = rectified_layers(net)
    found = [torch.zeros_like(entry.bias, dtype=torch.bool) for entry in layers]
    with watching(layers) as seen:
        for batch in batches:
            net.decode(net.encode_batch(batch), torch.zeros(1, 3, device=found[0].device))
            for known, inputs in zip(found, seen):
                known |= (inputs > 0).any(0)
    return found


def dormant_share(net: SuperSdfNet, batches: Sequence[Sequence[Prepared]]) -> float:
    """Return the share of rectified units that react to no voxel of these samples."""
    return 1 - float(torch.cat(reacting(net, batches)).float().mean())


@torch.no_grad()
def revive(
    net: SuperSdfNet,
    optimisers: Sequence[torch.optim.Optimizer],
    batches: Sequence[Sequence[Prepared]],
) -> int:
    """Start the units that react to no voxel of these samples again; return how many.

    Their values on other samples change by what they gave there, which is little: they are rare.
    """
    layers, known = rectified_layers(net), reacting(net, batches)
    asleep = [torch.nonzero(~units)[:, 0] for units in known]
    for entry, units in zip(layers, asleep):
        restart(entry, units, optimisers)
    with watching(layers) as seen:
        net.decode(net.encode_batch(batches[0]), torch.zeros(1, 3, device=layers[0].bias.device))
        for entry, units, inputs in zip(layers, asleep, seen):
            entry.bias[units] -= inputs[:, units].float().mean(0)
    return sum(map(len, asleep))


def restart(entry: Rectified, units: Tensor, optimisers: Sequence[torch.optim.Optimizer]) -> None:
    """Give units of a layer weights as those of the others are, read by nobody yet."""
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
    """Return the running means of the gradient that an optimiser keeps of a parameter."""
    kept = optimiser.state.get(parameter, {})
    return [array for array in kept.values() if getattr(array, "shape", ()) == parameter.shape]
