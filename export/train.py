"""Train the network; resumable, with a log and a plot of the loss.

    python -m export.train --store training/store --run training/run --minutes 90   # or resume
    python -m export.train ... --start src/super_sdf/models/base.onnx --rate 0.7   # its weights

A run folder holds ``checkpoint.pt`` (weights, averaged weights, optimisers, time spent),
``log.csv`` and ``loss.png``, all written every five minutes. The learning rate depends on the share
of ``--minutes`` that is spent, so a run always ends annealed, however fast the machine. Windows on
which much is lost are shown more often, and new shards are picked up as they appear (``store``).
"""

from __future__ import annotations

import argparse
import copy
import csv
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from export.arguments import Parser, at_least, positive, share
from export.augment import DISTANCES, INPUTS, USUAL
from export.losses import RECIPE, Batch, Recipe, measure, window_losses
from export.measure import OF_MASKS, cells_of_masks
from export.network import SIZES, WIDE, NetworkConfig, SuperSdfNet
from export.store import HELD_OUT, Store, check_store
from export.to_onnx import read_network
from super_sdf.errors import OptionError
from super_sdf.network import contract

SAVE_SECONDS = 300  # between checkpoints, each with a line in the log
LONGEST_STEP = 30.0  # seconds: the rest of a longer one is taken as a pause (SIGSTOP)
MEASURED = 3  # every third of the windows held out is measured for the log
COLUMNS = ("step", "seconds", "samples", "loss", "everywhere", "near", "normal", *OF_MASKS)
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
        self, folder: Path, net: SuperSdfNet, recipe: Recipe = RECIPE, device: str = "cpu"
    ) -> None:
        self.path, self.recipe, self.device = folder / "checkpoint.pt", recipe, device
        self.net = net.to(device)
        self.average = copy.deepcopy(self.net)
        self.optimisers = make_optimisers(self.net, recipe)
        self.peaks = [optimiser.param_groups[0]["lr"] for optimiser in self.optimisers]
        self.step, self.seconds = 0, 0.0

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
        """Take the weights of a network of this width; blocks that it lacks change nothing yet."""
        fresh, weights = {n: a.clone() for n, a in self.net.state_dict().items()}, dict(weights)
        for name, array in fresh.items():
            if name not in weights and ".reduce." in name:
                array.zero_()
            if name == "stem.0.weight" and name in weights:
                more = array.shape[1] - weights[name].shape[1]  # inputs that change nothing yet
                weights[name] = torch.nn.functional.pad(weights[name], (0, max(more, 0)))
        try:
            self.net.load_state_dict({**fresh, **weights})
        except RuntimeError as error:
            reason = " ".join(str(error).split())[:200]
            raise OptionError(f"--start has a network of another size: {reason}") from error
        self.average.load_state_dict(self.net.state_dict())

    def advance(self, batch: Batch, spent: float) -> tuple[float, list[float]]:
        """Take one step at the rate for this share of the budget; return the loss, and each's."""
        with autocast(self.device):
            losses = window_losses(self.net, batch, self.recipe)
        # Small shapes have few voxels and large errors. With equal weights they make up more than
        # half of the loss, and of its noise; weighted by voxels they would hardly count.
        weights = losses.new_tensor(batch.counts) ** self.recipe.voxel_power
        total = (weights * losses).sum() / weights.sum()
        self.descend(total, spent)
        return float(total.detach()), losses.tolist()

    def descend(self, loss: Tensor, spent: float) -> None:
        """Take one step down the gradient of a loss, and into the averaged weights."""
        cosine = 0.5 * (1 + math.cos(math.pi * min(spent, 1)))  # after the warm-up
        for optimiser, peak in zip(self.optimisers, self.peaks):
            rate = peak * (min(spent / self.recipe.warm_up, cosine) + 1e-3)
            optimiser.param_groups[0]["lr"] = rate
            optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)
        for optimiser in self.optimisers:
            optimiser.step()
        self.step += 1
        decay = min(self.recipe.average_decay, self.step / (self.step + 9))
        average, now = list(self.average.parameters()), list(self.net.parameters())
        with torch.no_grad():
            torch._foreach_lerp_(average, now, 1 - decay)
        for kept, buffer in zip(self.average.buffers(), self.net.buffers()):
            kept.copy_(buffer)


def make_optimisers(net: SuperSdfNet, recipe: Recipe) -> list[torch.optim.Optimizer]:
    """Return AdamW, and Muon for the matrices of the blocks."""
    blocks = {id(p) for p in net.all_blocks().parameters() if p.ndim == 2}
    hidden = [p for p in net.parameters() if id(p) in blocks]
    others = [p for p in net.parameters() if id(p) not in blocks]
    rate = {"lr": recipe.hidden_rate, "adjust_lr_fn": "match_rms_adamw"}
    return [
        torch.optim.AdamW(others, lr=recipe.outer_rate, weight_decay=1e-3),
        torch.optim.Muon(hidden, weight_decay=1e-3, **rate),
    ]


def train(run: Run, store: Store, minutes: float, seed: int, began: float | None = None) -> None:
    """Train until the budget is spent.

    That is counted in time spent on steps, so that a run may be paused and resumed; or, with
    ``began`` (of ``time.monotonic``), by the clock since then, as on a machine that is lent.
    """
    rng = np.random.default_rng([seed, run.step])
    saved, losses = time.monotonic(), []

    def share_spent() -> float:
        return (run.seconds if began is None else time.monotonic() - began) / (60 * minutes)

    while (spent := share_spent()) < 1:
        start = time.monotonic()
        drawn, batch = store.draw_batch(rng, run.recipe)
        loss, each = run.advance(batch, spent)
        store.record(drawn, each)
        losses.append(loss)
        run.seconds += min(time.monotonic() - start, LONGEST_STEP)
        if time.monotonic() - saved > SAVE_SECONDS or share_spent() >= 1:
            run.save()
            log(run, store, float(np.mean(losses)))
            store.refresh()
            saved, losses = time.monotonic(), []


