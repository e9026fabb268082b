"""The errors of networks on the windows held out of a store; of those for masks also the bias.

    python -m export.measure --store training/store src/super_sdf/models/mask.onnx training/run

So a shipped network can be compared with one in training, of which the averaged weights are
measured. Errors are those of the log of a run. Of masks of smooth bodies, at random places on the
lattice, the second table has the error near the surface and the bias, in thousandths of a voxel:
over 0 where the surface is made too flat.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from export.arguments import Parser
from export.augment import CLEAN, DISTANCES, Prepared, change
from export.dataset import sample_field
from export.losses import measure
from export.shapes.smooth import Field, ellipsoid, mapped, rounded_box, tilted, torus
from export.store import HELD_OUT, held_out
from export.to_onnx import load_run, read_network
from super_sdf.network import contract

SIZE = 68  # samples along each axis round a body
PLACES = 2  # on the lattice
BODIES: dict[str, Field] = {
    **{f"ball {radius}": ellipsoid(np.full(3, radius)) for radius in (8.0, 16.0, 28.0)},
    "ellipsoid 10, 16, 28": ellipsoid(np.array([10.0, 16.0, 28.0])),
    "cylinder 12": rounded_box(np.array([0, 0, 500.0]), 12.0),
    "torus 20, 8": torus(20.0, 8.0),
    "plane 3 degrees": tilted(np.random.default_rng(0), 3.0),
}


def masks_of(field: Field, *, turned: bool) -> list[Prepared]:
    rng, masks = np.random.default_rng(0), []
    while len(masks) < PLACES:
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0] if turned else np.eye(3)
        low = rng.uniform(-SIZE / 2, 1 - SIZE / 2, 3)
        sample = sample_field(rng, mapped(field, turn), low, SIZE)
        if sample:
            masks.append(change(rng, sample, contract.MASKS, CLEAN))
    return masks


def main(words: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = Parser(description=__doc__.split("\n")[0])
    parser.add_argument("files", type=Path, nargs="+", help=".onnx files and folders of runs")
    parser.add_argument("--store", type=Path, required=True, help="folder of shards")
    options = parser.parse_args(words)
    with parser.one_line_errors():
        files = options.files
        nets = {f: load_run(f) if f.is_dir() else read_network(f) for f in files}
        masks = not all(net.config.keeps_samples for net in nets.values())
        samples = held_out(options.store, contract.MASKS if masks else DISTANCES, HELD_OUT)
        print("| network | everywhere | near | normal |\n| --- | ---: | ---: | ---: |")
        for path, net in nets.items():
            print(f"| {path.name} | {' | '.join(measure(net, samples).cells())} |", flush=True)
        if not masks:
            return
        bodies = {name: masks_of(f, turned="plane" not in name) for name, f in BODIES.items()}
        print(f"\n| network | {' | '.join(bodies)} |\n| --- {'| ---: ' * len(bodies)}|")
        for path, net in nets.items():
            found = [measure(net, some) for some in bodies.values()]
            cells = [f"{1000 * each.near:.0f}, {1000 * each.bias:+.1f}" for each in found]
            print(f"| {path.name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
