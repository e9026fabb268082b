"""Densities to a level set of OpenVDB and a mesh: for Houdini, Blender and other programs.

    python examples/level_set.py [OUT.vdb [OUT.glb]]

The densities are those of a cloud of soft balls. A fog volume in a file is read as
``read_grid("smoke.vdb:density", level=0.1)`` instead.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter

import numpy as np

from super_sdf import (
    extract_mesh,
    load_network,
    make_grid,
    read_grid,
    upsample,
    write_field,
    write_mesh,
)

SPACING, LEVEL = 0.1, 0.5
BALLS = [((0, 0, 0), 0.9), ((0.8, 0.3, 0.1), 0.6), ((-0.8, 0.2, 0), 0.65), ((0.1, 0.7, 0.2), 0.6)]

options = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
options.add_argument("level_set", nargs="?", default="cloud.vdb", help="file for the level set")
options.add_argument("surface", nargs="?", default="cloud.glb", help="file for the mesh")
names = options.parse_args()
x = np.arange(-20, 21) * SPACING
points = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1)
density = sum(np.exp(-(np.linalg.norm(points - at, axis=-1) ** 2) / r**2) for at, r in BALLS)

grid = make_grid(density, level=LEVEL, spacing=SPACING, origin=(-2, -2, -2))
network = load_network()
field = upsample(grid, network, factor=4)
write_field(field, names.level_set, force=True)
mesh = extract_mesh(field)
write_mesh(mesh, names.surface, force=True)
print(f"{names.surface}: {len(mesh.faces):,} triangles, closed: {mesh.is_closed()}")

again = read_grid(names.level_set)  # the level set is a grid like any other
width = again.high / again.spacing[0]
print(f"{names.level_set}: voxels of {again.spacing[0]:.3f}, {width:.0f} of them to either side")
