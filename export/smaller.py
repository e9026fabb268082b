"""Smaller networks with nearly the same values, to ship or to start from.

    python -m export.smaller large.onnx --store S     # the errors without each block
    python -m export.smaller large.onnx --store S --without 0 --out smaller.onnx
    python -m export.smaller smaller.onnx --store S --seen 64 --minutes 18 --out start.onnx

In training a block may die: then it changes all voxels alike, or hardly any, and a network without
it has the same values in less time. Blocks that are to see fewer places or channels are fitted to
what they gave, by least squares, one after the other, and then trained to give the same features
together. Which channels they see is decided anew: the features are turned, so that the first ones
decide most of what the blocks give.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from export.arguments import Parser, at_least, positive
from export.augment import CLEAN, DISTANCES, Prepared, Shares, change
from export.dataset import read_shard
from export.losses import RECIPE, batch_of, measure
from export.network import PLACES, NeighbourConv, SuperSdfNet, gathered, in_basis
from export.store import HELD_OUT, Store, check_store, shards_of
from export.to_onnx import load_run, make_card, parity, read_card, read_network, write_model
from export.train import Run, autocast
from super_sdf.errors import OptionError
from super_sdf.network import contract

WINDOWS = 100  # that blocks are fitted to; a quarter as many are measured on
RIDGE = 1e-5  # over the mean square of an input
NOISY = Shares(0, 1, 0)
RATE = 0.2  # of the usual rates of training, for features that are to be the same


def windows_of(folder: Path, inputs: str, shares: Shares) -> tuple[list[Prepared], list[Prepared]]:
    """Return windows to fit blocks to, and some of those held out, from all shards of a store."""
    check_store(folder, HELD_OUT)
    rng, paths, found = np.random.default_rng(0), shards_of(folder), []
    for shards, count in ((paths[HELD_OUT:], WINDOWS), (paths[:HELD_OUT], WINDOWS // 4)):
        some = (s for path in shards for s in islice(read_shard(path), -(-count // len(shards))))
        changed = [change(rng, sample, inputs, shares) for sample in some]
        found.append([window for window in changed if len(window.voxels)])
    return found[0], found[1]


@torch.no_grad()
def mean_changes(net: SuperSdfNet, windows: Sequence[Prepared]) -> Tensor:
    """Return what each block before a gate adds to the features, on average, (blocks, C)."""
    first = net.blocks[: net.config.blocks - net.config.gated]
    sums, count = torch.zeros(len(first), net.config.channels), 0
    for features, table in encoded(net, windows):
        count += len(features)
        for number, block in enumerate(first):
            changed = block(features, table)
            sums[number] += (changed - features).sum(0)
            features = changed
    return sums / count


def encoded(net: SuperSdfNet, windows: Sequence[Prepared]) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the features (V, C) that the stem gives the voxels of a window, and their table."""
    for window in windows:
        batch = batch_of([window])
        yield net.stem(batch.patches), batch.table


@torch.no_grad()
def without(net: SuperSdfNet, numbers: Sequence[int], changes: Tensor) -> SuperSdfNet:
    """Return a network without some blocks before its gate, but with their mean ``changes``."""
    if not set(numbers) < set(range(len(changes))):
        raise OptionError(f"without {numbers}: the first {len(changes)} blocks can go, not all")
    places, count = net.config.places, net.config.blocks
    kept = [number for number in range(count) if number not in numbers]
    places = places and (*(places[number] for number in kept), *places[count:])
    small = SuperSdfNet(replace(net.config, blocks=len(kept), places=places))
    of_blocks = {name: array for name, array in net.state_dict().items() if "blocks." in name}
    weights = {name: a for name, a in net.state_dict().items() if name not in of_blocks}
    for name, array in of_blocks.items():
        _, number, rest = name.split(".", 2)
        if int(number) in kept:
            weights[f"blocks.{kept.index(int(number))}.{rest}"] = array
    small.load_state_dict(weights)
    for number in numbers:
        before = sum(each < number for each in kept)
        (small.blocks[before - 1].reduce if before else small.stem[2]).bias += changes[number]
    return small.eval()


@torch.no_grad()
def decisive_first(net: SuperSdfNet, windows: Sequence[Prepared]) -> SuperSdfNet:
    """Return a network with the same values, whose first channels decide most of its convolutions.

    Voxels are taken as independent: then the best channels are the first directions of the weights
    of all blocks, where features have their variance as unit (reduced-rank regression).
    """
    first = net.blocks[: net.config.blocks - net.config.gated]
    squares = torch.zeros(len(first), net.config.channels, net.config.channels)
    for features, table in encoded(net, windows):
        for square, block in zip(squares, first):
            square += features.T @ features
            features = block(features, table)
    variances, axes = torch.linalg.eigh(sum(s / s.trace() for s in squares.double()))
    roots = variances.clamp(min=1e-9 * variances.max()).sqrt()
    decided = torch.zeros_like(axes)
    for block in first:
        weight = block.conv.weight.double().unflatten(0, (block.conv.places, -1))
        scaled = (roots[:, None] * axes.T) @ weight
        made = torch.einsum("pic,pjc->ij", scaled, scaled)
        decided += made / made.trace()
    directions = torch.linalg.eigh(decided)[1].flip(1)
    basis = torch.linalg.qr((axes / roots) @ directions)[0].T.float()
    return in_basis(net, basis, basis.T)


