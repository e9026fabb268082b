"""Draw meshes side by side, off screen: flat shading, one camera, one parallel projection.

    python -m lab picture                            # README's picture, of examples/part.npz
    python -m lab picture PARTS                      # three CAD parts at 32^3, and their edges
    python -m lab picture a.ply b.ply --out pair.png # meshes of your own
    python -m lab picture a.ply --reference true.ply # coloured by distance to a reference

PARTS is the folder of ``python -m export.parts PARTS``. Lengths in a picture can be compared.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from super_sdf import Mesh, load_network, read_grid, reconstruct
from super_sdf.errors import DeviceError, OptionError
from super_sdf.truth.mesh_files import read_mesh
from super_sdf.truth.solid import Solid

from . import parser_of
from .methods import make_surface
from .shapes import Case, Setting, Shape, turn_of
from .surfaces import isosurface

EXAMPLE, PARTS_TARGET = Path("examples/part.npz"), Path("docs/images/sharp.png")
METHODS = {"marching cubes of the grid": "mc", "super-sdf, --mesher marching": "ours-marching",
           "super-sdf": "ours"}  # fmt: skip
# Of each part: the direction to the viewer and the middle of the close-up, upright, diagonal 1.
PLACES = {
    "part-03-clevis": ((0.6, -1.0, 0.5), (0.0, -0.1, 0.2)),
    "part-02-rod": ((0.6, -1.0, 0.7), (0.2, 0.0, 0.1)),
    "part-16-slide": ((0.6, -1.0, 0.6), (0.0, -0.3, 0.03)),
}
EXAMPLE_VIEW, EXAMPLE_MIDDLE = (1.0, 1.4, 1.1), (0.22, 0.4, 0.2)  # in boxes, from the middle
VIEW, CLOSE, MARGIN, PIXELS = (0.6, -1.0, 0.5), 0.14, 1.06, 440
SEED, CAPTION = 0, 36  # of the turn; pixels above a panel
SHADED = {"color": "#b9c7df", "ambient": 0.25, "diffuse": 1.0, "specular": 0.25,
          "specular_power": 20}  # fmt: skip
BY_ERROR = {"cmap": "magma_r", "ambient": 0.5, "diffuse": 0.55, "specular": 0.0}
DRAW = (  # what VTK does before it draws anything
    "from vtkmodules.vtkRenderingOpenGL2 import vtkOpenGLRenderer;"
    "from vtkmodules.vtkRenderingCore import vtkRenderWindow;"
    "window = vtkRenderWindow(); window.SetOffScreenRendering(1); window.Render()"
)


@dataclass(frozen=True, eq=False)
class Panel:
    """A mesh, and what of it is seen."""

    mesh: Mesh
    title: str
    view: tuple[float, float, float] = VIEW  # from the mesh to the viewer
    middle: NDArray[np.float64] | None = None  # (3,), world; default: the middle of the mesh
    half: float | None = None  # half the height of the panel, world; default: all of the mesh
    turn: NDArray[np.float64] | None = None  # (3, 3), that turned the mesh; it is drawn upright
    values: NDArray[np.float64] | None = None  # distances of the vertices, shown as colours


@cache
def can_draw() -> bool:
    """Return whether VTK finds OpenGL: where it does not, as on a bare Debian, it crashes."""
    return not subprocess.run([sys.executable, "-c", DRAW], capture_output=True).returncode


def draw(panels: Sequence[Panel], target: Path, columns: int, pixels: int = PIXELS) -> None:
    """Draw panels row by row, as a PNG file with a palette; DeviceError without OpenGL."""
    if not can_draw():
        raise DeviceError(
            "drawing meshes needs OpenGL, and VTK finds none here: on Debian and Ubuntu, "
            "apt-get install libegl1 libgl1-mesa-dri"
        )
    import pyvista  # takes a second
    from PIL import Image, ImageDraw

    rows = -(-len(panels) // columns)
    tall = pixels + CAPTION
    page = Image.new("RGB", (columns * pixels, rows * tall), "white")
    highest = max((float(p.values.max()) for p in panels if p.values is not None), default=1.0)
    for number, panel in enumerate(panels):
        plotter = pyvista.Plotter(off_screen=True, window_size=[2 * pixels] * 2)
        plotter.set_background("white")
        points = panel.mesh.vertices.astype(np.float64)
        points = points if panel.turn is None else points @ panel.turn  # upright
        if len(panel.mesh.faces):
            look = dict(SHADED)
            if panel.values is not None:
                look = {**BY_ERROR, "scalars": panel.values, "clim": (0, highest)}
            surface = pyvista.PolyData.from_regular_faces(points, panel.mesh.faces)
            plotter.add_mesh(surface, show_scalar_bar=False, smooth_shading=False, **look)
            middle = (points.min(0) + points.max(0)) / 2 if panel.middle is None else panel.middle
            towards = np.array(panel.view) / np.linalg.norm(panel.view)
            size = float(np.linalg.norm(np.ptp(points, axis=0)))
            plotter.camera_position = [middle + 4 * size * towards, middle, (0, 0, 1)]
            plotter.camera.parallel_projection = True
            plotter.camera.parallel_scale = panel.half or size / 2 * MARGIN
            plotter.reset_camera_clipping_range()
        image = Image.fromarray(plotter.screenshot(return_img=True)[..., :3])
        plotter.close()
        corner = (number % columns * pixels, number // columns * tall)
        page.paste(image.resize((pixels, pixels)), (corner[0], corner[1] + CAPTION))
        ImageDraw.Draw(page).text((corner[0] + 8, corner[1] + 12), panel.title, fill="black")
    page.quantize(96).save(target, optimize=True)


def panels_of_part(folder: Path, name: str) -> list[Panel]:
    """Return a part at 32^3, turned: whole, and a place of it by each of ``METHODS``."""
    case, network = Case(Shape.read(folder / f"{name}.ply", SEED), Setting(32)), load_network()
    view, middle = PLACES[name]
    turn = turn_of(name, SEED)
    meshes = [make_surface(method, case, network).mesh for method in METHODS.values()]
    close = [
        Panel(mesh, title, view, np.array(middle), CLOSE, turn)
        for title, mesh in zip(METHODS, meshes)
    ]
    return [Panel(meshes[-1], name, view, turn=turn), *close]


def panels_of_grid(source: Path) -> list[Panel]:
    """Return a grid's mesh, and a place of it by marching cubes of the grid and by super-sdf."""
    grid = read_grid(source)
    coarse = isosurface(np.array(grid.values, np.float32), grid.voxel_size, 0.0)
    meshes = [coarse.transformed(np.eye(3), np.array(grid.origin)), reconstruct(grid)]
    low, high = meshes[-1].vertices.min(0), meshes[-1].vertices.max(0)
    middle = (low + high) / 2 + (high - low) * EXAMPLE_MIDDLE
    half = 0.15 * float((high - low).max())
    names = ("marching cubes of the grid", "super-sdf")
    close = [
        Panel(mesh, f"{name}, {len(mesh.faces):,} triangles", EXAMPLE_VIEW, middle, half)
        for name, mesh in zip(names, meshes)
    ]
    return [Panel(meshes[-1], "super-sdf", EXAMPLE_VIEW), *close]


