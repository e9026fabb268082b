"""Other people's methods, where their packages are installed (extra ``peers``).

They take minutes per shape, and no factor: the samples alone decide the result's resolution.
"""

from __future__ import annotations

import numpy as np

from ..arrays import IntArray
from ..grid.sdf_grid import SdfGrid
from ..mesh import Mesh
from ..network.decoder import Decoder
from ..truth.sampling import grid_points
from ..truth.solid import Points
from .cases import Case
from .methods import Method, Surface


def samples_of(grid: SdfGrid) -> Points:
    """Return the positions of a grid's samples, (n, 3), C order."""
    return grid_points((grid.shape, grid.voxel_size, np.array(grid.origin)))


def reach_for_the_arcs(case: Case, network: Decoder) -> Surface:
    """Mesh the grid with Reach for the Arcs (Sellán et al. 2024), with its defaults."""
    from gpytoolbox import reach_for_the_arcs

    points = samples_of(case.grid)
    vertices, faces = reach_for_the_arcs(points, np.ravel(case.grid.values).astype(np.float64))
    return Surface(Mesh(np.asarray(vertices), np.asarray(faces, np.int32)))


def dual_contouring(case: Case, network: Decoder) -> Surface:
    """Mesh the grid with Dual Contouring of Signed Distance Data (Carrera et al. 2026)."""
    from gpytoolbox import dual_contouring_of_signed_distance_data

    shape = case.grid.shape
    order = np.arange(np.prod(shape)).reshape(shape).ravel(order="F")  # there i varies fastest
    values = np.ravel(case.grid.values).astype(np.float64)[order]
    vertices, quads = dual_contouring_of_signed_distance_data(
        values, samples_of(case.grid)[order], *shape
    )
    return Surface(Mesh(np.asarray(vertices), split_quads(np.asarray(quads, np.int32))))


def split_quads(quads: IntArray) -> IntArray:
    """Return two triangles, (2 m, 3), for each quadrilateral, (m, 4)."""
    halves: IntArray = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    return halves


PEERS: dict[str, Method] = {"rfta": reach_for_the_arcs, "dual-contouring": dual_contouring}
