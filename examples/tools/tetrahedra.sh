#!/usr/bin/env bash
# From STEP to tetrahedra: a plate, its distances, its mesh, and two volume meshes of that.
#     pip install gmsh tetgen trimesh      # beside super-sdf with the extras eval and simplify
#     bash examples/tools/tetrahedra.sh    # writes into the current folder
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

gmsh plate.step -2 -clmax 2 -o plate.stl >> gmsh.log
super-sdf sample plate.stl plate.npz -n 64 --force
super-sdf upsample plate.npz part.stl --tolerance 0.05 --force
super-sdf check part.stl plate.npz --no-faults

cat > volume.geo << 'END'
Merge "part.stl";
Surface Loop(1) = {1};
Volume(1) = {1};
END
gmsh volume.geo -3 -o part.msh >> gmsh.log
grep " nodes .* elements" gmsh.log | tail -1

python - << 'END'
import tetgen
import trimesh

part = trimesh.load("part.stl")
solid = tetgen.TetGen(part.vertices, part.faces)
tetrahedra = solid.tetrahedralize(minratio=1.5, mindihedral=10)[1]
print(f"TetGen: {len(tetrahedra):,} tetrahedra")
END
