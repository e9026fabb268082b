"""The errors of exported networks on the held-out windows of a store, as the log of a run has them.

    python -m export.held_out --store training/store src/super_sdf/models/base.onnx

So a shipped network can be compared with one in training. Networks for masks are measured on masks.
"""

from __future__ import annotations

from pathlib import Path

from export.arguments import Parser
from export.batches import singly
from export.dormant import dormant_share
from export.recipe import measure
from export.store import Store
from export.to_onnx import read_inputs, read_network

HEADER = "| network | everywhere | near | normal | dormant |\n| --- | ---: | ---: | ---: | ---: |"


def row_of(file: Path, folder: Path) -> str:
    """Return the row of a file; the first two errors are in voxels."""
    net = read_network(file)
    samples = Store(folder, most=0, inputs=read_inputs(file)).held_out
    dormant = 100 * dormant_share(net, singly(net, samples))
    return f"| {file.name} | {' | '.join(measure(net, samples).cells())} | {dormant:.2f} % |"


def main() -> None:
    """Print the table."""
    parser = Parser(description=__doc__.split("\n")[0])
    parser.add_argument("files", type=Path, nargs="+", help="files of export.to_onnx")
    parser.add_argument("--store", type=Path, required=True, help="folder of shards")
    options = parser.parse_args()
    with parser.one_line_errors():
        print(HEADER)
        for file in options.files:
            print(row_of(file, options.store), flush=True)


if __name__ == "__main__":
    main()
