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
machine. Windows on which much is lost are shown more often, and new shards in the store are picked
up as they appear (``store``).
"""

from __future__ import annotations

import argparse
import copy
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from export.arguments import Parser, at_least, positive, share
from export.augment import USUAL
from export.batches import Batch, singly
from export.dormant import dormant_share, revive
from export.grow import grow_from, without_blocks
from export.network import SIZES, SuperSdfNet
from export.recipe import (
    RECIPE,
    Recipe,
    make_optimisers,
    measure,
    rate_factor,
    relative_weights,
    window_losses,
)
from export.run_log import append_line, plot_run, read_log
from export.store import HELD_OUT, INPUTS, ResidentStore, Store, check_store
from export.to_onnx import DISTANCES, read_weights
from super_sdf.files.regular import check_regular_file

CHECKPOINT_SECONDS = 180
LONGEST_STEP = 30.0  # seconds: the rest of a longer one is taken as a pause (SIGSTOP)
LOG_STEPS = 100
WATCHED = 4  # last batches: a unit that reacted to none of them is dormant
WITH_BFLOAT16 = ("avx512_bf16", "amx_bf16")


def autocast(device: str) -> torch.autocast:
    """Return the context in which a step is computed: in bfloat16 where that is faster.

    On a processor without these instructions it takes 18 times as long as float32.
    """
    found = torch.cpu.get_capabilities()
    fast = device != "cpu" or any(found.get(name, False) for name in WITH_BFLOAT16)
    return torch.autocast(device, dtype=torch.bfloat16, enabled=fast)


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
            "config": asdict(self.net.config),
            "net": self.net.state_dict(),
            "average": self.average.state_dict(),
            "optimisers": [optimiser.state_dict() for optimiser in self.optimisers],
            "step": self.step,
            "seconds": self.seconds,
        }
        torch.save(state, part)
        part.rename(self.path)

    def resume(self) -> None:
        if self.path.exists():
            state = torch.load(self.path, weights_only=True, map_location=self.device)
            self.net.load_state_dict(state["net"])
            self.average.load_state_dict(state["average"])
            for optimiser, kept in zip(self.optimisers, state["optimisers"], strict=True):
                optimiser.load_state_dict(kept)
            self.step, self.seconds = state["step"], state["seconds"]

    def start_from(self, weights: dict[str, Tensor]) -> None:
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
        every, full = self.recipe.revive_steps, len(self.recent) == WATCHED
        is_time = bool(every) and full and self.step % every == WATCHED
        if is_time and spent < self.recipe.revive_until:
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
        with autocast(self.device):
            losses = window_losses(self.net, batch, self.recipe)
        total = (weights * losses).sum()
        grads = torch.autograd.grad(total, self.net.trained(), materialize_grads=True)
        return losses.detach(), grads

    def update_average(self) -> None:
        """Move the averaged weights towards the current ones."""
        decay = min(self.recipe.average_decay, self.step / (self.step + 9))
        average, now = list(self.average.parameters()), list(self.net.parameters())
        with torch.no_grad():
            torch._foreach_lerp_(average, now, 1 - decay)
        for kept, buffer in zip(self.average.buffers(), self.net.buffers()):
            kept.copy_(buffer)


def train(run: Run, store: Store, minutes: float, seed: int, began: float | None = None) -> None:
    """Train until the budget is spent.

    That is counted in time spent on steps, so that a run may be paused and resumed; or, with
    ``began`` (of ``time.monotonic``), by the clock since then, as on a machine that is lent.
    """
    rng = np.random.default_rng([seed, run.step])
    saved, losses = time.monotonic(), []

    def share_spent() -> float:
        seconds = run.seconds if began is None else time.monotonic() - began
        return seconds / (60 * minutes)

    while (spent := share_spent()) < 1:
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


def take_step(run: Run, store: Store, rng: np.random.Generator, spent: float) -> float:
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


NUMBERS = (
    ("minutes", positive, 90.0, "training time in all"),
    ("rate", positive, 1.0, "factor on the learning rates"),
    ("noisy", share, USUAL.noisy, "share of noisy samples"),
    ("shifted", share, USUAL.shifted, "share with another zero level"),
    ("truncated", share, USUAL.truncated, "share of truncated samples"),
    ("batch", at_least(1), RECIPE.batch_voxels, "voxels of a batch; its last window may be more"),
    ("threads", at_least(1), 1, "that each work on a part of a batch; set OMP_NUM_THREADS=1 then"),
    ("blocks", at_least(1), None, "number of blocks, if not that of the size"),
    ("gated", at_least(0), None, "last blocks, run where much is lost, if not those of the size"),
    ("revive-steps", at_least(0), RECIPE.revive_steps, "between restarts of dormant units; 0: no"),
    ("seed", at_least(0), 0, "of all that is drawn"),
)


def main() -> None:
    """Start or resume training."""
    parser = Parser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("--store", type=Path, required=True, help="folder of shards")
    add("--run", type=Path, required=True, help="folder of the run")
    add("--size", choices=SIZES, default="base", help="size of the network")
    add("--inputs", choices=INPUTS, default=DISTANCES, help="what the network is trained on")
    add("--start", type=Path, help="an .onnx file of that size, or smaller, to start from")
    left_out = {"type": at_least(0), "nargs": "+", "default": (), "metavar": "BLOCK"}
    add("--without", **left_out, help="blocks of --start to leave out, counted from 0")
    only = "train the gate and the block before it; all else stays as in --start"
    add("--only-gate", action="store_true", help=only)
    clock = "count the minutes from the start of this call, reading and pauses included"
    add("--by-clock", action="store_true", help=clock)
    add("--device", choices=["cpu", "cuda"], default="cpu")
    for name, kind, default, text in NUMBERS:
        add(f"--{name}", type=kind, default=default, help=text)
    options = parser.parse_args()
    with parser.one_line_errors():
        run_training(options)


def run_training(options: argparse.Namespace) -> None:
    """Check the store before anything is written, then train."""
    began = time.monotonic() if options.by_clock else None
    check_store(options.store, HELD_OUT)
    if options.start:
        check_regular_file(options.start)
    options.run.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(options.seed)
    net, recipe = network_of(options), recipe_of(options)
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
        store = Store(options.store, inputs=options.inputs, device=options.device)
    train(run, store, options.minutes, options.seed, began)


def network_of(options: argparse.Namespace) -> SuperSdfNet:
    size = SIZES[options.size]
    config = replace(
        size,
        blocks=options.blocks or size.blocks,
        keeps_samples=options.inputs == DISTANCES,
        gated=size.gated if options.gated is None else options.gated,
    )
    net = SuperSdfNet(config)
    if options.only_gate:
        net.train_only_gate()
    return net


def recipe_of(options: argparse.Namespace) -> Recipe:
    drawn = {name: getattr(options, name) for name in ("shifted", "noisy", "truncated")}
    recipe = replace(
        RECIPE,
        hidden_rate=options.rate * RECIPE.hidden_rate,
        outer_rate=options.rate * RECIPE.outer_rate,
        shares=replace(USUAL, **drawn),
        batch_voxels=options.batch,
        revive_steps=options.revive_steps,
    )
    if options.only_gate:
        return replace(recipe, shares_gated=(0.0, 0.0), revive_steps=0, first_weight=1.0)
    return recipe


if __name__ == "__main__":
    main()
