"""Train many networks with the same budget and print a table of their errors.

    python -m export.compare --store training/store --out training/compare --minutes 2.5

Every entry has the same seed, samples and minutes of processor time on one thread, and is measured
on samples of meshes that none was trained on. Entries that have a row in the table are skipped, so
the command can be stopped and resumed.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from export import variants
from export.augment import CLEAN, USUAL
from export.dormant import dormant_share
from export.latency import ball, microseconds
from export.network import NetworkConfig, SuperSdfNet
from export.recipe import RECIPE, Recipe
from export.train import Errors, Run, Store, measure, take_step

HELD_OUT = 2  # shards
SHARDS = 20  # of training
OURS = NetworkConfig(blocks=5)
DEEP = NetworkConfig(blocks=8)  # deep enough for units to become dormant
HIGH = replace(RECIPE, hidden_rate=5e-3, spread=1.0, shares=CLEAN)  # short: a higher rate

Entry = tuple[Callable[[NetworkConfig], SuperSdfNet], NetworkConfig, Recipe]


def blocks_of(kind: type) -> Callable[[NetworkConfig], SuperSdfNet]:
    """Return a function that makes networks with blocks of this kind."""
    return lambda config: variants.BlockNet(config, kind)


ENTRIES: dict[str, Entry] = {
    "5 convolutions of 64 channels": (SuperSdfNet, OURS, HIGH),
    "the patch alone": (blocks_of(variants.PointBlock), replace(OURS, hidden=256), HIGH),
    "3 convolutions": (SuperSdfNet, replace(OURS, blocks=3), HIGH),
    "8 convolutions": (SuperSdfNet, replace(OURS, blocks=8), HIGH),
    "96 channels": (SuperSdfNet, replace(OURS, channels=96, hidden=192), HIGH),
    "10 blocks along the axes": (blocks_of(variants.AxesBlock), replace(OURS, blocks=10), HIGH),
    "10 bottleneck blocks": (blocks_of(variants.BottleneckBlock), replace(OURS, blocks=10), HIGH),
    "U-Net, two coarser levels": (variants.UNet, replace(OURS, blocks=4), HIGH),
    "head: block of 125 values": (variants.BlockHead, OURS, HIGH),
    "head: network a query": (variants.QueryHead, OURS, HIGH),
    "head: planes": (variants.PlanesHead, OURS, HIGH),
    "over trilinear": (variants.TrilinearBase, OURS, HIGH),
    "loss: squared": (SuperSdfNet, OURS, replace(HIGH, power=2)),
    "loss: no gradient": (SuperSdfNet, OURS, replace(HIGH, gradient_weight=0.0)),
    "AdamW only": (SuperSdfNet, OURS, replace(HIGH, muon=False)),
    "every other block dilated": (variants.DilatedNet, OURS, HIGH),
    "5x5x5 patch": (variants.WidePatchNet, OURS, HIGH),
    "head: deeper branch": (variants.DeepBranch, OURS, HIGH),
    "48 channels": (SuperSdfNet, replace(OURS, channels=48, hidden=96), HIGH),
    "over the sample": (variants.SampleBase, OURS, HIGH),
    "loss: gradient twice": (SuperSdfNet, OURS, replace(HIGH, gradient_weight=1.0)),
    "loss: eikonal": (SuperSdfNet, OURS, replace(HIGH, eikonal_weight=0.2)),
    "loss: surface position": (SuperSdfNet, OURS, replace(HIGH, reach=0.2, far_weight=0.05)),
    "loss: all distances alike": (SuperSdfNet, OURS, replace(HIGH, reach=1e-6, far_weight=1.0)),
    "batches of 6,000": (SuperSdfNet, OURS, replace(HIGH, batch_voxels=6000)),
    "batches of 30,000": (SuperSdfNet, OURS, replace(HIGH, batch_voxels=30_000)),
    "half inside out": (SuperSdfNet, OURS, replace(HIGH, shares=replace(CLEAN, inverted=0.5))),
    "8 blocks, rectifiers": (SuperSdfNet, DEEP, replace(HIGH, revive_steps=0)),
    "8 blocks, dormant units started again": (SuperSdfNet, DEEP, HIGH),
    "8 blocks, one rectifier each": (blocks_of(variants.LinearMixBlock), DEEP, HIGH),
    "8 blocks, leaky rectifiers": (blocks_of(variants.LeakyBlock), DEEP, HIGH),
    "8 blocks, smooth rectifiers": (blocks_of(variants.SiluBlock), DEEP, HIGH),
    "8 blocks, normalised features": (blocks_of(variants.NormBlock), DEEP, HIGH),
    "windows drawn by their loss": (SuperSdfNet, OURS, replace(HIGH, spread=RECIPE.spread)),
    "noise, offsets, truncation": (SuperSdfNet, OURS, replace(HIGH, shares=USUAL)),
}  # fmt: skip


def train_entry(entry: Entry, store: Store, folder: Path, minutes: float) -> Run:
    """Train one network; the clock is the processor's, so that other work does not count."""
    make, config, recipe = entry
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    store.sampler.restart()
    run = Run(folder, make(config), recipe)
    while run.seconds < 60 * minutes:
        start = time.process_time()
        take_step(run, store, rng, run.seconds / (60 * minutes))
        run.seconds += time.process_time() - start
    return run


def main() -> None:
    """Train the entries without a row, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--store", type=Path, required=True, help="folder of shards")
    parser.add_argument("--out", type=Path, required=True, help="folder for the rows")
    parser.add_argument("--minutes", type=float, default=2.5, help="processor time per entry")
    parser.add_argument("--only", help="train only entries whose name contains this")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    store = Store(options.store, HELD_OUT, SHARDS)
    rows = options.out / "rows.jsonl"
    done = read_rows(rows)
    for name, entry in ENTRIES.items():
        if name not in done and (options.only or "") in name:
            run = train_entry(entry, store, options.out, options.minutes)
            errors = measure(run.average, store.held_out)
            append_row(rows, name, run, errors, dormant_share(run.net, [store.held_out]))
            print(name, errors, flush=True)
    print(format_table(with_times(read_rows(rows))))


def append_row(path: Path, name: str, run: Run, errors: Errors, dormant: float) -> None:
    """Append the results of an entry as one line of JSON."""
    parameters = sum(p.numel() for p in run.net.parameters())
    row = {"name": name, "parameters": parameters, "steps": run.step, **asdict(errors)}
    row["dormant"] = dormant
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")


def read_rows(path: Path) -> dict[str, dict[str, float]]:
    """Return the rows by name."""
    lines = path.read_text().splitlines() if path.exists() else []
    return {row["name"]: row for row in map(json.loads, lines)}


def with_times(rows: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Add to each row the microseconds per voxel of the network on one thread."""
    sample = ball(20.0)
    makers = {name: ENTRIES[name][:2] for name in rows}
    return {
        name: {**rows[name], "us": microseconds(make(config), sample, 1)}
        for name, (make, config) in makers.items()
    }


def format_table(rows: dict[str, dict[str, float]]) -> str:
    """Return the table in Markdown."""
    lines = [
        "| network | parameters | us per voxel | steps | error | near the surface | normal "
        "| dormant |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name, row in rows.items():
        lines.append(
            f"| {name} | {row['parameters'] / 1e3:.0f} k | {row['us']:.1f} | {row['steps']} | "
            f"{100 * row['everywhere']:.2f} | {100 * row['near']:.2f} | {100 * row['normal']:.2f} "
            f"| {100 * row['dormant']:.1f} % |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
