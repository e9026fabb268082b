"""Draw meshes side by side, off screen: flat shading, one camera, one parallel projection.

    python -m lab picture                            # README's picture, of examples/part.npz
    python -m lab picture PARTS                      # three CAD parts at 32^3, and their edges

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
from super_sdf.errors import DeviceError

from . import parser_of
from .methods import make_surface
from .shapes import Case, Setting, Shape, turn_of
from .surfaces import isosurface
from .tables import label_of

EXAMPLE, PARTS_TARGET = Path("examples/part.npz"), Path("docs/images/sharp.png")
METHODS = ("mc", "ours-marching", "ours")
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
    for number, panel in enumerate(panels):
        plotter = pyvista.Plotter(off_screen=True, window_size=[2 * pixels] * 2)
        plotter.set_background("white")
        points = panel.mesh.vertices.astype(np.float64)
        points = points if panel.turn is None else points @ panel.turn  # upright
        if len(panel.mesh.faces):
            surface = pyvista.PolyData.from_regular_faces(points, panel.mesh.faces)
            plotter.add_mesh(surface, show_scalar_bar=False, smooth_shading=False, **SHADED)
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
    (view, middle), turn = PLACES[name], turn_of(name, SEED)
    meshes = [make_surface(method, case, network).mesh for method in METHODS]
    close = [
        Panel(mesh, label_of(method), view, np.array(middle), CLOSE, turn)
        for method, mesh in zip(METHODS, meshes)
    ]
    return [Panel(meshes[-1], name, view, turn=turn), *close]


def panels_of_grid(source: Path) -> list[Panel]:
    """Return a grid's mesh, and a place of it by marching cubes of the grid and by super-sdf."""
    grid = read_grid(source)
    coarse = isosurface(np.array(grid.values, np.float32), grid.voxel_size, 0.0)
    ours = reconstruct(grid)
    low, high = ours.vertices.min(0), ours.vertices.max(0)
    middle, half = (low + high) / 2 + (high - low) * EXAMPLE_MIDDLE, 0.15 * (high - low).max()
    pair = {"mc": coarse.transformed(np.eye(3), np.array(grid.origin)), "ours": ours}
    close = [
        Panel(
            mesh, f"{label_of(method)}, {len(mesh.faces):,} triangles", EXAMPLE_VIEW, middle, half
        )
        for method, mesh in pair.items()
    ]
    return [Panel(ours, "super-sdf", EXAMPLE_VIEW), *close]


def main() -> None:
    """Draw a grid, or a folder of parts."""
    parser = parser_of(__doc__)
    parser.add_argument("source", nargs="?", type=Path, default=EXAMPLE, help=".npz, or a folder")
    parser.add_argument("--out", type=Path, help="PNG file; default: the picture in the documents")
    words = parser.parse_args()
    if words.source.is_dir():
        panels = [panel for name in PLACES for panel in panels_of_part(words.source, name)]
        draw(panels, words.out or PARTS_TARGET, 4, 340)
    else:
        draw(panels_of_grid(words.source), words.out or words.source.with_suffix(".png"), 3)
