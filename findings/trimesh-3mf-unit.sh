#!/usr/bin/env bash
# trimesh 5.2.0 writes every 3MF file in millimetres, whatever the unit of the mesh.
#
# Expected: a box of one inch (`mesh.units = "in"`) becomes a 3MF file with unit="inch", or one of
# 25.4 mm. Seen: unit="millimeter" and a side of 1: the box is 25.4 times too small in a slicer, and
# no warning is given. Read back, its unit is "millimeter". A file that says unit="inch" is read
# with its unit, so only the writer loses it. As .glb, which is in metres by its standard, the box
# has a side of 1, too, and trimesh keeps "in" in a field of its own, which no other reader knows.
#
# So a unit that was set on a mesh does not arrive: scale the mesh to millimetres before 3MF, and
# to metres before .glb.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet 'trimesh==5.2.0' 'numpy==2.4.6' 'networkx==3.6.1' 'lxml==6.1.3'
"$folder/venv/bin/python" - "$folder" << 'PYTHON'
import io
import re
import sys
import zipfile

import numpy as np
import trimesh

box = trimesh.creation.box((1.0, 1.0, 1.0))
box.units = "in"
data = box.export(file_type="3mf")
with zipfile.ZipFile(io.BytesIO(data)) as archive:
    name = next(name for name in archive.namelist() if name.endswith(".model"))
    model = archive.read(name).decode()
unit = re.search(r'unit="(\w+)"', model).group(1)
back = trimesh.load(io.BytesIO(data), file_type="3mf")
side = float(np.ptp(back.bounds[:, 0]))
print(f"trimesh {trimesh.__version__}: a box of 1 in is written in {unit}, side {side:g}")
assert (unit, back.units, side) == ("millimeter", "millimeter", 1.0)

inches = io.BytesIO()
with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(inches, "w") as other:
    for each in archive.namelist():
        content = archive.read(each)
        if each == name:
            content = content.replace(b'unit="millimeter"', b'unit="inch"')
        other.writestr(each, content)
read = trimesh.load(inches, file_type="3mf")
print(f"a file in inches is read in {read.units}, side {np.ptp(read.bounds[:, 0]):g}")
assert read.units.startswith("in") and np.isclose(np.ptp(read.bounds[:, 0]), 1)

glb = trimesh.load(io.BytesIO(box.export(file_type="glb")), file_type="glb")
print(f"as .glb its side is {np.ptp(glb.bounds[:, 0]):g} metres, units {glb.units!r}")
assert np.isclose(np.ptp(glb.bounds[:, 0]), 1)
PYTHON
