#!/usr/bin/env bash
# gmsh 4.15.2 reads no binary .ply file of doubles, such as those of MeshLab and Open3D.
#
# Guess: a binary .ply file loads, whichever type it declares for its vertices, or the error names
# the type. Seen: rows of three floats are taken for granted. So a file of doubles, or one of floats
# with normals, ends with "Wrong node index" and a number that stands nowhere in the file. The same
# mesh of floats alone, or as text, loads.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet 'gmsh==4.15.2' 'numpy==2.4.6'
cd "$folder"
venv/bin/python - << 'PYTHON'
import gmsh
import numpy as np

points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], "<i4")
NORMALS = [f"float n{axis}" for axis in "xyz"]


def write(name, kind, more=(), binary=True):
    properties = [*(f"{kind} {axis}" for axis in "xyz"), *more]
    head = f"ply\nformat {'binary_little_endian' if binary else 'ascii'} 1.0\nelement vertex 4\n"
    head += "".join(f"property {each}\n" for each in properties)
    head += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    values = np.hstack([points, points]) if more else points
    if binary:
        rows = np.empty(4, [("count", "u1"), ("corners", "<i4", 3)])
        rows["count"], rows["corners"] = 3, faces
        body = values.astype("<f8" if kind == "double" else "<f4").tobytes() + rows.tobytes()
    else:
        lines = [*(" ".join(map(repr, row)) for row in values.tolist())]
        lines += [" ".join(map(str, [3, *row])) for row in faces.tolist()]
        body = ("\n".join(lines) + "\n").encode()
    with open(name, "wb") as file:
        file.write(head.encode() + body)


def load(name):
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    try:
        gmsh.merge(name)
        tags, read, _ = gmsh.model.mesh.getNodes()
        return np.array_equal(np.sort(read.reshape(-1, 3), axis=0), np.sort(points, axis=0))
    except Exception as error:
        return str(error)
    finally:
        gmsh.finalize()


write("float.ply", "float")
write("normals.ply", "float", NORMALS)
write("double.ply", "double")
write("text.ply", "double", binary=False)
print("gmsh", gmsh.__version__)
seen = {name: load(f"{name}.ply") for name in ("float", "text", "normals", "double")}
for name, result in seen.items():
    print(f"{name}: {'loads' if result is True else result}")
assert seen["float"] is True and seen["text"] is True, "that changed"
assert all(str(seen[name]).startswith("Wrong node index") for name in ("normals", "double"))
PYTHON
