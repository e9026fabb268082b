"""Train the network; resumable, with a log and a plot of the loss.

    python -m export.train --store training/store --run training/run --minutes 90
    python -m export.train --store training/store --run training/run --minutes 90     # resumes
    python -m export.train --store training/store --run training/run --device cuda --by-clock
    python -m export.train ... --start src/super_sdf/models/base.onnx --rate 0.7   # its weights
    python -m export.train ... --start src/super_sdf/models/base.onnx --blocks 12  # more blocks
    python -m export.train ... --start src/super_sdf/models/noisy.onnx --size base # more units
    python -m export.train ... --inputs masks      # the network for masks
    OMP_NUM_THREADS=1 python -m export.train ... --threads 2   # each works on a part of a batch

A run folder holds ``checkpoint.pt`` (weights, averaged weights, optimisers, time spent),
``log.csv`` and ``loss.png``. Dormant units are restarted (``dormant``). The learning rate depends
on the share of ``--minutes`` that is spent, so a run always ends annealed, however fast the
machine. Windows on which much is lost are shown more often (``sampler``). New shards in the store
are picked up as they appear.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from zlib import crc32

import numpy as np
import torch
from torch import Tensor

from export.arguments import Parser, at_least, positive, share
from export.augment import (
    USUAL,
    Prepared,
    Shares,
    augment,
    augment_mask,
    change,
    prepare,
    prepare_mask,
)
from export.batches import Batch, batch_of, encode, means, predict, singly
from export.dataset import CORNERS, Sample, read_shard
from export.dormant import dormant_share, revive
from export.grow import grow_from, without_blocks
from export.network import SIZES, Encoded, SuperSdfNet
from export.precision import autocast
from export.recipe import (
    RECIPE,
    Recipe,
    differences,
    make_optimisers,
    rate_factor,
    relative_weights,
    voxel_losses,
)
from export.resident import (
    Gathered,
    Residents,
    gather_samples,
)
from export.run_log import append_line, plot_run, read_log
from export.sampler import Sampler
from export.to_onnx import DISTANCES, read_weights
from super_sdf.errors import FileError
from super_sdf.files.regular import check_regular_file
from super_sdf.network.contract import MASKS

CHECKPOINT_SECONDS = 180
LONGEST_STEP = 30.0  # seconds: the rest of a longer one is taken as a pause (SIGSTOP)
LOG_STEPS = 100
WATCHED = 4  # last batches: a unit that reacted to none of them is dormant
READERS = 4  # processes that gather samples for a GPU
HELD_OUT = 2  # shards, the first by name, whose errors are logged
INPUTS = (DISTANCES, MASKS)
NEAR = 0.5  # half voxels from the surface: limit for normals; half of it for values


class Store:
    """The samples of the shards in a folder; the first shards, by name, are held out.

    Raises
    ------
    FileError
        If no shard is left for training, or one is damaged.
    """

    def __init__(
        self,
        folder: Path,
        held_out: int,
        most: int | None = None,
        inputs: str = INPUTS[0],
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

    def refresh(self) -> None:
        """Read new shards, at most ``most`` of them."""
        new = sorted(set(self.folder.glob("shard-*.npz")) - set(self.seen))
        for path in new[: self.most]:
            self.seen.append(path)
            self.samples += list(read_shard(path))
        self.sampler.add(len(self.samples) - len(self.sampler.losses))

    def __len__(self) -> int:
        """Return the number of samples to train on."""
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
            sample = self._changed(rng, self.samples[index], recipe)
            if len(sample.voxels):
                drawn, shown = [*drawn, index], [*shown, sample]
            else:
                self.sampler.record([index], [0.0])
        groups = divide([len(sample.patches) for sample in shown], parts)
        batches = [batch_of([shown[row] for row in rows], self.device) for rows in groups]
        return [drawn[row] for rows in groups for row in rows], batches

    def _changed(self, rng: np.random.Generator, sample: Sample, recipe: Recipe) -> Prepared:
        """Return a sample as it is shown this time."""
        if self.inputs == MASKS:
            return augment_mask(rng, sample)
        return augment(rng, sample, recipe.shares)


class ResidentStore(Store):
    """The samples of the shards in a folder on a GPU, each changed once and for all.

    Other processes read and gather them, so that the GPU never waits for new ones.
    """

    def __init__(self, folder: Path, held_out: int, shares: Shares, device: str) -> None:
        self.shares, self.residents = shares, Residents(device)
        self.readers = ProcessPoolExecutor(READERS, get_context("spawn"))
        self.reading: list[Future[Gathered]] = []
        super().__init__(folder, held_out)
        while not len(self):
            self.take_in(self.reading.pop(0).result())

    def refresh(self) -> None:
        """Have new shards read, and take in those that were."""
        for path in sorted(set(self.folder.glob("shard-*.npz")) - set(self.seen)):
            self.seen.append(path)
            self.reading.append(self.readers.submit(read_changed, path, self.shares))
        done = [future for future in self.reading if future.done()]
        self.reading = [future for future in self.reading if future not in done]
        for future in done:
            self.take_in(future.result())

    def take_in(self, gathered: Gathered) -> None:
        """Move samples to the device."""
        self.residents.add(gathered)
        self.sampler.add(len(gathered))

    def __len__(self) -> int:
        """Return the number of samples to train on."""
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


def read_changed(path: Path, shares: Shares) -> Gathered:
    """Return the samples of a shard, changed at random, always in the same way."""
    rng = np.random.default_rng(crc32(path.name.encode()))
    changed = [change(rng, sample, shares) for sample in read_shard(path)]
    return gather_samples([sample for sample in changed if len(sample.voxels)])


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


def window_losses(net: SuperSdfNet, batch: Batch, recipe: Recipe) -> Tensor:
    """Return the loss of each sample of a batch, (B,).

    Of a gated network, at a share of voxels drawn at random, it is also that after the first
    blocks, and the error of what the gate says of this.
    """
    if not net.config.gated:
        return means(batch_losses(net, batch, encode(net, batch), recipe), batch)
    low, high = recipe.shares_gated
    encoded = encode(net, batch, low + (high - low) * float(torch.rand(())))
    of_first = batch_losses(net, batch, encoded.after_first(), recipe)
    apart = encoded.doubts[batch.voxels] - of_first.detach().log()
    loss = recipe.first_weight * of_first + recipe.gate_weight * apart.abs()
    if high:
        loss = loss + batch_losses(net, batch, encoded, recipe)
    return means(loss, batch)


def batch_losses(net: SuperSdfNet, batch: Batch, encoded: Encoded, recipe: Recipe) -> Tensor:
    """Return the loss of each voxel with targets of a batch, (D,)."""
    return voxel_losses(predict(net, batch, encoded), batch.targets, recipe)


class Run:
    """The state of a run: weights, their running average, optimisers, steps, seconds spent."""

    def __init__(
        self,
        folder: Path,
        net: SuperSdfNet,
        recipe: Recipe = RECIPE,
        device: str = "cpu",
        threads: int = 1,
    ) -> None:
        self.path = folder / "checkpoint.pt"
        self.recipe, self.device, self.threads = recipe, device, threads
        self.net = net.to(device)
        self.average = copy.deepcopy(self.net)
        self.optimisers = make_optimisers(self.net, recipe)
        self.peaks = [optimiser.param_groups[0]["lr"] for optimiser in self.optimisers]
        self.step, self.seconds = 0, 0.0
        self.recent: deque[list[Batch]] = deque(maxlen=WATCHED)

    def save(self) -> None:
        """Write the checkpoint, completely or not at all."""
        part = self.path.with_suffix(".part")
        state = {
            "config": self.net.config.as_dict(),
            "net": self.net.state_dict(),
            "average": self.average.state_dict(),
            "optimisers": [optimiser.state_dict() for optimiser in self.optimisers],
            "step": self.step,
            "seconds": self.seconds,
        }
        torch.save(state, part)
        part.rename(self.path)

    def resume(self) -> None:
        """Continue from the checkpoint, if there is one."""
        if self.path.exists():
            state = torch.load(self.path, weights_only=True, map_location=self.device)
            self.net.load_state_dict(state["net"])
            self.average.load_state_dict(state["average"])
            for optimiser, kept in zip(self.optimisers, state["optimisers"], strict=True):
                optimiser.load_state_dict(kept)
            self.step, self.seconds = state["step"], state["seconds"]

    def start_from(self, weights: dict[str, Tensor]) -> None:
        """Start with the values of a network of the same sizes, or of smaller ones."""
        grow_from(self.net, weights)
        self.average.load_state_dict(self.net.state_dict())

    def advance(self, batches: list[Batch], spent: float) -> tuple[float, list[float]]:
        """Take one step at the rate for this share of the budget; return the loss, and each's."""
        for optimiser, peak in zip(self.optimisers, self.peaks):
            optimiser.param_groups[0]["lr"] = peak * rate_factor(spent, self.recipe)
        weights = relative_weights([n for batch in batches for n in batch.counts], self.recipe)
        losses = self.find_gradients(batches, weights)
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)
        for optimiser in self.optimisers:
            optimiser.step()
        self.step += 1
        self.update_average()
        self.recent.append(batches)
        if self.is_time_to_revive(spent):
            revive(self.net, self.optimisers, [each for some in self.recent for each in some])
        return float(weights @ losses), losses.tolist()

    def find_gradients(self, batches: list[Batch], weights: Tensor) -> Tensor:
        """Set the gradients of the weighted sum of the windows' losses; return each loss, (B,).

        Each batch has a thread of its own, since on a CPU one product is too small to be shared.
        """
        parts = weights.to(self.device).split([len(batch.counts) for batch in batches])
        with ThreadPoolExecutor(len(batches)) as pool:
            found = list(pool.map(self._gradients, batches, parts))
        for parameter, *grads in zip(self.net.trained(), *(grads for _, grads in found)):
            parameter.grad = sum(grads[1:], grads[0])
        return torch.cat([losses.cpu() for losses, _ in found])

    def _gradients(self, batch: Batch, weights: Tensor) -> tuple[Tensor, Sequence[Tensor]]:
        """Return the loss of each window, and the gradients of their weighted sum."""
        with autocast(self.device):
            losses = window_losses(self.net, batch, self.recipe)
        total = (weights * losses).sum()
        grads = torch.autograd.grad(total, self.net.trained(), materialize_grads=True)
        return losses.detach(), grads

    def is_time_to_revive(self, spent: float) -> bool:
        """Return whether dormant units are restarted after this step."""
        every, full = self.recipe.revive_steps, len(self.recent) == WATCHED
        return (
            bool(every)
            and full
            and self.step % every == WATCHED
            and spent < self.recipe.revive_until
        )

    def update_average(self) -> None:
        """Move the averaged weights towards the current ones."""
        decay = min(self.recipe.average_decay, self.step / (self.step + 9))
        average, now = list(self.average.parameters()), list(self.net.parameters())
        with torch.no_grad():
            torch._foreach_lerp_(average, now, 1 - decay)
        for kept, buffer in zip(self.average.buffers(), self.net.buffers()):
            kept.copy_(buffer)


