"""Organs of a segmentation: one file with named and coloured parts, and their volumes.

    python examples/organs.py [OUT.glb]

The segmentation is synthetic: two balls that touch, and a tube through one ball, in a NIfTI file
with thick slices. Neighbours share their walls, vertex for vertex.
"""

import tempfile
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

import nibabel
import numpy as np

from super_sdf import load_network
from super_sdf.labels.files import convert_labels, read_names

TABLE = """\
1 liver 221 130 101 255
2 spleen 157 108 162 255
3 vein 0 151 206 255
"""
SPACING = 1.5, 1.5, 4.0  # mm

options = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
options.add_argument("target", nargs="?", default="organs.glb", help="mesh file, .glb or .3mf")
target = options.parse_args().target

x, y, z = (s * (i + 0.5) for s, i in zip(SPACING, np.indices((56, 40, 16))))
labels = np.zeros(x.shape, np.uint8)
labels[np.sqrt((x - 30) ** 2 + (y - 30) ** 2 + (z - 32) ** 2) < 22] = 1
labels[np.sqrt((x - 58) ** 2 + (y - 30) ** 2 + (z - 32) ** 2) < 14] = 2
labels[np.hypot(x - 30, y - 30) < 5] = 3

with tempfile.TemporaryDirectory() as folder:
    image, table = Path(folder, "organs.nii.gz"), Path(folder, "organs.ctbl")
    nibabel.save(nibabel.Nifti1Image(labels, np.diag([*SPACING, 1.0])), image)
    table.write_text(TABLE)
    made = convert_labels(image, target, load_network(), names=read_names(table), force=True)

for row in made.facts["labels"]:
    ml, counted = row["volume"] / 1000, row["sample_volume"] / 1000
    print(f"{row['name']}: {ml:.1f} ml, {counted:.1f} ml by its voxels, closed: {row['closed']}")
