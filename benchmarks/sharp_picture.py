"""The picture in docs/sharp.md: three CAD parts, sampled at 32^3, and their edges close up.

    python -m export.parts PARTS
    python -m benchmarks.sharp_picture PARTS [OUT.png]      # needs the extra view

The parts are turned as ``super-sdf evaluate PARTS --turned 0`` turns them, so that their faces do
not lie along the lattice, and drawn upright. Each row shows a part, and one place of it in three
meshes. The shading is flat: every triangle shows.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from super_sdf import Mesh, load_network
from super_sdf.evaluation.cases import Case, Setting, Shape, turn_of
from super_sdf.evaluation.methods import coarse_surface, our_surface
from super_sdf.options import MARCHING, SHARP
from super_sdf.pictures.page import Page, write_picture
from super_sdf.pictures.rendering import Frame, Panel, draw_panel, view_axes

TARGET = Path("docs/sharp.png")
SEED = 0
SETTING = Setting(32)
MESHERS = MARCHING, SHARP
PIXELS = 340
COLOURS = 96  # of the palette: a third of the bytes, and no difference to be seen
MARGIN = 1.06
RED = 200, 30, 30
TITLES = "marching cubes of the grid", "--mesher marching", "--mesher sharp"


@dataclass(frozen=True)
class Place:
    """What a row shows: a part, the direction to the viewer, and the middle of the close-up.

    Directions and positions are those of the upright part; its box has a diagonal of 1. ``half``
    is half the side of the close-up.
    """

    part: str
    view: tuple[float, float, float]
    middle: tuple[float, float, float]
    half: float


PLACES = (
    Place("part-03-clevis", (0.6, -1.0, 0.5), (0.0, -0.1, 0.2), 0.14),
    Place("part-02-rod", (0.6, -1.0, 0.7), (0.2, 0.0, 0.1), 0.14),
    Place("part-16-slide", (0.6, -1.0, 0.6), (0.0, -0.3, 0.03), 0.14),
)


def meshes_of(shape: Shape) -> list[Mesh]:
    """Return the meshes of a row, in the order of ``TITLES``."""
    case, network = Case(shape, SETTING), load_network()
    coarse = coarse_surface(case, network, table="lorensen")
    return [coarse.mesh, *(our_surface(case, network, mesher=name).mesh for name in MESHERS)]


def frames_of(place: Place, mesh: Mesh) -> tuple[Frame, Frame]:
    """Return the square frames of the whole mesh and of the close-up."""
    upright = view_axes("z", place.view)
    axes = upright @ turn_of(place.part, SEED).T  # directions in the turned part's world
    points = mesh.vertices @ axes.T
    low, high = points.min(0), points.max(0)
    half = float((high - low)[:2].max()) / 2 * MARGIN
    whole = Frame(axes, (low + high) / 2, half, (1.0, 1.0))
    return whole, Frame(axes, upright @ np.array(place.middle), place.half, (1.0, 1.0))


def mark(image: NDArray[np.uint8], whole: Frame, close: Frame) -> None:
    """Outline in the picture of the whole part what the close-up shows."""
    scale = PIXELS / 2 / whole.half
    right, up = (close.centre - whole.centre)[:2] * scale
    half = close.half * scale
    low = np.round([PIXELS / 2 - up - half, PIXELS / 2 + right - half]).astype(int)
    high = np.round(low + 2 * half).astype(int)
    (top, left), (bottom, end) = low.clip(0, PIXELS - 2), high.clip(2, PIXELS)
    for rows in (slice(top, top + 2), slice(bottom - 2, bottom)):
        image[rows, left:end] = RED
    for columns in (slice(left, left + 2), slice(end - 2, end)):
        image[top:bottom, columns] = RED


def row_of(folder: Path, place: Place) -> list[NDArray[np.uint8]]:
    """Return the pictures of a row: the whole part, sharp, and the place in three meshes."""
    meshes = meshes_of(Shape.read(folder / f"{place.part}.ply", SEED))
    whole, close = frames_of(place, meshes[-1])
    overview = draw_panel(Panel(meshes[-1]), whole, PIXELS)
    mark(overview, whole, close)
    return [overview, *(draw_panel(Panel(mesh), close, PIXELS) for mesh in meshes)]


def main() -> None:
    """Draw the rows and write them as one PNG file with a palette."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("parts", type=Path, help="folder of python -m export.parts")
    parser.add_argument("out", nargs="?", type=Path, default=TARGET, help=f"default: {TARGET}")
    words = parser.parse_args()
    images = [image for place in PLACES for image in row_of(words.parts, place)]
    titles = [title for place in PLACES for title in (place.part, *TITLES)]
    page = Page(PIXELS, images, titles, columns=1 + len(TITLES), foot=0.0)
    write_picture(page.figure, words.out)
    Image.open(words.out).convert("RGB").quantize(COLOURS).save(words.out, optimize=True)


if __name__ == "__main__":
    main()