def divide(sizes: Sequence[int], parts: int) -> list[list[int]]:
    """Return which windows of a batch each of at most ``parts`` threads works on.

    The largest windows are given out first, each to the part with the fewest voxels so far.
    """
    rows: list[list[int]] = [[] for _ in range(parts)]
    for row in sorted(range(len(sizes)), key=lambda row: -sizes[row]):
        min(rows, key=lambda part: sum(sizes[other] for other in part)).append(row)
    return [part for part in rows if part]


@dataclass(frozen=True)
class Errors:
    """Mean errors on held-out samples; the first two in voxels."""

    everywhere: float
    near: float  # within an eighth of a voxel of the surface
    normal: float  # 1 - cosine between the gradients near the surface


def measure(net: SuperSdfNet, samples: list[Prepared]) -> Errors:
    """Return the errors on held-out samples, in float32, as the exported network computes."""
    with torch.no_grad():
        errors = [
            sample_errors(predict(net, batch, encode(net, batch)), batch.targets)
            for batch in singly(net, samples)
        ]
    return Errors(*np.nanmean(errors, axis=0).tolist())


def sample_errors(prediction: Tensor, target: Tensor) -> list[float]:
    """Return the errors of one sample; NaN where nothing is near the surface."""
    error = (prediction - target).abs() / 2
    corners = target[:, : 4 * CORNERS : 4].abs() < NEAR
    got, wanted = differences(prediction)[corners], differences(target)[corners]
    cosine = torch.nn.functional.cosine_similarity(got, wanted, dim=1)
    near = error[target.abs() < NEAR / 2]
    return [float(error.mean()), float(near.mean()), float(1 - cosine.mean())]