def log(run: Run, store: Store, loss: float) -> None:
    """Append a line to the log, with the errors on held-out windows, and draw it anew."""
    line = [run.step, round(run.seconds), len(store), f"{loss:.5f}"]
    line += measure(run.average, store.held_out[::MEASURED]).cells()
    line += cells_of_masks(run.average, store.held_out_smooth[::MEASURED])
    path = run.path.with_name("log.csv")
    with path.open("a", newline="") as file:
        csv.writer(file).writerow(line)
    print(" ".join(f"{name} {value}" for name, value in zip(COLUMNS, line)), flush=True)
    plot(path, path.with_name("loss.png"))


def plot(log_file: Path, picture: Path) -> None:
    with log_file.open(newline="") as file:
        rows = [row + ["nan"] * (len(COLUMNS) - len(row)) for row in csv.reader(file)]
    columns = dict(zip(COLUMNS, np.array(rows, float).T))
    figure = Figure(figsize=(16, 4), layout="constrained")
    for ax, names in zip(figure.subplots(1, 4), (["loss"], COLUMNS[4:7], COLUMNS[7:9], ["reach"])):
        for name in names:
            ax.plot(columns["seconds"] / 60, columns[name], label=name)
        ax.set(xlabel="minutes", yscale="linear" if names[-1] in OF_MASKS else "log")
        ax.legend()
    figure.savefig(picture, dpi=100)


NUMBERS = (
    ("minutes", positive, 90.0, "training time in all"),
    ("rate", positive, 1.0, "factor on the learning rates"),
    ("noisy", share, USUAL.noisy, "share of noisy samples"),
    ("shifted", share, USUAL.shifted, "share with another zero level"),
    ("truncated", share, USUAL.truncated, "share of truncated samples"),
    ("smooth", share, RECIPE.smooth, "share of windows of smooth bodies, if the store has any"),
    ("batch", at_least(1), RECIPE.batch_voxels, "voxels of a batch; its last window may be more"),
    ("blocks", at_least(1), None, "number of blocks, if not that of the size"),
    ("gated", at_least(0), None, "last blocks, run where much is lost, if not those of the size"),
    ("seed", at_least(0), 0, "of all that is drawn"),
)


def main(words: Sequence[str] | None = None) -> None:
    """Start or resume training."""
    parser = Parser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("--store", type=Path, required=True, help="folder of shards")
    add("--run", type=Path, required=True, help="folder of the run")
    add("--size", choices=SIZES, help="size of the network: that of --start if not given, or base")
    add("--inputs", choices=INPUTS, default=DISTANCES, help="what the network is trained on")
    add("--start", type=Path, help="an .onnx file of its width to start from")
    clock = "count the minutes from the start of this call, reading and pauses included"
    add("--by-clock", action="store_true", help=clock)
    add("--device", choices=["cpu", "cuda"], default="cpu")
    for name, kind, default, text in NUMBERS:
        add(f"--{name}", type=kind, default=default, help=text)
    options = parser.parse_args(words)
    with parser.one_line_errors():
        run_training(options)


def resized(
    size: NetworkConfig, blocks: int | None, gated: int | None, inputs: str
) -> NetworkConfig:
    """Return the sizes of a network for these inputs; more blocks see as many places as the last.

    OptionError if more blocks are gated than there are.
    """
    count, places = blocks or size.blocks, size.places
    gated = size.gated if gated is None else gated
    if gated > count:
        raise OptionError(f"{gated} of {count} blocks cannot be gated: give fewer")
    if places:
        last = places[size.blocks - 1 : size.blocks]
        early = places[size.blocks :] or last * bool(gated)
        places = (*places[: size.blocks][:count], *last * (count - size.blocks), *early)
    masks = inputs == contract.MASKS
    sizes = {"blocks": count, "gated": gated, "places": places, "wide": WIDE * masks}
    return replace(size, keeps_samples=not masks, **sizes)


def run_training(options: argparse.Namespace) -> None:
    """Check the store before anything is written, then train."""
    began = time.monotonic() if options.by_clock else None
    check_store(options.store, HELD_OUT)
    given = read_network(options.start) if options.start else None
    size = given.config if given and not options.size else SIZES[options.size or "base"]
    config = resized(size, options.blocks, options.gated, options.inputs)
    drawn = {name: getattr(options, name) for name in ("shifted", "noisy", "truncated")}
    recipe = replace(
        RECIPE,
        hidden_rate=options.rate * RECIPE.hidden_rate,
        outer_rate=options.rate * RECIPE.outer_rate,
        shares=replace(USUAL, **drawn),
        smooth=options.smooth,
        batch_voxels=options.batch,
    )
    store = Store(options.store, HELD_OUT, options.inputs, recipe.shares, options.device)
    options.run.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(options.seed)
    run = Run(options.run, SuperSdfNet(config), recipe, options.device)
    if given:
        run.start_from(given.state_dict())
    run.resume()
    train(run, store, options.minutes, options.seed, began)


if __name__ == "__main__":
    main()
