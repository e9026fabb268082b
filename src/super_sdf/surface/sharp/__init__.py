"""Sharp edges and corners: marching cubes with a further vertex on each feature of the solid.

Marching cubes has its vertices on lattice edges, so it cuts the solid's edges off. Here every patch
of the surface in a cell that holds an edge or a corner gets a vertex there and becomes a fan round
it; the side between two fans is turned so that it joins their vertices (extended marching cubes).
Elsewhere the mesh is that of marching cubes, and it is a closed manifold for the same reason.

In steps:

    patches     finds voxels where the field's gradient turns, lists the patches in their cells, and
                joins them to triangles in the end
    planes      gives each crossing the plane of its face, not rounded off as the field is at edges
    wedges      meets these planes, and moves the point so that it agrees with the samples' spheres
    features    tells edges from rounded ground, and moves the vertices beside them; it calls all
                the others, in order
    folds       undoes what makes triangles intersect (which do says triangle_pairs)

Reference: Kobbelt, Botsch, Schwanecke and Seidel, "Feature Sensitive Surface Extraction from Volume
Data", 2001.

Positions are in fine spacings, from node (0, 0, 0) of the fine lattice.
"""