@torch.no_grad()
def seeing_less(
    net: SuperSdfNet, places: tuple[int, ...], seen: int, windows: Sequence[Prepared]
) -> SuperSdfNet:
    """Return a network whose blocks before a gate see fewer places, or channels, fitted to another.

    ``places`` has a number for each of these blocks; all others see what they saw. ``seen`` is 0
    for all channels. OptionError if the numbers do not fit, or the network sees less already.
    """
    first = net.config.blocks - net.config.gated
    if len(places) != first:
        raise OptionError(f"--places {' '.join(map(str, places))}: give {first} numbers")
    if net.config.seen:
        raise OptionError(
            f"its blocks see {net.config.seen} channels: give a network that sees all"
        )
    if not 0 <= seen <= net.config.channels:
        raise OptionError(f"--seen {seen}: give at most {net.config.channels}, all channels")
    places = (*places, *(block.conv.places for block in net.all_blocks()[first:]))
    small = SuperSdfNet(replace(net.config, places=places, seen=seen)).eval()
    weights, own = net.state_dict(), small.state_dict()
    small.load_state_dict({n: a if a.shape == own[n].shape else own[n] for n, a in weights.items()})
    both = [(features, features, table) for features, table in encoded(net, windows)]
    for old, new in list(zip(net.blocks, small.blocks))[:first]:
        fit(new.conv, old.conv, both)
        both = [(old(given, table), new(made, table), table) for given, made, table in both]
    return small


def fit(conv: NeighbourConv, old: NeighbourConv, both: list[tuple[Tensor, Tensor, Tensor]]) -> None:
    """Let a convolution give, of the features it gets, what another gives of those it gets."""
    rows = len(conv.weight) + 1
    square, product = torch.zeros(rows, rows).double(), torch.zeros(rows, len(conv.bias)).double()
    for given, made, table in both:
        wanted = old(given, table)
        for part, columns in gathered(made[:, : conv.seen], table[:, PLACES[conv.places]]):
            inputs = torch.cat([columns, columns.new_ones(len(columns), 1)], 1)
            square += inputs.T @ inputs
            product += inputs.T @ wanted[part]
    fitted = torch.linalg.solve(square + torch.diag(RIDGE * square.diagonal()), product).float()
    conv.weight.copy_(fitted[:-1])
    conv.bias.copy_(fitted[-1])


def follow(
    small: SuperSdfNet, net: SuperSdfNet, store: Store, minutes: float, folder: Path
) -> SuperSdfNet:
    """Train the first blocks to give the features that those of another network give."""
    rates = {"hidden_rate": RATE * RECIPE.hidden_rate, "outer_rate": RATE * RECIPE.outer_rate}
    run, rng = Run(folder, small, replace(RECIPE, **rates)), np.random.default_rng(0)
    began = time.monotonic()
    while (spent := (time.monotonic() - began) / (60 * minutes)) < 1:
        batch = store.draw_batch(rng, run.recipe)[1]
        with autocast("cpu"):
            with torch.no_grad():
                wanted = net.encode(batch.patches, batch.table).float()
            apart = (small.encode(batch.patches, batch.table) - wanted).abs().mean(0)
        run.descend((apart / wanted.std(0).clamp(min=1e-3)).mean(), spent)
    return run.average.eval()


def main(words: Sequence[str] | None = None) -> None:
    """Print the errors without each block, or write a smaller network and print its errors."""
    parser = Parser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("source", type=Path, help="an .onnx file of export.to_onnx, or the folder of a run")
    add("--store", type=Path, required=True, help="folder of shards")
    add("--noisy", action="store_true", help="fit and measure on noisy windows only")
    add("--without", type=int, nargs="+", default=(), help="blocks to leave out")
    seen = "neighbours that each block before a gate sees"
    add("--places", type=int, nargs="+", choices=PLACES, help=seen)
    add("--seen", type=at_least(1), help="channels that the blocks before a gate see")
    add("--minutes", type=positive, help="of training to have the same features, after the fit")
    add("--out", type=Path, help="the smaller .onnx file")
    options = parser.parse_args(words)
    with parser.one_line_errors():
        less = options.places or options.seen
        if bool(options.without or less) != bool(options.out):
            raise OptionError("--out is for a network that --without, --places or --seen makes")
        if options.minutes and not less:
            raise OptionError("--minutes are for blocks that see less: give --places or --seen")
        run(options)


def run(options: argparse.Namespace) -> None:
    """Print errors, and write the smaller network if one is asked for."""
    net = load_run(options.source) if options.source.is_dir() else read_network(options.source)
    inputs = DISTANCES if net.config.keeps_samples else contract.MASKS
    shares = NOISY if options.noisy else CLEAN
    windows, new = windows_of(options.store, inputs, shares)
    changes = mean_changes(net, windows)
    print("| network | everywhere | near | normal |\n| --- | ---: | ---: | ---: |")

    def line(name: str, net: SuperSdfNet) -> None:
        print(f"| {name} | {' | '.join(measure(net, new).cells())} |", flush=True)

    line(options.source.name, net)
    if options.out is None:
        for number in range(len(changes)):
            line(f"without {number}", without(net, [number], changes))
        return
    if options.without:
        net = without(net, options.without, changes)
    if options.places or options.seen:
        before = len(net.blocks) - net.config.gated
        places = tuple(options.places or (b.conv.places for b in net.blocks[:before]))
        turned = decisive_first(net, windows)
        net = seeing_less(turned, places, options.seen or 0, windows)
        if options.minutes:
            line("fitted", net)
            store = Store(options.store, inputs=inputs, shares=shares)
            net = follow(net, turned, store, options.minutes, options.out.parent)
    card = make_card(net, options.out.stem)
    if not options.source.is_dir():
        kept = read_card(options.source)
        card |= {name: kept[name] for name in ("trained_on", "inputs") if name in kept}
    write_model(net, options.out, card)
    line(options.out.name, net)
    print(f"differs from torch by {parity(net, options.out) / 2:.1e} voxels")


if __name__ == "__main__":
    main()
