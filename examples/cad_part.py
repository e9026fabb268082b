"""A part for CAD and printing: in millimetres, simplified within 0.01 mm.

    python examples/cad_part.py [OUT.3mf]

The grid is synthetic: a rotated plate of 40 x 25 x 8 mm with two holes, with a spacing of 1 mm.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter

import numpy as np

from super_sdf import make_grid, reconstruct, simplify_mesh, write_mesh

options = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
options.add_argument("out", nargs="?", default="plate.3mf", help="mesh file")
out = options.parse_args().out

TOLERANCE = 0.01  # mm
TURN = np.deg2rad(20)

x, y, z = np.indices((50, 44, 16)) - np.array([24.5, 21.5, 7.5])[:, None, None, None]
x, y = np.cos(TURN) * x + np.sin(TURN) * y, np.cos(TURN) * y - np.sin(TURN) * x
beyond = np.stack([np.abs(x) - 20, np.abs(y) - 12.5, np.abs(z) - 4])
plate = np.linalg.norm(np.maximum(beyond, 0), axis=0) + np.minimum(beyond.max(0), 0)
holes = 4 - np.hypot(np.abs(x) - 10, y)
distances = np.maximum(plate, holes)

fine = reconstruct(make_grid(distances, spacing=1.0))
mesh = simplify_mesh(fine, error=TOLERANCE)
write_mesh(mesh, out, unit="mm", force=True)

exact = 40 * 25 * 8 - 2 * np.pi * 4**2 * 8
print(f"{len(fine.faces):,} triangles, {len(mesh.faces):,} within {TOLERANCE} mm of them")
print(f"{mesh.volume():.1f} mm3, exact are {exact:.1f}; closed: {mesh.is_closed()}")
