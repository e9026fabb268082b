"""Train the network; resumable, one log line an interval.

    python -m export.train --store training/store --run training/run --minutes 90
    python -m export.train --store training/store --run training/run --minutes 90     # goes on

A run folder holds ``checkpoint.pt`` (weights, averaged weights, optimiser, time spent) and
``log.csv``. The learning rate follows the share of ``--minutes`` that is spent, so a run always
ends annealed, however fast the machine. New shards in the store are picked up as they appear.
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from export.dataset import Sample, read_shard
from export.network import NetworkConfig, SuperSdfNet
from super_sdf.band import NEIGHBOURHOOD, find_band, gather_patches, neighbour_table

PEAK_RATE = 2e-3  # ten times less is too slow, three times more diverges
WARM_UP = 0.02  # share of the budget
BATCH_VOXELS = 30_000  # about 8 shapes at 32^3
AVERAGE_DECAY = 0.998  # of the weights, a step
CHECKPOINT_SECONDS = 180
LOG_STEPS = 50
HELD_OUT = 1  # shards, the first by name: the loss on them is logged


@dataclass(frozen=True, eq=False)
class Prepared:
    """A sample as the network takes it: band patches and neighbours, and where its targets are."""

    patches: np.ndarray  # (V, 27) float32
    table: np.ndarray  # (V, 27) int32, -1 where absent
    voxels: np.ndarray  # (D,) rows of the band that have targets
    offsets: np.ndarray  # (Q, 3) float32
    targets: np.ndarray  # (D, Q) float32


def prepare(sample: Sample) -> Prepared:
    """Gather a sample with the runtime's own functions."""
    band = find_band(sample.window)
    strides = np.array([sample.window.shape[1] * sample.window.shape[2], sample.window.shape[2], 1])
    voxels = np.searchsorted(band @ strides, sample.voxel_ijk.astype(np.int64) @ strides)
    return Prepared(
        gather_patches(sample.window, band),
        neighbour_table(band, sample.window.shape),
        voxels,
        sample.offsets,
        sample.targets.astype(np.float32),
    )


def cube_symmetry(rng: np.random.Generator) -> np.ndarray:
    """Draw one of the 48 symmetries of the cube, (3, 3)."""
    return np.eye(3, dtype=np.int64)[rng.permutation(3)] * rng.choice([-1, 1], 3)


def augment(rng: np.random.Generator, sample: Prepared) -> Prepared:
    """Turn a sample by a symmetry of the cube; cut one in six off at 1.5 to 3 voxels."""
    symmetry = cube_symmetry(rng)
    source = NEIGHBOURHOOD @ symmetry  # the old place of what stands at each new place
    places = (source + 1) @ np.array([9, 3, 1])
    limit = rng.uniform(3, 6) if rng.random() < 1 / 6 else np.inf
    return Prepared(
        np.clip(sample.patches[:, places], -limit, limit),
        sample.table[:, places],
        sample.voxels,
        sample.offsets @ symmetry.T.astype(np.float32),
        sample.targets,
    )


def loss_of(net: SuperSdfNet, batch: list[Prepared]) -> tuple[Tensor, Tensor]:
    """Return the weighted loss and the plain mean absolute error (half voxels) of a batch.

    Errors near the surface count more, for they are what moves the mesh.
    """
    starts = np.cumsum([0] + [len(sample.patches) for sample in batch])
    total = int(starts[-1])
    tables = [np.where(s.table < 0, total, s.table + at) for s, at in zip(batch, starts[:-1])]
    patches = torch.from_numpy(np.concatenate([s.patches for s in batch]))
    features = net.encode(patches, torch.from_numpy(np.concatenate(tables).astype(np.int32)))
    losses, errors = [], []
    for sample, at in zip(batch, starts[:-1]):
        rows = torch.from_numpy(sample.voxels + at)
        offsets = torch.from_numpy(sample.offsets)
        target = torch.from_numpy(sample.targets)
        error = (net.decode(features[rows], patches[rows], offsets) - target).abs()
        losses.append((error * (0.25 + torch.exp(-target.abs() / 0.5))).mean())
        errors.append(error.detach().mean())
    return torch.stack(losses).mean(), torch.stack(errors).mean()


