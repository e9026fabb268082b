"""The network: voxels are encoded once, then decoded at any offsets.

    patches (V, 27), neighbour table (V, 27) -> features (V, C)          the encoder
    features of D voxels, offsets (Q, 3)     -> values (D, Q)            the head

The encoder is a stem on the 27 samples and a stack of residual blocks, each a convolution over
27, 19 or 7 neighbours (a gather and a matrix product) and a pointwise layer. The head is a branch
and a trunk: coefficients per voxel times functions of the offset. It adds a residual to the
quadratic interpolation of the patch. All lengths are in half voxels (Eqs. 4 and 5).

A network may be gated: its last blocks run only on the voxels on which much is still lost after the
first ones, as a gate says. Neighbours stay as they are there. The head gets all other voxels from a
block of their own, so that the first blocks need not please both.
The decision is local, so a voxel's values depend on nothing beyond the receptive field.

Interpolation and functions keep the value of the sample (Sec. 4.1). A noisy sample should not be
kept, so there is also a correction of the whole voxel. It is 0 where all samples around the voxel
can be distances. The distances of a mask are right to half a voxel only, and none is kept.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from super_sdf.arrays import CENTRE, NEIGHBOURHOOD
from super_sdf.refine import band


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the network."""

    channels: int = 64
    blocks: int = 8  # receptive field: blocks + 1 voxels in each direction
    hidden: int = 128
    functions: int = 256  # of the offset, in the head
    trunk: int = 128
    frequencies: int = 4
    keeps_samples: bool = True  # the sample's value, where it can be a distance; not with masks
    gated: int = 0  # of the blocks, the last ones, that run only where the gate is open
    wide: int = 0  # inputs of a voxel besides its patch: of masks the ``WIDE`` ones
    places: tuple[int, ...] = ()  # that each of ``all_blocks`` sees; all 27 if nothing is given
    seen: int = 0  # channels, the first ones, that blocks before the gated ones see; 0 for all

    @property
    def receptive_field(self) -> int:
        return self.blocks + 1


WIDE = 2  # of masks, ``grid.derived.wide_distances``
SIZES = {
    "fast": NetworkConfig(blocks=4, functions=192),
    "base": NetworkConfig(
        channels=96,
        blocks=11,
        hidden=192,
        functions=320,
        gated=6,
        places=(19,) * 5 + (7,) * 7,
        seen=64,
    ),
    "noisy": NetworkConfig(blocks=5, places=(19,) * 5),
    "mask": NetworkConfig(blocks=7, keeps_samples=False, wide=WIDE),
}
"""The sizes of the shipped networks, by name."""


PLACES = {
    n: np.flatnonzero(np.abs(NEIGHBOURHOOD).sum(1) <= k) for k, n in enumerate((7, 19, 27), 1)
}
"""Which of the 27 places a block sees, by their number: without corners, or the faces only."""

CHUNK = 1024  # voxels gathered at a time on a CPU, so that their columns stay in cache


class GatherMatMul(torch.autograd.Function):
    """The columns of features times a weight, differentiated without a scatter.

    If u is v's neighbour at place k of n, then v is u's at place n - 1 - k. So the gradient is a
    convolution, too, with the places reversed, and no scatter-add is needed. The columns are
    gathered again for it: at 27 times the features they would fill the memory.

    The table may also name voxels after the V of its rows: those that are given as ``around``,
    which get no gradient.
    """

    @staticmethod
    def forward(ctx, features: Tensor, weight: Tensor, table: Tensor, around: Tensor) -> Tensor:
        """Map features (V, C), weight (n C, C_out) and table (V, n) to (V, C_out)."""
        ctx.save_for_backward(features, weight, table, around)
        return convolve(torch.cat([features, around]), weight, table)

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, None, None]:
        """Map the gradient (V, C_out) to the gradients of features and weight."""
        features, weight, table, around = ctx.saved_tensors
        reversed_weight = weight.view(table.shape[1], -1, weight.shape[1]).flip(0).transpose(1, 2)
        of_features = convolve(
            grad, reversed_weight.reshape(-1, features.shape[1]), table.clamp(max=len(grad))
        )
        dtype = torch.promote_types(grad.dtype, torch.float32)
        of_weight = torch.zeros(weight.shape[1], len(weight), dtype=dtype, device=grad.device)
        for part, columns in gathered(torch.cat([features, around]), table):
            of_weight += grad[part].T @ columns  # a third faster than columns.T @ grad[part]
        return of_features, of_weight.T.to(grad.dtype), None, None


