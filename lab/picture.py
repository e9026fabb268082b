"""Draw meshes side by side, off screen: flat shading, one camera, one parallel projection.

    python -m lab picture PARTS                      # the CAD parts of README and "Sharp edges"
    python -m lab picture case.nii.gz                # all labels of an image, each in a colour
    python -m lab picture                            # a level set: a splash
    python -m lab picture --masks                    # a mask beside other tools
    python -m lab picture --weak MESHES              # details under a voxel, for the card of base
    python -m lab picture grid.npz --out grid.png    # any other grid

PARTS is the folder of ``python -m export.parts PARTS``. Lengths in a picture can be compared.
"""

from __future__ import annotations

import colorsys
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from super_sdf import Mesh, SdfGrid, load_network, make_grid, read_grid, reconstruct
from super_sdf.errors import DeviceError
from super_sdf.labels.reconstruct import reconstruct_labels

from . import masks, parser_of
from .methods import make_surface
from .shapes import Case, Setting, Shape, turn_of
from .surfaces import closed_isosurface
from .tables import label_of

IMAGES, CARDS = Path("docs/images"), Path("src/super_sdf/models")
FIRST, FIRST_SIZE = "part-06-housing", 48  # README's part
PARTS, PARTS_SIZE = ("part-03-clevis", "part-02-rod", "part-16-slide"), 32
METHODS = ("mc", "ours-marching", "ours")
WEAK = ("tm-fixed_top", "p2m-thorn2")  # of the validation shapes: notches and thorns under a voxel
AXES = np.array([[5, 3, 0], [-2.7, 4.5, 6.8]])  # of a panel, in the world: to the right, and up
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)
MARGIN, PIXELS = 1.06, (640, 480)
SEED, CAPTION, PALETTE = 0, 36, 96  # of the turn; pixels above a panel; colours of the file
MASKED = ("mc", "surfacenets", "slicer-0.5", "serra-faired", "ours")
BALL = ((3, 0, 12), (3, 0, 12), 13)  # beside the vessels
SPLASH_SIZE, ARMS = 48, 11  # samples a side; jets of the splash
SHADED = {"ambient": 0.25, "diffuse": 1.0, "specular": 0.25, "specular_power": 20}
DRAW = (  # what VTK does before it draws anything
    "from vtkmodules.vtkRenderingOpenGL2 import vtkOpenGLRenderer;"
    "from vtkmodules.vtkRenderingCore import vtkRenderWindow;"
    "window = vtkRenderWindow(); window.SetOffScreenRendering(1); window.Render()"
)


@dataclass(frozen=True, eq=False)
class Panel:
    """Meshes, each in a colour, as seen from one direction."""

    meshes: Sequence[Mesh]
    title: str
    turn: NDArray[np.float64] | None = None  # (3, 3), that turned them; they are drawn upright


@cache
def can_draw() -> bool:
    """Return whether VTK finds OpenGL: where it does not, as on a bare Debian, it crashes."""
    return not subprocess.run([sys.executable, "-c", DRAW], capture_output=True).returncode