def train(run: Run, store: Store, minutes: float, seed: int, began: float | None = None) -> None:
    """Train until the budget is spent.

    That is counted in time spent on steps, so that a run may be paused and resumed; or, with
    ``began`` (of ``time.monotonic``), by the clock since then, as on a machine that is lent.
    """
    rng = np.random.default_rng([seed, run.step])
    saved, losses = time.monotonic(), []
    while (spent := share_spent(run, minutes, began)) < 1:
        start = time.monotonic()
        losses.append(take_step(run, store, rng, spent))
        run.seconds += min(time.monotonic() - start, LONGEST_STEP)
        if run.step % LOG_STEPS == 0:
            log(run, store, float(np.mean(losses)), measured=run.step % (10 * LOG_STEPS) == 0)
            losses.clear()
            store.refresh()
        if time.monotonic() - saved > CHECKPOINT_SECONDS:
            run.save()
            saved = time.monotonic()
    run.save()
    if losses:
        log(run, store, float(np.mean(losses)), measured=True)


def share_spent(run: Run, minutes: float, began: float | None) -> float:
    """Return the share of the budget that is spent."""
    seconds = run.seconds if began is None else time.monotonic() - began
    return seconds / (60 * minutes)


def take_step(run: Run, store: Store, rng: np.random.Generator, spent: float) -> float:
    """Train on the next batch of a store; return the loss."""
    drawn, batches = store.draw_batch(rng, run.recipe, run.threads)
    loss, losses = run.advance(batches, spent)
    store.sampler.record(drawn, losses)
    return loss