def convolve(features: Tensor, weight: Tensor, table: Tensor) -> Tensor:
    """Return the columns of features times a weight, (V, C_out), without all columns at once."""
    out = features.new_empty(len(table), weight.shape[1])
    for part, columns in gathered(features, table):
        torch.mm(columns, weight, out=out[part])
    return out


def gathered(features: Tensor, table: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Yield the rows that a table (V, n) names side by side, (m, n C), and which voxels they are.

    A row of zeros stands for an absent voxel. On a GPU they come all at once.
    """
    padded = torch.cat([features, features.new_zeros(1, features.shape[1])])
    rows = CHUNK if features.device.type == "cpu" else max(len(table), 1)
    for start in range(0, len(table), rows):
        part = slice(start, start + rows)
        indices = table[part].reshape(-1)
        if padded.is_cuda:
            from export.gpu_gather import gather_rows  # only CUDA builds of PyTorch have Triton

            columns = gather_rows(padded, indices)
        else:
            columns = padded.index_select(0, indices)
        yield part, columns.view(-1, table.shape[1] * features.shape[1])


class NeighbourConv(nn.Module):
    """A sparse convolution over the band: of some of the 27 places it sees some channels."""

    def __init__(self, channels: int, places: int, seen: int) -> None:
        super().__init__()
        self.places, self.seen, rows = places, seen, places * seen
        self.weight = nn.Parameter(torch.randn(rows, channels) / rows**0.5)
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, features: Tensor, table: Tensor, around: Tensor | None = None) -> Tensor:
        """Map (V, C) to (V, C); ``around`` (N, C) are other voxels that the table names."""
        dtype = torch.bfloat16 if torch.is_autocast_enabled(features.device.type) else torch.float32
        if self.places < table.shape[1]:
            table = table[:, PLACES[self.places]]
        others = (features[:0] if around is None else around).detach()
        some = (given[:, : self.seen].to(dtype) for given in (features, others))
        mixed = GatherMatMul.apply(next(some), self.weight.to(dtype), table, next(some))
        return mixed + self.bias.to(dtype)


class Block(nn.Module):
    """A residual block: neighbour convolution, then a pointwise layer; starts as the identity."""

    def __init__(self, config: NetworkConfig, places: int, seen: int) -> None:
        super().__init__()
        self.conv = NeighbourConv(config.channels, places, seen)
        self.expand = nn.Linear(config.channels, config.hidden)
        self.reduce = nn.Linear(config.hidden, config.channels)
        nn.init.normal_(self.reduce.weight, std=0.02)
        nn.init.zeros_(self.reduce.bias)

    def forward(self, features: Tensor, table: Tensor, *around: Tensor) -> Tensor:
        """Map (V, C) to (V, C)."""
        mixed = torch.relu(self.conv(features, table, *around))
        return features + self.reduce(torch.relu(self.expand(mixed)))


class Trunk(nn.Module):
    """Functions of the offset that vanish at the sample, so that the sample itself is kept."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        waves = torch.pi / 2 * 2.0 ** torch.arange(config.frequencies)
        self.register_buffer("waves", waves, persistent=False)
        self.layers = nn.Sequential(
            nn.Linear(3 + 6 * config.frequencies, config.trunk),
            nn.SiLU(),
            nn.Linear(config.trunk, config.trunk),
            nn.SiLU(),
            nn.Linear(config.trunk, config.functions),
        )
        nn.init.normal_(self.layers[-1].weight, std=0.3 / config.trunk**0.5)

    def forward(self, offsets: Tensor) -> Tensor:
        """Map (Q, 3) to (Q, functions)."""
        return self.raw(offsets) - self.raw(torch.zeros_like(offsets[:1]))

    def raw(self, offsets: Tensor) -> Tensor:
        angles = (offsets[:, :, None] * self.waves).flatten(1)
        return self.layers(torch.cat([offsets, angles.sin(), angles.cos()], 1))


class Gate(nn.Module):
    """Says how much is lost on a voxel after the first blocks: the logarithm of its loss.

    It is open where that is more than the threshold, unless the voxel cannot hold the surface.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(config.channels, config.hidden), nn.ReLU(), nn.Linear(config.hidden, 1)
        )
        self.register_buffer("threshold", torch.zeros(1))

    def forward(self, features: Tensor) -> Tensor:
        """Map (V, C) to (V,)."""
        with in_float32(features):
            return self.layers(features.float())[:, 0]

    @torch.no_grad()
    def rows(self, doubts: Tensor, patches: Tensor, share: float | None = None) -> Tensor:
        """Return the rows of the voxels where it is open, (n,).

        With ``share`` that share of the voxels exceeds the threshold, and the kept threshold moves
        a little to that which ``USUAL_SHARE`` exceeds.
        """
        near = patches[:, CENTRE].abs() <= band.DECODE_LIMIT
        threshold = self.threshold
        if share is not None:
            shares = doubts.new_tensor([1 - share, 1 - USUAL_SHARE])
            threshold, usual = doubts[near].quantile(shares)
            self.threshold.lerp_(usual, 0.01)
        return torch.nonzero(near & (doubts > threshold))[:, 0]


USUAL_SHARE = 0.3  # of the voxels that can hold the surface: those that the last blocks run on


@dataclass(frozen=True)
class Encoded:
    """The inputs of the head for each voxel; of a gated network also what the first blocks say."""

    features: Tensor  # (V, C)
    patches: Tensor  # (V, 27 or more)
    noisy: Tensor  # (V, 1) of 0 and 1
    early: Tensor | None = None  # (V, C) features after the block for voxels that go no deeper
    doubts: Tensor | None = None  # (V,) logarithm of what is lost with these

    def some(self, rows: Tensor) -> Encoded:
        return Encoded(*(None if all_ is None else all_[rows] for all_ in vars(self).values()))


def is_noisy(patches: Tensor, table: Tensor) -> Tensor:
    """Return 1 for voxels whose own or a neighbour's patch cannot be distances, else 0, (V, 1).

    In such a patch two samples differ by more than their distance, as in
    ``refine.band.is_lipschitz``.
    """
    excess = (patches[:, :27] - patches[:, CENTRE, None]).abs() - patches.new_tensor(
        band.MAX_DIFFERENCE
    )
    most = torch.cat([excess.amax(1), patches.new_zeros(1)])
    return (most[table].amax(1, keepdim=True) > 0).float()


class SuperSdfNet(nn.Module):
    """The whole network; its inputs and output are those of the ONNX file."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.stem = nn.Sequential(
            nn.Linear(27 + config.wide, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, config.channels),
        )
        places = config.places or [27] * (config.blocks + 1)
        first, channels = config.blocks - config.gated, config.channels
        seen = [config.seen or channels] * first + [channels] * config.gated
        self.blocks = nn.ModuleList(Block(config, *pair) for pair in zip(places, seen))
        if config.gated:
            self.early = Block(config, places[config.blocks], channels)
            self.gate = Gate(config)
        self.branch = nn.Linear(config.channels, config.functions - config.channels)
        self.correction = nn.Linear(config.channels, 1)
        self.trunk = Trunk(config)

    def encode(self, patches: Tensor, table: Tensor) -> Tensor:
        """Map patches (V, 27) and neighbours (V, 27; V where absent) to features (V, C).

        Of a gated network these are the features after the first blocks.
        """
        with in_float32(patches):  # then the sums of the blocks are, too
            features = self.stem(patches)
        for block in self.blocks[: self.config.blocks - self.config.gated]:
            features = block(features, table)
        return features

    def deepen(self, features: Tensor, table: Tensor, rows: Tensor) -> Tensor:
        """Return the features of some voxels, (n,), after the last blocks, (n, C).

        All others stay as they are in ``features`` (V, C).
        """
        count = len(features)
        place = torch.arange(count + 1, device=rows.device) + len(rows)
        place[rows] = torch.arange(len(rows), device=rows.device)
        near, some = place[table[rows]], features[rows]
        for block in self.blocks[self.config.blocks - self.config.gated :]:
            some = block(some, near, features)
        return some

    def encode_all(self, patches: Tensor, table: Tensor, share: float | None = None) -> Encoded:
        """Encode voxels; return all inputs of the head. For ``share`` see ``Gate.rows``."""
        noisy = is_noisy(patches, table)
        if not self.config.keeps_samples:
            noisy = torch.ones_like(noisy)
        first = self.encode(patches, table)
        if not self.config.gated:
            return Encoded(first, patches, noisy)
        early = self.early(first, table)
        doubts = self.gate(early.detach())
        rows = self.gate.rows(doubts, patches, share)
        features = early.index_copy(0, rows, self.deepen(first, table, rows))
        return Encoded(features, patches, noisy, early, doubts)

    def all_blocks(self) -> nn.ModuleList:
        return nn.ModuleList([*self.blocks, *([self.early] if self.config.gated else [])])

    def decode(self, voxels: Encoded, counts: list[int], offsets: Tensor) -> Tensor:
        """Return the values (D, Q) of samples side by side, each at its offsets, (B, Q, 3).

        Of the D voxels the first ``counts[0]`` are of the first sample, and so on.
        """
        with in_float32(offsets):
            features, at = voxels.features.float(), offsets.flatten(0, 1)
            branch = torch.relu(self.branch(features))
            inputs = torch.cat([features, branch, voxels.patches[:, :27]], 1)
            functions = torch.cat([self.trunk(at), interpolation_weights(at)], 1)
            parts = zip(inputs.split(counts), functions.view(*offsets.shape[:2], -1))
            values = torch.cat([some @ weights.T for some, weights in parts])
            return values + self.correction(features) * voxels.noisy

    def forward(self, patches: Tensor, table: Tensor, voxels: Tensor, offsets: Tensor) -> Tensor:
        """Return the values (D, Q) of the voxels (D,) at the offsets (Q, 3)."""
        table = torch.where(table < 0, len(patches), table)  # index of the row of zeros
        encoded = self.encode_all(patches, table).some(voxels)
        return self.decode(encoded, [len(voxels)], offsets[None])


