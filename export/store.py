"""The windows of a store that a run is trained on, and which of them is shown next.

On a CPU a step of training takes longer than to change, turn and gather its samples. On a GPU it is
the other way round: there other processes change and gather each sample once, it stays on the
device, and is turned anew each time it is shown.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from export.augment import CLEAN, DISTANCES, USUAL, Prepared, Shares, change, turned
from export.dataset import Sample, read_shard
from export.losses import Batch, Recipe, batch_of
from super_sdf.errors import FileError

HELD_OUT = 2  # shards, the first by name, whose errors are logged, and one of smooth bodies
READERS = 4  # processes that gather samples for a GPU


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
            if len(new):
                order = rng.permutation(new)
            else:
                order = rng.choice(count, count, p=chances(self.losses, spread))
            self._order = order.tolist()
        return self._order.pop()


def chances(losses: NDArray[np.float64], spread: float) -> NDArray[np.float64]:
    """Return the chance of each window, (N,), from its loss.

    In proportion to the loss, but ``spread`` times the chance of a window of mean loss at most, and
    that over ``spread`` at least: this limits what a window without a learnable answer, or one that
    was shown with noise, takes from the others.
    """
    bounded = np.clip(losses / losses.mean(), 1 / spread, spread)
    return bounded / bounded.sum()


def shards_of(folder: Path, kind: str = "shard") -> list[Path]:
    return sorted(folder.glob(f"{kind}-*.npz"))


def check_store(folder: Path, held_out: int = HELD_OUT) -> None:
    """Raise FileError if a folder has no more shards than are held out."""
    if not folder.is_dir():
        raise FileError(f"--store {folder} is not a folder: fill one with export.dataset")
    count = len(shards_of(folder))
    if count <= held_out:
        raise FileError(
            f"--store {folder} has {count} of at least {held_out + 1} shards, since the first "
            f"{held_out} are held out: make more with export.dataset"
        )


def held_out(folder: Path, inputs: str, count: int, kind: str = "shard") -> list[Prepared]:
    """Return the samples of the first shards, masks or unchanged; masks are always the same."""
    samples = [s for path in shards_of(folder, kind)[:count] for s in read_shard(path)]
    rngs = (np.random.default_rng(len(sample.voxel_ijk)) for sample in samples)
    kept = [change(rng, sample, inputs, CLEAN) for rng, sample in zip(rngs, samples)]
    return [sample for sample in kept if len(sample.voxels)]


def read_changed(path: Path, inputs: str, shares: Shares) -> list[Prepared]:
    """Return the samples of a shard, changed at random, always in the same way."""
    rng = np.random.default_rng(crc32(path.name.encode()))
    return [change(rng, sample, inputs, shares) for sample in read_shard(path)]


class Store:
    """The samples of the shards in a folder, read anew with ``refresh``; the first are held out.

    Those of smooth bodies are drawn alike: by their loss they would hardly be drawn. FileError if
    no shard is left for training, or one is damaged.
    """

    def __init__(
        self,
        folder: Path,
        first: int = HELD_OUT,
        inputs: str = DISTANCES,
        shares: Shares = USUAL,
        device: str = "cpu",
    ) -> None:
        check_store(folder, first)
        self.folder, self.inputs, self.shares, self.device = folder, inputs, shares, device
        self.seen = {*shards_of(folder)[:first], *shards_of(folder, "smooth")[:1]}
        self.held_out = held_out(folder, inputs, first)
        self.held_out_smooth = held_out(folder, inputs, 1, "smooth")
        self.samples: dict[str, list[Sample | Prepared]] = {"shard": [], "smooth": []}
        self.sampler = Sampler()
        self.pool = ProcessPoolExecutor(READERS, get_context("spawn")) if device != "cpu" else None
        self.reading: list[tuple[str, Future[list[Prepared]]]] = []
        self.refresh(wait=True)

    def refresh(self, *, wait: bool = False) -> None:
        """Take in new shards; of those that other processes read, the ones that are there."""
        for kind, samples in self.samples.items():
            for path in (path for path in shards_of(self.folder, kind) if path not in self.seen):
                self.seen.add(path)
                if self.pool:
                    read = self.pool.submit(read_changed, path, self.inputs, self.shares)
                    self.reading.append((kind, read))
                else:
                    samples += read_shard(path)
        while self.reading and (wait or self.reading[0][1].done()):
            kind, read = self.reading.pop(0)
            self.samples[kind] += [s.on(self.device) for s in read.result() if len(s.voxels)]
        self.sampler.add(len(self) - len(self.sampler.losses))

    def __len__(self) -> int:
        return len(self.samples["shard"])

    def draw_batch(self, rng: np.random.Generator, recipe: Recipe) -> tuple[list[int], Batch]:
        """Return windows with about ``batch_voxels`` voxels, and which they are, -1 if smooth."""
        drawn: list[int] = []
        shown: list[Prepared] = []
        smooth = self.samples["smooth"]
        while sum(len(sample.patches) for sample in shown) < recipe.batch_voxels:
            if smooth and rng.random() < recipe.smooth:
                index, sample = -1, smooth[rng.integers(len(smooth))]
            else:
                index = self.sampler.draw(rng, recipe.spread)
                sample = self.samples["shard"][index]
            if isinstance(sample, Sample):
                sample = change(rng, sample, self.inputs, self.shares)
            if len(sample.voxels):
                drawn.append(index)
                shown.append(turned(sample, int(rng.integers(48))))
            elif index >= 0:
                self.sampler.losses[index] = 0.0
        return drawn, batch_of(shown)

    def record(self, drawn: Sequence[int], losses: Sequence[float]) -> None:
        """Keep the losses of windows that were shown, for the chances of their next turn."""
        for index, loss in zip(drawn, losses):
            if index >= 0:
                self.sampler.losses[index] = loss
