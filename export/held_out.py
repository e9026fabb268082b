"""The errors of exported networks on the held-out windows of a store, as the log of a run has them.

    python -m export.held_out --store training/store src/super_sdf/models/base.onnx

So a shipped network can be compared with one in training. Networks for masks are measured on masks.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from export.arguments import Parser
from export.batches import singly
from export.dormant import dormant_share
from export.to_onnx import read_inputs, read_network
from export.train import HELD_OUT, Errors, Store, check_store, measure

HEADER = "| network | everywhere | near | normal | dormant |\n| --- | ---: | ---: | ---: | ---: |"


def format_row(name: str, errors: Errors, dormant: float) -> str:
    """Return a row of the table; the first two errors are in voxels."""
    near = f"{errors.everywhere:.5f} | {errors.near:.5f} | {errors.normal:.4f}"
    return f"| {name} | {near} | {100 * dormant:.2f} % |"


def measure_files(files: list[Path], folder: Path) -> Iterator[str]:
    """Yield the row of each file; held-out shards only are read."""
    check_store(folder, HELD_OUT)
    for file in files:
        net = read_network(file)
        samples = Store(folder, HELD_OUT, most=0, inputs=read_inputs(file)).held_out
        dormant = dormant_share(net, singly(net, samples))
        yield format_row(file.name, measure(net, samples), dormant)


def main() -> None:
    """Print the table."""
    parser = Parser(description=__doc__.split("\n")[0])
    parser.add_argument("files", type=Path, nargs="+", help="files of export.to_onnx")
    parser.add_argument("--store", type=Path, required=True, help="folder of shards")
    options = parser.parse_args()
    with parser.one_line_errors():
        print(HEADER)
        for row in measure_files(options.files, options.store):
            print(row, flush=True)


if __name__ == "__main__":
    main()
