"""Samples kept in the memory of a GPU, which turns them and makes batches of them itself.

On a CPU a step of training takes longer than to change, turn and gather its samples. On a GPU it
is the other way round. So every sample is gathered once, by a process of its own, as it is and in
some cases also changed (``augment``), and stays on the device. A batch is drawn from what is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from export.augment import Prepared
from export.batches import Batch, copies_of_queries, neighbours_with_targets
from export.dataset import ANYWHERE, CORNERS, FINE_NODES
from super_sdf.network.neighbourhood import cube_symmetries, turned_places

# A corner and its three neighbours have at most 8 + 3 * 4 copies (``dataset.draw_offsets``).
MOST_COPIES = 20 * CORNERS + 8 * FINE_NODES + ANYWHERE


def gather_samples(samples: Sequence[Prepared]) -> dict[str, np.ndarray]:
    """Return samples one after the other; indices are within each, -1 for none.

    ``band_counts`` and ``counts`` are the voxels of the band of each sample, (N,), and those of
    them with targets. ValueError if queries have more copies than there is room for.
    """
    each = [arrays_of(sample) for sample in samples]
    return {name: np.concatenate([arrays[name] for arrays in each]) for name in each[0]}


def arrays_of(sample: Prepared) -> dict[str, np.ndarray]:
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
        "band_counts": np.array([len(sample.patches)]),
        "counts": np.array([len(sample.voxels)]),
    }


class Residents:
    """The samples on a device."""

    def __init__(self, device: str) -> None:
        self.device = device
        self.arrays: dict[str, Tensor] = {}  # with room for more rows
        self.filled: dict[str, int] = {}  # rows of each
        self.band_counts = self.counts = np.zeros(0, np.int64)  # of each sample
        self.symmetries = torch.from_numpy(cube_symmetries()).float().to(device)
        places = np.stack([turned_places(symmetry) for symmetry in cube_symmetries()])
        self.places = torch.from_numpy(places).long().to(device)

    def __len__(self) -> int:
        return len(self.counts)

    def add(self, gathered: dict[str, np.ndarray]) -> None:
        self.band_counts = np.append(self.band_counts, gathered.pop("band_counts"))
        self.counts = np.append(self.counts, gathered.pop("counts"))
        for name, rows in gathered.items():
            new = torch.from_numpy(np.ascontiguousarray(rows)).to(self.device)
            held, start = self.arrays.get(name, new[:0]), self.filled.get(name, 0)
            end = start + len(new)
            if end > len(held):
                room = held.new_empty(3 * end // 2 - len(held), *held.shape[1:])
                held = torch.cat([held, room])
            held[start:end] = new
            self.arrays[name], self.filled[name] = held, end

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


class Parts(NamedTuple):
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
