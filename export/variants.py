"""Other networks with the same contract, for the comparison with ours (``compare``)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from export.augment import Prepared, batch_table
from export.network import (
    Block,
    Encoded,
    NeighbourConv,
    NetworkConfig,
    SuperSdfNet,
    Trunk,
    gather,
    interpolation_weights,
    is_noisy,
)
from super_sdf.neighbourhood import NEIGHBOURHOOD
from super_sdf.steps.band import neighbour_table

AXES = tuple(np.flatnonzero((np.delete(NEIGHBOURHOOD, axis, 1) == 0).all(1)) for axis in range(3))


# How a block reads the neighbours.


class AxesBlock(Block):
    """Three convolutions of three voxels, along x, y and z."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.conv = nn.ModuleList(NeighbourConv(config.channels, 3) for _ in AXES)

    def mix(self, features: Tensor, table: Tensor) -> Tensor:
        """Convolve along one axis after the other."""
        for conv, places in zip(self.conv, AXES):
            features = torch.relu(conv(features, table[:, places].contiguous()))
        return features


class BottleneckBlock(Block):
    """Convolves half as many channels."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        half = config.channels // 2
        self.down = nn.Linear(config.channels, half)
        self.conv = NeighbourConv(half)
        self.expand = nn.Linear(half, config.hidden)

    def mix(self, features: Tensor, table: Tensor) -> Tensor:
        """Convolve the reduced features."""
        return torch.relu(self.conv(torch.relu(self.down(features)), table))


class LinearMixBlock(Block):
    """One rectifier instead of two: none between the convolution and the pointwise layer."""

    def mix(self, features: Tensor, table: Tensor) -> Tensor:
        """Apply the neighbour convolution without a rectifier."""
        return self.conv(features, table)


class LeakyBlock(Block):
    """Leaky rectifiers of slope 0.1, so that every unit has a gradient."""

    def activate(self, values: Tensor) -> Tensor:
        """Apply the leaky rectifier."""
        return torch.nn.functional.leaky_relu(values, 0.1)


class SiluBlock(Block):
    """Smooth rectifiers: ``x sigmoid(x)``."""

    def activate(self, values: Tensor) -> Tensor:
        """Apply the smooth rectifier."""
        return torch.nn.functional.silu(values)


class NormBlock(Block):
    """Normalises the features by their root mean square over the channels first."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.norm = nn.RMSNorm(config.channels)

    def mix(self, features: Tensor, table: Tensor) -> Tensor:
        """Convolve the normalised features."""
        return super().mix(self.norm(features.float()), table)


class PointBlock(Block):
    """Uses the patch of the voxel only, not the neighbours."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.conv = nn.Linear(config.channels, config.channels)

    def mix(self, features: Tensor, table: Tensor) -> Tensor:
        """Apply a pointwise layer."""
        return torch.relu(self.conv(features))


class BlockNet(SuperSdfNet):
    """Ours with blocks of another kind."""

    def __init__(self, config: NetworkConfig, kind: type[Block]) -> None:
        super().__init__(config)
        self.blocks = nn.ModuleList(kind(config) for _ in range(config.blocks))


class DilatedNet(SuperSdfNet):
    """Every other block is dilated: it reads the neighbour of the neighbour in each direction."""

    def encode(self, patches: Tensor, table: Tensor) -> Tensor:
        """Map patches (V, 27) and neighbours (V, 27; V where absent) to features (V, C)."""
        ended = torch.cat([table, torch.full_like(table[:1], len(table))]).long()
        far = torch.stack([ended[ended[:-1, k], k] for k in range(27)], 1).int()
        features = self.stem(patches)
        for number, block in enumerate(self.blocks):
            features = block(features, far if number % 2 else table)
        return features


class WidePatchNet(SuperSdfNet):
    """Reads the patches of all 27 neighbours: 5x5x5 samples, the inner ones repeatedly."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.stem[0] = nn.Linear(27 * 27, config.hidden)

    def encode(self, patches: Tensor, table: Tensor) -> Tensor:
        """Map patches (V, 27) and neighbours (V, 27; V where absent) to features (V, C)."""
        return super().encode(gather(patches, table), table)