@torch.no_grad()
def in_basis(net: SuperSdfNet, basis: Tensor, inverse: Tensor) -> SuperSdfNet:
    """Return a network with the same values, whose features are ``basis`` (C, C) times those given.

    The basis must not mix channels that a block sees with others.
    """
    net, count = copy.deepcopy(net), len(basis)
    for block in net.all_blocks():
        of_seen = inverse[: block.conv.seen, : block.conv.seen].T
        given = block.conv.weight.view(block.conv.places, block.conv.seen, count)
        block.conv.weight.copy_((of_seen @ given).flatten(0, 1))
    for layer in (net.stem[2], *(block.reduce for block in net.all_blocks())):
        layer.weight.copy_(basis @ layer.weight)
        layer.bias.copy_(basis @ layer.bias)
    gates = [net.gate.layers[0]] if net.config.gated else []
    for layer in (net.branch, net.correction, *gates):
        layer.weight.copy_(layer.weight @ inverse)
    last = net.trunk.layers[-1]
    last.weight[:count] = inverse.T @ last.weight[:count]
    last.bias[:count] = inverse.T @ last.bias[:count]
    return net


def in_float32(given: Tensor) -> torch.autocast:
    """Return the context in which nothing is cast: stem and head are small, and see distances.

    In bfloat16 a distance of a voxel is right to a 250th of a voxel only.
    """
    return torch.autocast(given.device.type, enabled=False)


def interpolation_weights(offsets: Tensor) -> Tensor:
    """Return the weights (Q, 27) of quadratic interpolation in the patch, in its (C) order.

    Along each axis a parabola passes through the three samples at -1, 0 and 1 voxels; the product
    over the axes keeps the value of the sample and reproduces linear functions exactly.
    """
    at = offsets / 2
    axis = torch.stack([at * (at - 1) / 2, 1 - at * at, at * (at + 1) / 2], 2)
    x, y, z = axis.unbind(1)
    return (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).flatten(1)
