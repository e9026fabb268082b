#!/usr/bin/env bash
# From STEP to tetrahedra: a plate, its distances, its mesh, and a volume mesh of that.
#     pip install gmsh meshio pytetwild pyvista    # beside super-sdf with the extras eval and simplify
#     bash examples/tools/tetrahedra.sh            # writes into the current folder
set -euo pipefail

cat > plate.geo << 'END'
SetFactory("OpenCASCADE");
Box(1) = {0, 0, 0, 80, 50, 12};
Cylinder(2) = {20, 25, 0, 0, 0, 12, 8};
Cylinder(3) = {60, 25, 0, 0, 0, 12, 8};
Box(4) = {32, 15, 5, 16, 20, 7};
BooleanDifference{ Volume{1}; Delete; }{ Volume{2, 3, 4}; Delete; }
END
gmsh plate.geo -0 -format step -o plate.step > gmsh.log

gmsh plate.step -2 -clmax 2 -clcurv 90 -o plate.stl >> gmsh.log
super-sdf sample plate.stl plate.npz -n 64 --force
super-sdf upsample plate.npz part.stl --tolerance 0.05 --force
super-sdf check part.stl plate.npz --no-faults

python - << 'END'
import pytetwild
import pyvista

solid = pytetwild.tetrahedralize_pv(pyvista.read("part.stl"), epsilon=5e-4)
least = solid.cell_quality("scaled_jacobian")["scaled_jacobian"].min()
pyvista.save_meshio("part.msh", solid)
print(f"fTetWild: {solid.n_cells:,} tetrahedra, least scaled Jacobian {least:.2f} (flat: 0, regular: 1)")
assert least > 0.05
END
