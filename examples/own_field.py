"""A grid from a formula: sample any distance function on your own lattice.

    python examples/own_field.py [OUT.stl]

A bowl: the upper half cut off a sphere, hollowed by an offset of the field.
"""

import sys

import numpy as np

from super_sdf import make_grid, reconstruct, write_mesh

SPACING, ORIGIN = 0.1, (-1.5, -1.5, -1.5)

x, y, z = np.indices((31, 31, 31)) * SPACING - 1.5  # samples are points: origin + spacing * ijk
ball = np.sqrt(x**2 + y**2 + z**2) - 1.2
shell = np.abs(ball + 0.1) - 0.1  # walls of 0.2, twice the spacing
bowl = np.maximum(shell, z - 0.3)  # negative inside

mesh = reconstruct(make_grid(bowl, spacing=SPACING, origin=ORIGIN), factor=8)
write_mesh(mesh, sys.argv[1] if len(sys.argv) > 1 else "bowl.stl", force=True)

print(f"{len(mesh.faces):,} triangles, closed: {mesh.open_edges() == 0}")