class UNet(SuperSdfNet):
    """The paper's shape: two coarser levels, of half the resolution each, and skips between.

    A coarse voxel is the mean of up to eight children; two blocks work on each level on the way
    down and two on the way up.
    """

    LEVELS = 2

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        channels = config.channels
        self.downs = nn.ModuleList(nn.Linear(channels, channels) for _ in range(self.LEVELS))
        self.ups = nn.ModuleList(nn.Linear(channels, channels) for _ in range(self.LEVELS))
        self.coarse = nn.ModuleList(Block(config) for _ in range(4 * self.LEVELS - 2))

    def encode_batch(self, batch: Sequence[Prepared]) -> Encoded:
        """Encode a batch of samples, concatenated."""
        patches = torch.from_numpy(np.concatenate([sample.patches for sample in batch]))
        tables, parents = self.levels(batch)
        features = self.descend(self.stem(patches), tables, parents, list(self.coarse), 0)
        return Encoded(features, patches, is_noisy(patches, tables[0]))

    def levels(self, batch: Sequence[Prepared]) -> tuple[list[Tensor], list[Tensor]]:
        """Return the neighbour table of each level, and the parents of all but the coarsest."""
        ijk, tables = [sample.ijk for sample in batch], [sample.table for sample in batch]
        levels, parents = [torch.from_numpy(batch_table(tables))], []
        for _ in range(self.LEVELS):
            ijk, rows, tables = zip(*map(coarsen, ijk))
            parents.append(torch.from_numpy(join_parents(rows, tables)))
            levels.append(torch.from_numpy(batch_table(tables)))
        return levels, parents

    def forward(
        self, patches: Tensor, table: Tensor, voxels: Tensor, offsets: Tensor, *coarser: Tensor
    ) -> Tensor:
        """Return the values (D, Q); the coarser tables and all parents are further inputs."""
        table = torch.where(table < 0, len(patches), table)
        tables, parents = [table, *coarser[: self.LEVELS]], list(coarser[self.LEVELS :])
        features = self.descend(self.stem(patches), tables, parents, list(self.coarse), 0)
        encoded = Encoded(features, patches, is_noisy(patches, table))
        return self.decode(encoded.some(voxels), offsets)

    def descend(
        self, features: Tensor, tables: list[Tensor], parents: list[Tensor], blocks: list, at: int
    ) -> Tensor:
        """Process a level and, between its blocks, the coarser levels."""
        own = list(self.blocks) if at == 0 else [blocks.pop() for _ in range(2)]
        half = len(own) // 2 if at == 0 else len(own)
        for block in own[:half]:
            features = block(features, tables[at])
        if at == self.LEVELS:
            return features
        below = mean_of_children(self.downs[at](features), parents[at], len(tables[at + 1]))
        below = self.descend(below, tables, parents, blocks, at + 1)
        features = features + self.ups[at](below)[parents[at].long()]
        rest = own[half:] if at == 0 else [blocks.pop() for _ in range(2)]
        for block in rest:
            features = block(features, tables[at])
        return features


