"""From an array to a mesh in one line: the distances of a real part.

python examples/array_to_mesh.py [OUT.ply]
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

import numpy as np

from super_sdf import reconstruct, write_mesh

options = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
options.add_argument("out", nargs="?", default="part.ply", help="mesh file")
out = options.parse_args().out

part = np.load(Path(__file__).parent / "part.npz")

mesh = reconstruct(part["values"], spacing=part["spacing"], origin=part["origin"])
write_mesh(mesh, out, force=True)

print(f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles, {mesh.volume():.0f} mm^3")
