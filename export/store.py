"""The windows of a store that a run is trained on, and which of them is shown next.

On a CPU a step of training takes longer than to change, turn and gather its samples. On a GPU it is
the other way round, so there ``ResidentStore`` keeps them on the device: see ``resident``.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from export.augment import Prepared, Shares, augment, augment_mask, change, prepare, prepare_mask
from export.batches import Batch, batch_of
from export.dataset import Sample, read_shard
from export.recipe import Recipe
from export.resident import Residents, gather_samples
from export.to_onnx import DISTANCES
from super_sdf.errors import FileError
from super_sdf.network.contract import MASKS

HELD_OUT = 2  # shards, the first by name, whose errors are logged
READERS = 4  # processes that gather samples for a GPU
INPUTS = (DISTANCES, MASKS)


class Sampler:
    """Draws windows with a chance in proportion to the loss on them when they were last shown.

    New windows are shown first, each once and in random order. Losses are not kept when a run ends:
    one that resumes shows every window once again.
    """

    def __init__(self) -> None:
        self.losses = np.empty(0)  # NaN: not shown yet
        self._order: list[int] = []

    def add(self, count: int) -> None:
        self.losses = np.append(self.losses, np.full(count, np.nan))

    def draw(self, rng: np.random.Generator, spread: float) -> int:
        """Return the index of the next window; for ``spread`` see ``chances``."""
        if not self._order:
            new, count = np.flatnonzero(np.isnan(self.losses)), len(self.losses)
            if len(new) or spread == 1:
                order = rng.permutation(new if len(new) else count)
            else:
                order = rng.choice(count, count, p=chances(self.losses, spread))
            self._order = order.tolist()
        return self._order.pop()

    def record(self, drawn: Sequence[int], losses: Sequence[float]) -> None:
        self.losses[list(drawn)] = losses


def chances(losses: NDArray[np.float64], spread: float) -> NDArray[np.float64]:
    """Return the chance of each window, (N,), from its loss.

    In proportion to the loss, but ``spread`` times the chance of a window of mean loss at most, and
    that over ``spread`` at least: this limits what a window without a learnable answer, or one that
    was shown with noise, takes from the others.
    """
    bounded = np.clip(losses / losses.mean(), 1 / spread, spread)
    return bounded / bounded.sum()


def check_store(folder: Path, held_out: int) -> None:
    """Raise FileError if a folder has no more shards than are held out."""
    if not folder.is_dir():
        raise FileError(f"--store {folder} is not a folder: fill one with export.dataset")
    count = len(list(folder.glob("shard-*.npz")))
    if count <= held_out:
        raise FileError(
            f"--store {folder} has {count} of at least {held_out + 1} shards, since the first "
            f"{held_out} are held out: make more with export.dataset"
        )


class Store:
    """The samples of the shards in a folder, read anew with ``refresh``; the first are held out.

    FileError if no shard is left for training, or one is damaged.
    """

    def __init__(
        self,
        folder: Path,
        held_out: int = HELD_OUT,
        most: int | None = None,
        inputs: str = DISTANCES,
        device: str = "cpu",
    ) -> None:
        check_store(folder, held_out)
        self.folder, self.most, self.inputs, self.device = folder, most, inputs, device
        self.seen = sorted(folder.glob("shard-*.npz"))[:held_out]
        gathered = prepare_mask if inputs == MASKS else prepare
        held = [gathered(s) for path in self.seen for s in read_shard(path)]
        self.held_out = [sample for sample in held if len(sample.voxels)]
        self.samples: list[Sample] = []
        self.sampler = Sampler()
        self.refresh()

    def unseen(self) -> list[Path]:
        return sorted(set(self.folder.glob("shard-*.npz")) - set(self.seen))

    def refresh(self) -> None:
        """Read new shards, at most ``most`` of them."""
        for path in self.unseen()[: self.most]:
            self.seen.append(path)
            self.samples += list(read_shard(path))
        self.sampler.add(len(self.samples) - len(self.sampler.losses))

    def __len__(self) -> int:
        return len(self.samples)

    def draw_batch(
        self, rng: np.random.Generator, recipe: Recipe, parts: int
    ) -> tuple[list[int], list[Batch]]:
        """Return windows with about ``batch_voxels`` voxels together, and which they are.

        They come in as many batches as there are threads, so that each can work on one.
        """
        drawn: list[int] = []
        shown: list[Prepared] = []
        while sum(len(sample.patches) for sample in shown) < recipe.batch_voxels:
            index = self.sampler.draw(rng, recipe.spread)
            if self.inputs == MASKS:
                sample = augment_mask(rng, self.samples[index])
            else:
                sample = augment(rng, self.samples[index], recipe.shares)
            if len(sample.voxels):
                drawn, shown = [*drawn, index], [*shown, sample]
            else:
                self.sampler.record([index], [0.0])
        groups = divide([len(sample.patches) for sample in shown], parts)
        batches = [batch_of([shown[row] for row in rows], self.device) for rows in groups]
        return [drawn[row] for rows in groups for row in rows], batches


def divide(sizes: Sequence[int], parts: int) -> list[list[int]]:
    """Return which windows of a batch each of at most ``parts`` threads works on.

    The largest windows are given out first, each to the part with the fewest voxels so far.
    """
    rows: list[list[int]] = [[] for _ in range(parts)]
    for row in sorted(range(len(sizes)), key=lambda row: -sizes[row]):
        min(rows, key=lambda part: sum(sizes[other] for other in part)).append(row)
    return [part for part in rows if part]


class ResidentStore(Store):
    """The samples of the shards in a folder on a GPU, each changed once and for all.

    Other processes read and gather them, so that the GPU never waits for new ones.
    """

    def __init__(self, folder: Path, held_out: int, shares: Shares, device: str) -> None:
        self.shares, self.residents = shares, Residents(device)
        self.readers = ProcessPoolExecutor(READERS, get_context("spawn"))
        self.reading: list[Future[dict[str, np.ndarray]]] = []
        super().__init__(folder, held_out)
        while not len(self):
            self._take_in(self.reading.pop(0))

    def refresh(self) -> None:
        """Have new shards read, and take in those that were."""
        for path in self.unseen():
            self.seen.append(path)
            self.reading.append(self.readers.submit(read_changed, path, self.shares))
        done = [future for future in self.reading if future.done()]
        self.reading = [future for future in self.reading if future not in done]
        for future in done:
            self._take_in(future)

    def _take_in(self, future: Future[dict[str, np.ndarray]]) -> None:
        self.residents.add(future.result())
        self.sampler.add(len(self) - len(self.sampler.losses))

    def __len__(self) -> int:
        return len(self.residents)

    def draw_batch(
        self, rng: np.random.Generator, recipe: Recipe, parts: int
    ) -> tuple[list[int], list[Batch]]:
        """Return windows with about ``batch_voxels`` voxels in one batch, and which they are."""
        drawn: list[int] = []
        while sum(self.residents.band_counts[index] for index in drawn) < recipe.batch_voxels:
            drawn.append(self.sampler.draw(rng, recipe.spread))
        turns = rng.integers(48, size=len(drawn)).tolist()
        return drawn, [self.residents.batch(drawn, turns)]


def read_changed(path: Path, shares: Shares) -> dict[str, np.ndarray]:
    """Return the samples of a shard, changed at random, always in the same way."""
    rng = np.random.default_rng(crc32(path.name.encode()))
    changed = [change(rng, sample, shares) for sample in read_shard(path)]
    return gather_samples([sample for sample in changed if len(sample.voxels)])
