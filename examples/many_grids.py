"""One network for many grids, each step of ``reconstruct``, progress, and errors.

    python examples/many_grids.py [FOLDER]

Writes the part and its offset surfaces at 1, 2 and 3 mm, at factor 2.
"""

import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

from super_sdf import SuperSdfError, extract_mesh, load_network, read_grid, upsample, write_mesh

options = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
options.add_argument("folder", nargs="?", default=".", help="folder for the meshes")
out = Path(options.parse_args().folder)
grid = read_grid(Path(__file__).parent / "part.npz")
network = load_network(threads=2)  # loaded once; threads may share it


def show(done: int, total: int) -> None:
    """Print the progress on one line, over and over."""
    print(f"{100 * done // total} %", end="\r", file=sys.stderr)


for offset in (0, 1, 2, 3, 99):
    try:
        field = upsample(grid, network, factor=2, offset=offset, progress=show)
    except SuperSdfError as error:
        print(f"offset {offset}: {error}")
        continue
    mesh = extract_mesh(field, grid)
    write_mesh(mesh, out / f"part+{offset}.ply", force=True)
    print(f"offset {offset}: {len(field.voxel_ijk):,} voxels -> {len(mesh.faces):,} triangles")
