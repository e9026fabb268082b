"""The pictures in README and of sharp edges.

    python -m lab picture [GRID.npz] [OUT.png]       # coarse marching cubes beside super-sdf
    python -m export.parts PARTS
    python -m lab picture PARTS [OUT.png]            # three CAD parts at 32^3, and their edges

The parts are turned as by ``--turned 0``, so that their faces do not lie along the lattice, and
drawn upright. Each row shows a part, and one place of it in three meshes. The shading is flat:
every triangle shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from super_sdf import Mesh, load_network, read_grid, reconstruct

from . import parser_of
from .drawing import Frame, Page, Panel, draw_panel, view_axes, write_picture
from .methods import make_surface
from .shapes import Case, Setting, Shape, turn_of
from .surfaces import isosurface

EXAMPLE, EXAMPLE_TARGET = Path("examples/part.npz"), Path("examples/part.png")
PARTS_TARGET = Path("docs/images/sharp.png")
SEED = 0
METHODS = {"marching cubes of the grid": "mc", "super-sdf, --mesher marching": "ours-marching",
           "super-sdf": "ours"}  # fmt: skip
PIXELS, LARGE_PIXELS = 340, 440
COLOURS = 96  # of the palette: a third of the bytes, and no difference to be seen
MARGIN = 1.06
RED = 200, 30, 30
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Place:
    """What a row shows: a part, the direction to the viewer, and the middle of the close-up.

    Directions and positions are those of the upright part; its box has a diagonal of 1. ``half``
    is half the side of the close-up.
    """

    part: str
    view: tuple[float, float, float]
    middle: tuple[float, float, float]
    half: float = 0.14


PLACES = (
    Place("part-03-clevis", (0.6, -1.0, 0.5), (0.0, -0.1, 0.2)),
    Place("part-02-rod", (0.6, -1.0, 0.7), (0.2, 0.0, 0.1)),
    Place("part-16-slide", (0.6, -1.0, 0.6), (0.0, -0.3, 0.03)),
)
EXAMPLE_PLACE = Place("", (1.0, 1.4, 1.1), (0.22, 0.4, 0.2), 0.3)  # in boxes, from the middle


def frames_of(
    place: Place, mesh: Mesh, turn: NDArray[np.float64], middle: NDArray[np.float64], half: float
) -> tuple[Frame, Frame]:
    """Return the square frames of the whole mesh and of the close-up."""
    upright = view_axes("z", place.view)
    axes = upright @ turn.T  # directions in the turned part's world
    points = mesh.vertices @ axes.T
    low, high = points.min(0), points.max(0)
    whole = Frame(axes, (low + high) / 2, float((high - low)[:2].max()) / 2 * MARGIN)
    return whole, Frame(axes, upright @ middle, half)


def mark(image: Picture, whole: Frame, close: Frame) -> None:
    """Outline in the picture of the whole mesh what the close-up shows."""
    pixels = len(image)
    scale = pixels / 2 / whole.half
    right, up = (close.centre - whole.centre)[:2] * scale
    half = close.half * scale
    low = np.round([pixels / 2 - up - half, pixels / 2 + right - half]).astype(int)
    high = np.round(low + 2 * half).astype(int)
    (top, left), (bottom, end) = low.clip(0, pixels - 2), high.clip(2, pixels)
    for rows in (slice(top, top + 2), slice(bottom - 2, bottom)):
        image[rows, left:end] = RED
    for columns in (slice(left, left + 2), slice(end - 2, end)):
        image[top:bottom, columns] = RED


def row_of(meshes: Sequence[Mesh], frames: tuple[Frame, Frame], pixels: int) -> list[Picture]:
    """Return the pictures of a row: the last mesh, whole, and the close-up of each."""
    whole, close = frames
    overview = draw_panel(Panel(meshes[-1]), whole, pixels)
    mark(overview, whole, close)
    return [overview, *(draw_panel(Panel(mesh), close, pixels) for mesh in meshes)]


def row_of_part(folder: Path, place: Place) -> list[Picture]:
    """Return the pictures of a part at 32^3, turned, by each of ``METHODS``."""
    case = Case(Shape.read(folder / f"{place.part}.ply", SEED), Setting(32))
    network = load_network()
    meshes = [make_surface(method, case, network).mesh for method in METHODS.values()]
    turn, middle = turn_of(place.part, SEED), np.array(place.middle)
    return row_of(meshes, frames_of(place, meshes[-1], turn, middle, place.half), PIXELS)


def draw_parts(folder: Path, target: Path) -> None:
    """Draw the rows of three parts."""
    images = [image for place in PLACES for image in row_of_part(folder, place)]
    titles = [title for place in PLACES for title in (place.part, *METHODS)]
    save(Page(PIXELS, images, titles, columns=1 + len(METHODS)), target)


def draw_example(source: Path, target: Path) -> None:
    """Draw a grid's mesh by super-sdf, and a place of it in coarse marching cubes, too."""
    grid = read_grid(source)
    coarse = isosurface(np.array(grid.values, np.float32), grid.voxel_size, 0.0)
    meshes = [coarse.transformed(np.eye(3), np.array(grid.origin)), reconstruct(grid)]
    low, high = meshes[-1].vertices.min(0), meshes[-1].vertices.max(0)
    middle = (low + high) / 2 + (high - low) * EXAMPLE_PLACE.middle
    half = EXAMPLE_PLACE.half * float((high - low).max()) / 2
    frames = frames_of(EXAMPLE_PLACE, meshes[-1], np.eye(3), middle, half)
    counts = [f"{len(mesh.faces):,} triangles" for mesh in meshes]
    titles = ["super-sdf", f"marching cubes of the grid, {counts[0]}", f"super-sdf, {counts[1]}"]
    save(Page(LARGE_PIXELS, row_of(meshes, frames, LARGE_PIXELS), titles, columns=3), target)


def save(page: Page, target: Path) -> None:
    """Write a page as a PNG file with a palette."""
    write_picture(page.figure, target)
    Image.open(target).convert("RGB").quantize(COLOURS).save(target, optimize=True)


def main() -> None:
    """Draw the picture of a grid, or of a folder of parts."""
    parser = parser_of(__doc__)
    parser.add_argument("source", nargs="?", type=Path, default=EXAMPLE)
    parser.add_argument("out", nargs="?", type=Path)
    words = parser.parse_args()
    if words.source.is_dir():
        draw_parts(words.source, words.out or PARTS_TARGET)
    else:
        draw_example(words.source, words.out or EXAMPLE_TARGET)
