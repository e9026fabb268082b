#!/usr/bin/env bash
# An NRRD file with spacings and axis mins, but without centerings, as pynrrd writes one: ITK takes
# its samples for cells and puts the first half a spacing from the minimum. With "node" it does not.
# With a space beside the spacings, which the format allows, ITK refuses the file.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
cat > "$scratch/finding.py" << 'PYTHON'
import os, sys
import nrrd, numpy as np, SimpleITK as sitk

os.chdir(sys.argv[1])
values = np.zeros((4, 5, 6), np.float32)
place = {"spacings": [0.5, 1.0, 2.0], "axis mins": [10.0, 20.0, 30.0]}

def origin(**more):
    nrrd.write("a.nrrd", values, {**place, **more})
    try:
        return sitk.ReadImage("a.nrrd").GetOrigin()
    except RuntimeError as error:
        return "refused: " + str(error).strip().splitlines()[-1].split(": ")[-1]

print("SimpleITK", sitk.Version.VersionString(), "pynrrd", nrrd.__version__)
bare, node, cell = origin(), origin(centerings=["node"] * 3), origin(centerings=["cell"] * 3)
space = origin(space="left-posterior-superior")
print("the minimum stated:", *place["axis mins"], "; origin without centerings:", *bare)
print("with node:", *node, "; with cell:", *cell, "; with a space beside the spacings:", space)
half = (10.25, 20.5, 31.0)
if not (np.allclose(bare, half) and np.allclose(node, (10, 20, 30)) and np.allclose(cell, half)):
    sys.exit("that changed")
if not str(space).startswith("refused"):
    sys.exit("that changed: a space beside spacings is read")
print("So the same file lies half a voxel apart for a reader that takes the minimum as it stands.")
PYTHON
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install -q numpy==2.2.6 pynrrd==1.1.3 SimpleITK==2.5.2
"$scratch/venv/bin/python" "$scratch/finding.py" "$scratch"
