"""A mesh of a formula: any function of points that gives distances.

    python examples/own_field.py [OUT.stl]

A bowl: a hollow sphere, by an offset of the field, without its upper part.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter

import numpy as np

from super_sdf import DistanceFunction, reconstruct, write_mesh


def bowl(points):
    """Return distances of points, (n, 3), negative inside."""
    ball = np.linalg.norm(points, axis=1) - 1.2
    shell = np.abs(ball + 0.1) - 0.1  # walls of 0.2, twice the spacing
    return np.maximum(shell, points[:, 2] - 0.3)


options = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
options.add_argument("out", nargs="?", default="bowl.stl", help="mesh file")
out = options.parse_args().out

function = DistanceFunction(bowl)
mesh = reconstruct(function=function, bounds=(-1.5, 1.5), spacing=0.1)
write_mesh(mesh, out, force=True)

off = np.abs(bowl(mesh.vertices)).mean() / 0.1
print(f"{len(mesh.faces):,} triangles, closed: {mesh.is_closed()}")
print(f"{function.evaluations:,} evaluations; vertices {off:.4f} voxels off in the mean")
