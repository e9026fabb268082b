"""Sharp edges and corners: marching cubes with a further vertex on each feature of the solid.

Marching cubes has its vertices on lattice edges, so it cuts the solid's edges off. Here every patch
of the surface in a cell that holds an edge or a corner gets a vertex there and becomes a fan round
it; the side between two fans is turned so that it joins their vertices (extended marching cubes:
Kobbelt, Botsch, Schwanecke and Seidel, "Feature Sensitive Surface Extraction from Volume Data",
2001). Elsewhere the mesh is that of marching cubes, and closed for the same reason.

``features.find_features`` does it all: ``patches`` near kinks of the field, ``planes`` at their
crossings, the point where these meet, and ``folds`` undone.
"""
