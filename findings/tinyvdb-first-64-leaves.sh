#!/usr/bin/env bash
# tinyvdb 0.9.0: to_sparse() returns the voxels of the first 64 leaves of each node of 128^3 voxels only.
#
# Guess: to_sparse() returns every active voxel, since active_voxel_count and the leaves are there.
# Seen: of 100 leaves of 8^3 active voxels in one node, 64 come back (32,768 of 51,200 voxels), without an error.
# The tree that the same call read holds all 100 leaves. OpenVDB 10.0.1 reads the file whole.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet tinyvdb==0.9.0 numpy
cd "$folder"
env/bin/python - << 'PYTHON'
import struct
import uuid

import numpy as np
import tinyvdb

LEAVES = 100


def text(words):
    return struct.pack("<I", len(words)) + words.encode()


def mask(on, size):
    chosen = np.zeros(size, bool)
    chosen[on] = True
    return np.packbits(chosen, bitorder="little").tobytes()


# OpenVDB's format, version 224, flag 2: of each node only active values are stored.
head = struct.pack("<qIII?", 0x56444220, 224, 10, 0, True) + str(uuid.UUID(int=0)).encode()
head += struct.pack("<II", 0, 1) + text("ball") + text("Tree_float_5_4_3") + text("")
place = len(head) + 24
count = text("file_voxel_count") + text("int64") + struct.pack("<Iq", 8, 512 * LEAVES)
grid = struct.pack("<II", 2, 1) + count + text("ScaleMap") + struct.pack("<15d", *(1.0,) * 15)
tree = struct.pack("<IfII", 1, 3.0, 0, 1) + struct.pack("<iii", 0, 0, 0)
tree += mask([0], 32**3) + mask([], 32**3) + b"\0"
tree += mask(range(LEAVES), 16**3) + mask([], 16**3) + b"\0"
full = mask(range(512), 512)
values = (full + b"\0" + np.ones(512, "<f4").tobytes()) * LEAVES
end = place + len(grid) + len(tree) + len(full) * LEAVES + len(values)
offsets = struct.pack("<qqq", place, place + len(grid) + len(tree) + len(full) * LEAVES, end)
with open("leaves.vdb", "wb") as file:
    file.write(head + offsets + grid + tree + full * LEAVES + values)

with tinyvdb.open("leaves.vdb") as file:
    file.read_grids()
    found = file.grid(0)
    nodes = [found.tree.node(i) for i in range(found.tree.num_nodes)]
    held = sum(node.active_voxel_count for node in nodes if node.type == "leaf")
    stated = found.metadata["file_voxel_count"]
    sparse = len(found.to_sparse()["coords"]) // 12
print(f"tinyvdb {tinyvdb.__version__}: the file states {stated} active voxels, the leaves of the")
print(f"tree hold {held}, to_sparse() returns {sparse}")
assert (stated, held, sparse) == (51200, 51200, 32768), "the behaviour has changed"
PYTHON
