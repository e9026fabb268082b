#!/usr/bin/env bash
# trimesh 5.2.0 and pymeshlab 2025.7 read the base colour of a .glb file as sRGB: parts are too dark.
#
# Guess: glTF's baseColorFactor is linear by its standard, so 0.578, 0.045, 0.021 is read as the
# 8-bit colour 200, 60, 40, which Blender shows. Seen: 147, 12, 5, which is 255 times the factor.
# trimesh writes colours in the same way: its 200, 60, 40 becomes the factor 0.784, 0.235, 0.157,
# which is 229, 133, 110 for readers that follow the standard. A round trip through trimesh hides it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet 'trimesh==5.2.0' 'pymeshlab==2025.7.post1' 'numpy==2.4.6' 'pillow==12.0.0'
cd "$folder"
venv/bin/python - << 'PYTHON'
import io
import json
import struct

import numpy as np
import pymeshlab
import trimesh

COLOUR = np.array([200, 60, 40])


def linear(levels):
    share = np.asarray(levels) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def srgb(shares):
    shares = np.asarray(shares)
    low, high = 12.92 * shares, 1.055 * shares ** (1 / 2.4) - 0.055
    return np.rint(255 * np.where(shares <= 0.0031308, low, high)).astype(int)


corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")
faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], "<u4")
data = corners.tobytes() + faces.tobytes()
shown = {"baseColorFactor": [*linear(COLOUR).tolist(), 1], "metallicFactor": 0}
scene = {
    "asset": {"version": "2.0"},
    "scene": 0,
    "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
    "materials": [{"name": "red", "pbrMetallicRoughness": shown}],
    "accessors": [
        {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4,
         "min": [0, 0, 0], "max": [1, 1, 1]},
        {"bufferView": 1, "componentType": 5125, "type": "SCALAR", "count": 12},
    ],
    "bufferViews": [
        {"buffer": 0, "byteLength": 48},
        {"buffer": 0, "byteOffset": 48, "byteLength": 48},
    ],
    "buffers": [{"byteLength": len(data)}],
}  # fmt: skip
text = json.dumps(scene).encode()
text += b" " * (-len(text) % 4)
with open("red.glb", "wb") as file:
    file.write(struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(data), len(text), b"JSON"))
    file.write(text + struct.pack("<I4s", len(data), b"BIN\0") + data)

wrong = (255 * linear(COLOUR)).astype(int)
print("in the file, linear:", linear(COLOUR).round(3), "which is the colour", COLOUR)
(part,) = trimesh.load("red.glb").geometry.values()
by_trimesh = np.array(part.visual.material.main_color[:3], int)
print(f"trimesh {trimesh.__version__}:", by_trimesh)
meshes = pymeshlab.MeshSet()
meshes.load_new_mesh("red.glb")
by_meshlab = np.rint(255 * meshes.current_mesh().vertex_color_matrix()[0, :3]).astype(int)
print("pymeshlab 2025.7:", by_meshlab)
assert np.abs(by_trimesh - wrong).max() <= 1 and np.abs(by_meshlab - wrong).max() <= 1

material = trimesh.visual.material.PBRMaterial(baseColorFactor=[*COLOUR.tolist(), 255])
part.visual = trimesh.visual.TextureVisuals(material=material)
written = io.BytesIO(part.export(file_type="glb")).getvalue()
size = struct.unpack("<I", written[12:16])[0]
(made,) = json.loads(written[20 : 20 + size])["materials"]
factor = made["pbrMetallicRoughness"]["baseColorFactor"][:3]
print("written by trimesh:", np.round(factor, 3), "which is the colour", srgb(factor))
assert np.allclose(factor, COLOUR / 255)
PYTHON