def coarsen(ijk: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the voxels of twice the side, the parent of each voxel, the coarse neighbours."""
    half = (ijk - ijk.min(0)) >> 1
    coarse, rows = np.unique(half, axis=0, return_inverse=True)
    coarse = coarse.astype(np.int32)
    shape = tuple(int(n) for n in coarse.max(0) + 1)
    return coarse, rows.ravel(), neighbour_table(coarse, shape)


def join_parents(rows: Sequence[np.ndarray], tables: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenate the parents of samples."""
    starts = np.cumsum([0] + [len(table) for table in tables])
    return np.concatenate([row + start for row, start in zip(rows, starts)])


def mean_of_children(features: Tensor, parents: Tensor, count: int) -> Tensor:
    """Return the mean over the children of each parent, (count, C)."""
    # A column of ones counts the children.
    marked = torch.cat([features.float(), features.new_ones(len(features), 1).float()], 1)
    rows = parents[:, None].expand(-1, marked.shape[1])
    total = torch.zeros(count, marked.shape[1]).scatter_add(0, rows, marked)
    return total[:, :-1] / total[:, -1:]


# How the head turns features into values.


class BlockHead(SuperSdfNet):
    """Predicts the 125 values of K = 4 directly; other offsets get the nearest node's value."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.branch = nn.Sequential(
            nn.Linear(config.channels, 2 * config.channels),
            nn.ReLU(),
            nn.Linear(2 * config.channels, 125),
        )

    def residual(self, features: Tensor, offsets: Tensor) -> Tensor:
        """Return the residual over the interpolation, (D, Q); 0 at the sample."""
        nodes = ((offsets + 1) * 2).round().long()
        block = self.branch(features).float()
        return block[:, nodes @ torch.tensor([25, 5, 1])] - block[:, 62:63]


class QueryHead(SuperSdfNet):
    """Runs a small network for every pair of voxel and offset."""

    WIDTH = 64

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.branch = nn.Linear(config.channels, self.WIDTH)
        self.trunk = Trunk(NetworkConfig(functions=self.WIDTH))
        self.last = nn.Sequential(
            nn.ReLU(), nn.Linear(self.WIDTH, self.WIDTH), nn.ReLU(), nn.Linear(self.WIDTH, 1)
        )

    def residual(self, features: Tensor, offsets: Tensor) -> Tensor:
        """Return the residual over the interpolation, (D, Q); 0 at the sample."""
        voxels = self.branch(features)[:, None]
        at_offsets = self.last(voxels + self.trunk(offsets)[None])
        return (at_offsets - self.last(voxels)).squeeze(2).float()


class DeepBranch(SuperSdfNet):
    """A hidden layer before the coefficients."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        hidden = config.functions
        self.branch = nn.Sequential(
            nn.Linear(config.channels, hidden), nn.ReLU(), nn.Linear(hidden, hidden)
        )

    def residual(self, features: Tensor, offsets: Tensor) -> Tensor:
        """Return the residual over the interpolation, (D, Q); 0 at the sample."""
        return self.branch(features).float() @ self.trunk(offsets).float().T


class PlanesHead(SuperSdfNet):
    """Adds ramps that bend along learnt planes, as distances do at an edge."""

    PLANES = 16

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.planes = nn.Linear(config.channels, 5 * self.PLANES)

    def residual(self, features: Tensor, offsets: Tensor) -> Tensor:
        """Return the residual over the interpolation, (D, Q); 0 at the sample."""
        planes = self.planes(features).float().view(len(features), self.PLANES, 5)
        normal, shift, height = planes.split([3, 1, 1], 2)
        ramps = torch.relu(normal @ offsets.T + shift) - torch.relu(shift)
        return super().residual(features, offsets) + (height.transpose(1, 2) @ ramps)[:, 0]


# The interpolation that the network adds a residual to.


class TrilinearBase(SuperSdfNet):
    """Residual over trilinear interpolation."""

    def base(self, patches: Tensor, offsets: Tensor) -> Tensor:
        """Return the interpolation, (D, Q)."""
        at = offsets / 2
        axis = torch.stack([(-at).clamp(min=0), 1 - at.abs(), at.clamp(min=0)], 2)
        x, y, z = axis.unbind(1)
        weights = x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]
        return patches @ weights.flatten(1).T


class SampleBase(SuperSdfNet):
    """Residual over the sample."""

    def base(self, patches: Tensor, offsets: Tensor) -> Tensor:
        """Return the sample at every offset, (D, Q)."""
        return patches @ interpolation_weights(torch.zeros_like(offsets)).T