def log(run: Run, store: Store, loss: float, *, measured: bool) -> None:
    """Append a line to the log, with the errors on held-out windows if they are to be measured."""
    line = [run.step, round(run.seconds), len(store), f"{loss:.5f}"]
    path = run.path.with_name("log.csv")
    if measured:
        errors = measure(run.average, store.held_out)
        line += [f"{errors.everywhere:.5f}", f"{errors.near:.5f}", f"{errors.normal:.5f}"]
        line += [f"{dormant_share(run.net, singly(run.net, store.held_out)):.4f}"]
    append_line(path, line)
    if measured:
        plot_run(read_log(path), path.with_name("loss.png"))


def main() -> None:
    """Start or resume training."""
    parser = Parser(description=__doc__.split("\n")[0])
    parser.add_argument("--store", type=Path, required=True, help="folder of shards")
    parser.add_argument("--run", type=Path, required=True, help="folder of the run")
    add_network_options(parser)
    parser.add_argument("--minutes", type=positive, default=90.0, help="training time in all")
    parser.add_argument(
        "--by-clock",
        action="store_true",
        help="count the minutes from the start of this call, reading and pauses included",
    )
    parser.add_argument("--rate", type=positive, default=1.0, help="factor on the learning rates")
    parser.add_argument("--noisy", type=share, default=USUAL.noisy, help="share of noisy samples")
    parser.add_argument(
        "--shifted", type=share, default=USUAL.shifted, help="share with another zero level"
    )
    parser.add_argument(
        "--truncated", type=share, default=USUAL.truncated, help="share of truncated samples"
    )
    parser.add_argument(
        "--batch",
        type=at_least(1),
        default=RECIPE.batch_voxels,
        metavar="VOXELS",
        help="voxels of a batch; its last window may exceed them",
    )
    parser.add_argument(
        "--threads",
        type=at_least(1),
        default=1,
        help="threads that each work on a part of every batch; set OMP_NUM_THREADS=1 with several",
    )
    parser.add_argument(
        "--inputs", choices=INPUTS, default=INPUTS[0], help="what the network is trained on"
    )
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument(
        "--revive-steps",
        type=at_least(0),
        default=RECIPE.revive_steps,
        help="steps between restarts of dormant units; 0 for none",
    )
    parser.add_argument("--seed", type=at_least(0), default=0)
    options = parser.parse_args()
    with parser.one_line_errors():
        run_training(options)


