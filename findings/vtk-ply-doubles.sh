#!/usr/bin/env bash
# VTK 9.6.2, and so PyVista: the vertices of a .ply file of doubles are read in single precision.
#
# Guess: positions that a .ply file declares as double arrive as doubles, as those of an .obj file
# do. Seen: vtkPLYReader makes float32 of them, without a warning. Vertices that are 0.0002 apart at
# 5,600 (a mesh in millimetres, far from the origin of a scanner) become one point, and triangles
# flat. The same mesh as .obj keeps every digit.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet 'vtk==9.6.2' 'numpy==2.4.6'
cd "$folder"
venv/bin/python - << 'PYTHON'
import numpy as np
import vtk
from vtk.util.numpy_support import vtk_to_numpy

points = np.array([[5600, 0, 0], [5600.0002, 0, 0], [5600, 1, 0], [5600, 0, 1]])
faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], "<i4")
rows = np.empty(4, [("count", "u1"), ("corners", "<i4", 3)])
rows["count"], rows["corners"] = 3, faces
head = "ply\nformat binary_little_endian 1.0\nelement vertex 4\n"
head += "".join(f"property double {axis}\n" for axis in "xyz")
head += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
with open("far.ply", "wb") as file:
    file.write(head.encode() + points.astype("<f8").tobytes() + rows.tobytes())
with open("far.obj", "w") as file:
    file.writelines("v {!r} {!r} {!r}\n".format(*point) for point in points.tolist())
    file.writelines("f {} {} {}\n".format(*corners) for corners in (faces + 1).tolist())

print("VTK", vtk.vtkVersion.GetVTKVersion())
seen = {}
for reader, name in ((vtk.vtkPLYReader(), "far.ply"), (vtk.vtkOBJReader(), "far.obj")):
    reader.SetFileName(name)
    reader.Update()
    read = vtk_to_numpy(reader.GetOutput().GetPoints().GetData())
    seen[name] = read.dtype, len(np.unique(read, axis=0))
    print(f"{name}: {read.dtype}, {seen[name][1]} of 4 points are distinct, x {read[:2, 0]}")
assert seen == {"far.ply": (np.float32, 3), "far.obj": (np.float64, 4)}, "that changed"
PYTHON