class Store:
    """The samples of all shards in a folder, read as they appear; the first are held out."""

    def __init__(self, folder: Path, held_out: int) -> None:
        self.folder = folder
        self.seen = set(sorted(folder.glob("shard-*.npz"))[:held_out])
        self.held_out = [prepare(s) for path in sorted(self.seen) for s in read_shard(path)]
        self.samples: list[Sample] = []
        self.order: list[int] = []

    def refresh(self) -> None:
        """Read the shards that are new."""
        for path in sorted(set(self.folder.glob("shard-*.npz")) - self.seen):
            self.seen.add(path)
            self.samples += list(read_shard(path))

    def draw_batch(self, rng: np.random.Generator) -> list[Prepared]:
        """Return samples of about ``BATCH_VOXELS`` voxels together, each once an epoch."""
        batch: list[Prepared] = []
        while sum(len(sample.patches) for sample in batch) < BATCH_VOXELS:
            if not self.order:
                self.order = rng.permutation(len(self.samples)).tolist()
            batch.append(augment(rng, prepare(self.samples[self.order.pop()])))
        return batch


class Run:
    """What a checkpoint holds: weights, their running average, optimiser, steps, seconds spent."""

    def __init__(self, folder: Path, config: NetworkConfig) -> None:
        self.path = folder / "checkpoint.pt"
        self.net = SuperSdfNet(config)
        self.average = SuperSdfNet(config)
        self.average.load_state_dict(self.net.state_dict())
        self.optimiser = torch.optim.AdamW(self.net.parameters(), lr=PEAK_RATE, weight_decay=1e-3)
        self.step, self.seconds = 0, 0.0

    def save(self) -> None:
        """Write the checkpoint, whole or not at all."""
        part = self.path.with_suffix(".part")
        state = {
            "config": self.net.config.as_dict(),
            "net": self.net.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
        }
        torch.save(state, part)
        part.rename(self.path)

    def resume(self) -> None:
        """Go on from the checkpoint, if there is one."""
        if self.path.exists():
            state = torch.load(self.path, weights_only=True)
            self.net.load_state_dict(state["net"])
            self.average.load_state_dict(state["average"])
            self.optimiser.load_state_dict(state["optimiser"])
            self.step, self.seconds = state["step"], state["seconds"]

    def advance(self, batch: list[Prepared], spent: float) -> float:
        """Take one step at the rate for this share of the budget; return the error."""
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(spent)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            loss, error = loss_of(self.net, batch)
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)
        self.optimiser.step()
        self.step += 1
        decay = min(AVERAGE_DECAY, self.step / (self.step + 9))
        with torch.no_grad():
            for mean, now in zip(self.average.parameters(), self.net.parameters()):
                mean.lerp_(now, 1 - decay)
        return float(error)


def learning_rate(spent: float) -> float:
    """Return the rate after this share of the budget: linear warm-up, then half a cosine."""
    cosine = 0.5 * (1 + np.cos(np.pi * min(spent, 1.0)))
    return float(PEAK_RATE * min(spent / WARM_UP + 1e-3, cosine + 1e-3))


def held_out_error(net: SuperSdfNet, samples: list[Prepared]) -> float:
    """Return the mean absolute error (half voxels) on the held-out samples."""
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        return float(np.mean([float(loss_of(net, [sample])[1]) for sample in samples]))


def train(run: Run, store: Store, minutes: float, seed: int) -> None:
    """Train until the budget is spent."""
    rng = np.random.default_rng([seed, run.step])
    store.refresh()
    saved, errors = time.monotonic(), []
    while run.seconds < 60 * minutes:
        start = time.monotonic()
        errors.append(run.advance(store.draw_batch(rng), run.seconds / (60 * minutes)))
        run.seconds += time.monotonic() - start
        if run.step % LOG_STEPS == 0:
            log(run, len(store.samples), float(np.mean(errors)), store.held_out)
            errors.clear()
            store.refresh()
        if time.monotonic() - saved > CHECKPOINT_SECONDS:
            run.save()
            saved = time.monotonic()
    run.save()


def log(run: Run, samples: int, error: float, held_out: list[Prepared]) -> None:
    """Append a line to the log and print it."""
    seldom = run.step % (10 * LOG_STEPS) == 0
    held = f"{held_out_error(run.average, held_out):.5f}" if seldom else ""
    row = [run.step, round(run.seconds), samples, f"{error:.5f}", held]
    with (run.path.parent / "log.csv").open("a", newline="") as file:
        csv.writer(file).writerow(row)
    print("step {} seconds {} samples {} error {} held-out {}".format(*row), flush=True)


def main() -> None:
    """Train or go on training."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--store", type=Path, required=True, help="folder of shards")
    parser.add_argument("--run", type=Path, required=True, help="folder of the run")
    parser.add_argument("--minutes", type=float, default=90.0, help="of training, in all")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.run.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(options.seed)
    run = Run(options.run, NetworkConfig())
    run.resume()
    train(run, Store(options.store, HELD_OUT), options.minutes, options.seed)


if __name__ == "__main__":
    main()
