"""The picture in README: coarse marching cubes beside super-sdf, whole and close up.

    python -m benchmarks.picture [GRID.npz] [OUT.png]          # needs the extra view

Rendered off screen by PyVista from the same meshes that the command line writes.
"""

from __future__ import annotations

import sys

import numpy as np
import pyvista as pv

from super_sdf import Mesh, SdfGrid, read_grid, reconstruct
from super_sdf.evaluation.methods import isosurface

SIZE = (1400, 900)
ZOOM = 2.3
LIGHT_BLUE = "#b9c7df"


def coarse_mesh(grid: SdfGrid) -> Mesh:
    """Return marching cubes of the samples themselves, in world units."""
    mesh = isosurface(np.array(grid.values, np.float32), grid.voxel_size, 0.0)
    return mesh.transformed(np.eye(3), np.array(grid.origin))


def draw(plotter: pv.Plotter, mesh: Mesh, title: str, close: bool) -> None:
    """Draw a mesh, flat shaded, as a whole or around its upper front corner."""
    rows = np.insert(mesh.faces, 0, 3, axis=1)
    plotter.add_mesh(pv.PolyData(mesh.vertices, rows), color=LIGHT_BLUE, specular=0.2)
    plotter.add_text(title, font_size=10, color="black", position="upper_left")
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    middle = (low + high) / 2
    eye = tuple(middle + np.array([1.0, 1.4, 1.1]))
    plotter.camera_position = [eye, tuple(middle), (0, 0, 1)]
    plotter.reset_camera()
    plotter.camera.zoom(1.5)
    if close:
        plotter.camera.focal_point = tuple(low + (high - low) * [0.72, 0.9, 0.7])
        plotter.camera.zoom(ZOOM)


def main() -> None:
    """Render two columns (coarse, ours) and two rows (whole, close up)."""
    source, target = (*sys.argv[1:], "examples/part.npz", "examples/part.png")[:2]
    if len(sys.argv) == 2:
        target = "examples/part.png"
    grid = read_grid(source)
    columns = {"marching cubes of the grid": coarse_mesh(grid), "super-sdf": reconstruct(grid)}
    plotter = pv.Plotter(off_screen=True, shape=(2, 2), window_size=SIZE, border=False)
    for column, (name, mesh) in enumerate(columns.items()):
        for row in range(2):
            plotter.subplot(row, column)
            title = f"{name}, {len(mesh.faces):,} triangles" if row == 0 else ""
            draw(plotter, mesh, title, close=row == 1)
    plotter.set_background("white")
    plotter.screenshot(target)


if __name__ == "__main__":
    main()