def panels_of_meshes(paths: Sequence[Path], reference: Path | None) -> list[Panel]:
    """Return mesh files as panels of one scale; with a reference, coloured by distance to it."""
    meshes = [read_mesh(path) for path in paths]
    size = max(float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) for mesh in meshes)
    truth = Solid(read_mesh(reference)) if reference else None
    return [
        Panel(mesh, path.name, half=size / 2 * MARGIN,
              values=truth and truth.distance(mesh.vertices.astype(np.float64)))
        for path, mesh in zip(paths, meshes)
    ]  # fmt: skip


def main() -> None:
    """Draw a grid, a folder of parts, or meshes."""
    parser = parser_of(__doc__)
    parser.add_argument("sources", nargs="*", type=Path, default=[EXAMPLE])
    parser.add_argument("--reference", type=Path, help="mesh to colour distances to")
    parser.add_argument("--out", type=Path, help="PNG file; default: the picture in the documents")
    words = parser.parse_args()
    first = words.sources[0]
    if first.is_dir():
        panels = [panel for name in PLACES for panel in panels_of_part(first, name)]
        draw(panels, words.out or PARTS_TARGET, 4, 340)
    elif first.suffix == ".npz":
        draw(panels_of_grid(first), words.out or first.with_suffix(".png"), 3)
    elif words.out is None:
        raise OptionError("out is not given: give a PNG file, --out pair.png")
    else:
        panels = panels_of_meshes(words.sources, words.reference)
        draw(panels, words.out, min(len(panels), 4))