def draw(
    panels: Sequence[Panel], target: Path, columns: int, pixels: tuple[int, int] = PIXELS
) -> None:
    """Draw panels row by row, as a PNG file with a palette; DeviceError without OpenGL."""
    if not can_draw():
        raise DeviceError(
            "drawing meshes needs OpenGL, and VTK finds none here: on Debian and Ubuntu, "
            "apt-get install libegl1 libgl1-mesa-dri"
        )
    import pyvista  # takes a second
    from PIL import Image, ImageDraw, ImageFont

    (wide, high), rows = pixels, -(-len(panels) // columns)
    page = Image.new("RGB", (columns * wide, rows * (high + CAPTION)), "white")
    for number, panel in enumerate(panels):
        plotter = pyvista.Plotter(off_screen=True, window_size=[2 * wide, 2 * high])
        plotter.set_background("white")
        turn = np.eye(3) if panel.turn is None else panel.turn
        upright = [mesh.vertices.astype(np.float64) @ turn for mesh in panel.meshes]
        for points, mesh, colour in zip(upright, panel.meshes, colours(len(upright))):
            surface = pyvista.PolyData.from_regular_faces(points, mesh.faces)
            plotter.add_mesh(surface, color=colour, smooth_shading=False, **SHADED)
        flat = np.concatenate(upright) @ AXES.T
        low, top = flat.min(0), flat.max(0)
        middle, size = (low + top) / 2 @ AXES, top - low
        plotter.camera_position = [middle + 9 * size.max() * np.cross(*AXES), middle, (0, 0, 1)]
        plotter.camera.parallel_projection = True
        plotter.camera.parallel_scale = MARGIN / 2 * max(size[1], size[0] * high / wide)
        plotter.reset_camera_clipping_range()
        image = Image.fromarray(plotter.screenshot(return_img=True)[..., :3])
        plotter.close()
        corner = (number % columns * wide, number // columns * (high + CAPTION))
        page.paste(image.resize(pixels), (corner[0], corner[1] + CAPTION))
        font = ImageFont.load_default(size=wide // 22)
        place = (corner[0] + 8, corner[1] + 4)
        ImageDraw.Draw(page).text(place, panel.title, fill="black", font=font)
    page.quantize(PALETTE).save(target, optimize=True)


def colours(count: int) -> list[tuple[float, ...]]:
    """Return a colour for each mesh: grey blue for a single one, else around the circle of hues."""
    hues = 0.62 + 0.618 * np.arange(count)  # neighbours in the list differ most
    return [colorsys.hsv_to_rgb(hue % 1, 0.16 if count == 1 else 0.42, 0.87) for hue in hues]


def panels_of_mesh(
    path: Path, size: int, methods: Sequence[str], seed: int | None = SEED
) -> list[Panel]:
    """Return a mesh, turned if there is a seed, sampled, and meshed by some methods."""
    case = Case(Shape.read(path, seed), Setting(size))
    meshes = [make_surface(method, case, load_network()).mesh for method in methods]
    titles = [f"{label_of(method)}, {size}^3" for method in methods]
    turn = None if seed is None else turn_of(path.stem, seed)
    return compared(zip(titles, ([mesh] for mesh in meshes)), turn)


def compared(
    found: Iterable[tuple[str, Sequence[Mesh]]], turn: NDArray[np.float64] | None = None
) -> list[Panel]:
    """Return a panel for each title and its meshes, with the number of triangles."""
    return [
        Panel(meshes, f"{title}: {sum(len(mesh.faces) for mesh in meshes):,} triangles", turn)
        for title, meshes in found
    ]


def coarse(grid: SdfGrid) -> Mesh:
    """Return marching cubes of the samples of a grid whose axes are those of the world."""
    return closed_isosurface(np.array(grid.values, np.float32), grid.spacing, grid.origin)


def panels_of_grid(grid: SdfGrid) -> list[Panel]:
    """Return a grid's mesh by marching cubes of the samples and by super-sdf."""
    return compared([("marching cubes", [coarse(grid)]), ("super-sdf", [reconstruct(grid)])])


def panels_of_labels(source: Path) -> list[Panel]:
    """Return all labels of an image by marching cubes of each label, and by super-sdf."""
    meshes = reconstruct_labels(source)
    steps = [coarse(read_grid(source, label=label)) for label in meshes]
    return compared([("marching cubes", steps), ("super-sdf", list(meshes.values()))])


def panels_of_mask() -> list[Panel]:
    """Return a ball with vessels, and what is made of its mask."""
    form = masks.union([BALL, *masks.VESSELS])
    scene = masks.Scene("", "ball with vessels", (partial(masks.surface_of, form),))
    image, spacing, _ = masks.image_of(scene, 1)
    found = {"true surface": [true.mesh for true in masks.truths_of(scene)]}
    found |= {label_of(name): [masks.PEERS[name](image, spacing)[1]] for name in MASKED}
    return compared(found.items(), turn_of(scene.name, masks.TURN))


def splash() -> SdfGrid:
    """Return a level set, cut off at three voxels: a ring of jets that end in drops."""
    h = 2 / SPLASH_SIZE
    points = np.stack(np.indices([SPLASH_SIZE] * 3), -1) * h - 1 + h / 2
    x, y, z = np.moveaxis(points, -1, 0)
    ring, forms = np.hypot(np.hypot(x, y) - 0.45, z + 0.45) - 0.09, list[masks.Form]()
    for angle in 2 * np.pi * np.arange(ARMS) / ARMS:
        out = np.array([np.cos(angle), np.sin(angle), 0])
        low, top = 0.45 * out - [0, 0, 0.45], 0.72 * out + [0, 0, 0.15 * np.cos(3 * angle)]
        forms += [(low, top, 0.045), (top + 0.16 * out, top + 0.16 * out, 0.075)]
    found = np.minimum(ring, masks.union(forms)(points))
    return make_grid(np.clip(found, -3 * h, 3 * h), spacing=h)


def main() -> None:
    """Draw a grid, the labels of an image, or a folder of parts."""
    parser = parser_of(__doc__)
    parser.add_argument("source", nargs="?", type=Path, help="a grid, labels, or a folder of parts")
    parser.add_argument("--out", type=Path, help="PNG file; default: the picture in the documents")
    parser.add_argument("--masks", action="store_true", help="draw a mask beside other tools")
    parser.add_argument("--weak", type=Path, metavar="MESHES", help="draw what base gets wrong")
    words = parser.parse_args()
    source = words.source
    if words.masks:
        draw(panels_of_mask(), words.out or IMAGES / "masks.png", 3, (400, 340))
    elif words.weak:
        panels = []
        for path in (words.weak / f"{name}.ply" for name in WEAK):
            panels += panels_of_mesh(path, PARTS_SIZE, METHODS[::2], seed=None)
            panels += compared([("true surface", [Shape.read(path).mesh])])
        draw(panels, words.out or CARDS / "base-weak.png", 3, (400, 340))
    elif source is None:
        draw(panels_of_grid(splash()), words.out or IMAGES / "level-set.png", 2)
    elif source.is_dir():
        first = panels_of_mesh(source / f"{FIRST}.ply", FIRST_SIZE, METHODS[::2])
        draw(first, words.out or IMAGES / "part.png", 2)
        parts = [panels_of_mesh(source / f"{name}.ply", PARTS_SIZE, METHODS) for name in PARTS]
        draw([panel for row in parts for panel in row], IMAGES / "sharp.png", 3, (400, 340))
    elif source.name.endswith((".nii.gz", ".nii", ".seg.nrrd")):
        draw(panels_of_labels(source), words.out or IMAGES / "organs.png", 2)
    else:
        draw(panels_of_grid(read_grid(source)), words.out or source.with_suffix(".png"), 2)
