"""Samples kept in the memory of a GPU, which turns them and makes batches of them itself.

On a CPU a step of training takes longer than to change, turn and gather its samples. On a GPU it
is the other way round. So every sample is gathered once, by a process of its own, as it is and in
some cases also changed (``augment``), and stays on the device. A batch is drawn from what is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from export.augment import Prepared
from export.batches import Batch, copies_of_queries, neighbours_with_targets
from export.dataset import ANYWHERE, CORNERS, FINE_NODES
from super_sdf.network.symmetry import cube_symmetries, turned_places

# A corner and its three neighbours have at most 8 + 3 * 4 copies (``dataset.draw_offsets``).
MOST_COPIES = 20 * CORNERS + 8 * FINE_NODES + ANYWHERE


class Rows:
    """An array on a device that rows are appended to."""

    def __init__(self, device: str) -> None:
        self.device, self.count = device, 0
        self.held: Tensor | None = None

    def append(self, rows: np.ndarray) -> None:
        """Append rows (n, ...)."""
        new = torch.from_numpy(np.ascontiguousarray(rows)).to(self.device)
        if self.held is None:
            self.held = new
        end = self.count + len(new)
        if end > len(self.held):
            room = self.held.new_empty(3 * end // 2 - self.count, *self.held.shape[1:])
            self.held = torch.cat([self.held[: self.count], room])
        self.held[self.count : end] = new
        self.count = end

    def __getitem__(self, rows: Tensor) -> Tensor:
        """Return some rows."""
        assert self.held is not None
        return self.held[rows]


@dataclass(frozen=True, eq=False)
class Gathered:
    """Samples one after the other, as they are kept."""

    arrays: dict[str, np.ndarray]
    band_counts: np.ndarray  # voxels of the band of each sample, (N,)
    counts: np.ndarray  # of them, those with targets, (N,)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.counts)


def gather_samples(samples: Sequence[Prepared]) -> Gathered:
    """Gather samples, each with at least one voxel that has targets.

    Raises
    ------
    ValueError
        If queries have more copies than there is room for.
    """
    each = [arrays_of(sample) for sample in samples]
    return Gathered(
        {name: np.concatenate([arrays[name] for arrays in each]) for name in each[0]},
        np.array([len(sample.patches) for sample in samples], np.int64),
        np.array([len(sample.voxels) for sample in samples], np.int64),
    )


class Residents:
    """The samples on a device."""

    def __init__(self, device: str) -> None:
        self.device = device
        names = ["patches", "table", "voxels", "near", "targets", "query", "place", "moved"]
        self.arrays = {name: Rows(device) for name in names}
        self.band_counts = np.zeros(0, np.int64)  # voxels of the band of each sample
        self.counts = np.zeros(0, np.int64)  # of them, those with targets
        self.symmetries = torch.from_numpy(cube_symmetries()).float().to(device)
        places = np.stack([turned_places(symmetry) for symmetry in cube_symmetries()])
        self.places = torch.from_numpy(places).long().to(device)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.counts)

    def add(self, gathered: Gathered) -> None:
        """Take in samples."""
        for name, rows in self.arrays.items():
            rows.append(gathered.arrays[name])
        self.band_counts = np.append(self.band_counts, gathered.band_counts)
        self.counts = np.append(self.counts, gathered.counts)

    def batch(self, drawn: Sequence[int], turns: Sequence[int]) -> Batch:
        """Return some samples, each turned by one of the 48 symmetries."""
        chosen = np.asarray(drawn)
        band = rows_of(self.band_counts, chosen, self.device)
        some = rows_of(self.counts, chosen, self.device)
        which = torch.from_numpy(chosen).to(self.device)
        turn = torch.as_tensor(np.asarray(turns), device=self.device)
        places = self.places[turn[band.part]]
        return Batch(
            patches=self.arrays["patches"][band.rows].gather(1, places),
            table=moved_to(self.arrays["table"][band.rows], band).gather(1, places),
            voxels=self.arrays["voxels"][some.rows].long() + band.firsts[some.part],
            near=moved_to(self.arrays["near"][some.rows], some),
            window=some.part,
            counts=self.counts[chosen].tolist(),
            query=self.arrays["query"][which].long(),
            place=self.arrays["place"][which].long(),
            moved=self.arrays["moved"][which] @ self.symmetries[turn].mT,
            targets=self.arrays["targets"][some.rows].float(),
        )


def arrays_of(sample: Prepared) -> dict[str, np.ndarray]:
    """Return what is kept of a sample, indices within it, -1 for none."""
    copies, queries = copies_of_queries(sample.offsets), len(sample.offsets)
    if len(copies.query) > MOST_COPIES:
        raise ValueError(
            f"{queries} queries have {len(copies.query)} copies, more than {MOST_COPIES}: "
            "draw them with dataset.draw_offsets"
        )
    copies = copies.padded(MOST_COPIES, queries)
    return {
        "patches": sample.patches,
        "table": sample.table,
        "voxels": sample.voxels.astype(np.int32),
        "near": neighbours_with_targets(sample).astype(np.int32),
        "targets": sample.targets.astype(np.float16),
        "query": copies.query[None],
        "place": copies.place[None],
        "moved": copies.moved[None],
    }


@dataclass(frozen=True, eq=False)
class Parts:
    """Rows of several samples side by side."""

    rows: Tensor  # (n,) in the whole array
    part: Tensor  # (n,) which of the samples each is of
    firsts: Tensor  # (B,) where each sample begins among the n


def rows_of(counts: np.ndarray, chosen: np.ndarray, device: str) -> Parts:
    """Return the rows of chosen samples (B,) if all samples have these counts of them, (N,)."""
    lengths, begins = counts[chosen], (np.cumsum(counts) - counts)[chosen]
    firsts, total = np.cumsum(lengths) - lengths, int(lengths.sum())
    length, first, shift = torch.from_numpy(np.stack([lengths, firsts, begins - firsts])).to(device)
    part = torch.repeat_interleave(length, output_size=total)
    return Parts(shift[part] + torch.arange(total, device=device), part, first)


def moved_to(indices: Tensor, parts: Parts) -> Tensor:
    """Return indices within samples as indices among all rows, their number for -1."""
    return torch.where(indices < 0, len(indices), indices + parts.firsts[parts.part][:, None])