def add_network_options(parser: Parser) -> None:
    """Add the options that say which network is trained, and from which it starts."""
    parser.add_argument("--size", choices=SIZES, default="base", help="size of the network")
    parser.add_argument(
        "--start", type=Path, help="an .onnx file of that size, or smaller, to start from"
    )
    parser.add_argument(
        "--blocks", type=at_least(1), help="number of blocks, if not that of the size"
    )
    parser.add_argument(
        "--gated",
        type=at_least(0),
        default=0,
        help="number of blocks, the last ones, that run only where much is lost",
    )
    parser.add_argument(
        "--only-gate",
        action="store_true",
        help="train the gate and the block before it; all else stays as in --start",
    )
    parser.add_argument(
        "--without",
        type=at_least(0),
        nargs="+",
        default=(),
        metavar="BLOCK",
        help="blocks of --start to leave out, counted from 0",
    )


def run_training(options: argparse.Namespace) -> None:
    """Check the store before anything is written, then train."""
    began = time.monotonic() if options.by_clock else None
    check_store(options.store, HELD_OUT)
    if options.start:
        check_regular_file(options.start)
    options.run.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(options.seed)
    shares = replace(
        USUAL, shifted=options.shifted, noisy=options.noisy, truncated=options.truncated
    )
    recipe = replace(
        RECIPE.at(options.rate, shares),
        batch_voxels=options.batch,
        revive_steps=options.revive_steps,
    )
    config = SIZES[options.size]
    config = replace(
        config,
        blocks=options.blocks or config.blocks,
        keeps_samples=options.inputs == DISTANCES,
        gated=options.gated,
    )
    net = SuperSdfNet(config)
    if options.only_gate:
        net.train_only_gate()
        recipe = replace(recipe, shares_gated=(0.0, 0.0), revive_steps=0, first_weight=1.0)
    run = Run(options.run, net, recipe, options.device, options.threads)
    if options.start:
        run.start_from(without_blocks(read_weights(options.start), options.without))
    run.resume()
    if options.device == "cuda":
        import export.gpu_gather  # only CUDA builds of PyTorch have Triton

        export.gpu_gather.check()
    if options.device == "cuda" and options.inputs == DISTANCES:
        store: Store = ResidentStore(options.store, HELD_OUT, recipe.shares, options.device)
    else:
        store = Store(options.store, HELD_OUT, None, options.inputs, options.device)
    train(run, store, options.minutes, options.seed, began)


if __name__ == "__main__":
    main()
