"""Pictures of meshes side by side, off screen: PyVista draws each, matplotlib puts them on a page.

All meshes of a picture share one parallel projection, so lengths can be compared.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, MaxNLocator
from numpy.typing import NDArray

from super_sdf.errors import DeviceError, OptionError
from super_sdf.files.output import replacing
from super_sdf.surface.mesh import Mesh
from super_sdf.truth.solid import Distances, Points, Solid

from .metrics import face_vectors

Image = NDArray[np.uint8]

COLUMNS = 4  # most panels in a row
SIZE = 700  # pixels of a panel's long side
DPI = 72  # so that a font size in points is one in pixels
# Light where the error is small, so that the shading shows the shape there.
COLOUR_MAP = "magma_r"
AXES = ("x", "y", "z")
COLOURS = ("shaded", "normal", "error")
# For each axis that may point up: the directions to the right and towards the viewer.
RIGHT_AND_FRONT = {
    "x": ((0, 1, 0), (0, 0, -1)),
    "y": ((1, 0, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, -1, 0)),
}
THREE_QUARTER = 0.6, 1.0, 0.5  # right, front and up of the default view
TOP_PERCENTILE = 99.0  # so that a single stray vertex does not stretch the colours
NORMALS_LEGEND = "colour: direction of the face; red, green, blue are (1 + normal)/2 along x, y, z"
MARGIN = 1.06  # size of the frame over the size of the meshes
NARROWEST = 0.5  # least ratio of a panel's short side to its long one: titles need room
SUPERSAMPLING = 2  # pixels drawn per pixel of the picture, along each axis
DRAW = (  # what VTK does before it draws anything
    "from vtkmodules.vtkRenderingOpenGL2 import vtkOpenGLRenderer;"
    "from vtkmodules.vtkRenderingCore import vtkRenderWindow;"
    "window = vtkRenderWindow(); window.SetOffScreenRendering(1); window.Render()"
)
FOOT = {"shaded": 0.0, "normal": 2.0, "error": 5.0}  # height of the legend, in lines of text
SHADED = {"color": "#b9c7df", "ambient": 0.25, "diffuse": 1.0, "specular": 0.25,
          "specular_power": 20}  # fmt: skip
# mostly ambient, so that the colours match the colour bar
BY_VALUE = {"cmap": COLOUR_MAP, "interpolate_before_map": True, "ambient": 0.5, "diffuse": 0.55,
            "specular": 0.0}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Panel:
    """One mesh of a picture."""

    mesh: Mesh
    title: str = ""
    values: NDArray[Any] | None = None  # one per vertex, shown with ``colour="error"``


@dataclass(frozen=True, eq=False)
class Frame:
    """The view that all panels share: x to the right, y up, z to the viewer, long side -1 to 1."""

    axes: NDArray[np.float64]  # (3, 3), the directions right, up and towards the viewer
    centre: Points  # (3,), along the axes
    half: float  # half of the long side, in world units
    sides: tuple[float, float] = (1.0, 1.0)  # width and height, each over the long side

    def place(self, vertices: NDArray[Any]) -> Points:
        """Return the positions of vertices (n, 3) in the frame, (n, 3) float64."""
        return (vertices.astype(np.float64) @ self.axes.T - self.centre) / self.half


@cache
def can_draw() -> bool:
    """Return whether VTK finds OpenGL: where it does not, as on a bare Debian, it crashes."""
    return not subprocess.run([sys.executable, "-c", DRAW], capture_output=True).returncode


def vertex_errors(mesh: Mesh, reference: Solid) -> Distances:
    """Return the unsigned distance of each vertex to the reference, (n,), in world units."""
    return reference.distance(np.ascontiguousarray(mesh.vertices, np.float64))


def render_panels(
    panels: Sequence[Panel],
    target: Path,
    *,
    colour: str = "shaded",
    up: str = "z",
    size: int = SIZE,
    top: float | None = None,
    unit: str = "",
) -> None:
    """Draw meshes side by side from one camera, as a PNG file; ``size`` is a panel's long side.

    ``top`` is the distance at the end of the colour bar, ``unit`` that of distances.
    """
    frame = fit_frame(panels, view_axes(up))
    values = np.concatenate([[], *(p.values for p in panels if p.values is not None)])
    if top is None:
        top = (float(np.percentile(values, TOP_PERCENTILE)) if len(values) else 0) or 1.0
    images = [draw_panel(panel, frame, size, colour, top) for panel in panels]
    page = Page(size, images, [panel.title for panel in panels], foot=FOOT[colour])
    if colour == "normal":
        page.add_line(NORMALS_LEGEND)
    elif colour == "error" and len(values):
        title = "distance to the reference" + f" ({unit})" * bool(unit)
        page.add_bar(title, top, clipped=bool(values.max() > top))
    write_picture(page.figure, target)


def view_axes(up: str = "z", view: tuple[float, float, float] | None = None) -> NDArray[np.float64]:
    """Return the directions right, up and towards the viewer, one per row, (3, 3)."""
    right, front = np.array(RIGHT_AND_FRONT[up], np.float64)
    upward = np.eye(3)[AXES.index(up)]
    towards = np.array(THREE_QUARTER) @ [right, front, upward] if view is None else np.array(view)
    towards = towards / np.linalg.norm(towards)
    across = np.cross(upward, towards)
    across /= np.linalg.norm(across)
    return np.array([across, np.cross(towards, across), towards])


def fit_frame(panels: Sequence[Panel], axes: NDArray[np.float64]) -> Frame:
    """Return the smallest frame with these axes that holds the faces of all panels."""
    drawn = [panel.mesh.vertices[np.unique(panel.mesh.faces)] for panel in panels]
    points = np.concatenate(drawn).astype(np.float64) @ axes.T
    if not len(points):
        raise OptionError("nothing to draw: no mesh has a face")
    low, high = points.min(0), points.max(0)
    sides = (high - low)[:2]
    longest = float(sides.max()) or 1.0
    wide, tall = (max(float(side) / longest, NARROWEST) for side in sides)
    return Frame(axes, (low + high) / 2, longest / 2 * MARGIN, (wide, tall))


def face_colours(mesh: Mesh) -> Image:
    """Return (n + 1)/2 of each face normal n, in world axes, as a colour, (m, 3) uint8."""
    normals = face_vectors(mesh)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    return np.round((normals + 1) / 2 * 255).astype(np.uint8)


def draw_panel(
    panel: Panel, frame: Frame, size: int, colour: str = "shaded", top: float = 1.0
) -> Image:
    """Return the picture of one mesh, (height, width, 3); its long side has ``size`` pixels.

    The shading is flat, so that facets show. ``colour`` and ``top`` are as in ``render_panels``.
    """
    if not can_draw():
        raise DeviceError(
            "drawing meshes needs OpenGL, and VTK finds none here: on Debian and Ubuntu, "
            "apt-get install libegl1 libgl1-mesa-dri"
        )
    import pyvista  # takes a second
    from vtkmodules.vtkCommonCore import vtkLogger as log  # noqa: N813

    log.SetStderrVerbosity(log.VERBOSITY_ERROR)  # no warning that there is no display
    look: dict[str, Any] = SHADED
    if colour == "normal":
        look = {"scalars": face_colours(panel.mesh), "rgb": True, "lighting": False}
    elif colour == "error" and panel.values is not None:
        look = {**BY_VALUE, "scalars": panel.values, "clim": (0, top)}
    wide, tall = (round(size * side) for side in frame.sides)
    window = [wide * SUPERSAMPLING, tall * SUPERSAMPLING]
    plotter = pyvista.Plotter(off_screen=True, window_size=window)
    plotter.set_background("white")
    if len(panel.mesh.faces):
        places = frame.place(panel.mesh.vertices)
        surface = pyvista.PolyData.from_regular_faces(places, panel.mesh.faces)
        plotter.add_mesh(surface, show_scalar_bar=False, smooth_shading=False, **look)
    plotter.camera_position = [(0, 0, 10), (0, 0, 0), (0, 1, 0)]
    plotter.camera.parallel_projection = True
    plotter.camera.parallel_scale = frame.sides[1]
    plotter.reset_camera_clipping_range()
    image = plotter.screenshot(return_img=True)
    plotter.close()
    blocks = image[..., :3].reshape(tall, SUPERSAMPLING, wide, SUPERSAMPLING, 3)
    return np.round(blocks.mean((1, 3))).astype(np.uint8)


def write_picture(figure: Figure, target: Path) -> None:
    """Write a figure as a complete PNG file."""
    with replacing(target) as part:
        figure.savefig(part, format="png", dpi=figure.dpi)


class Page:
    """A figure of pictures, (height, width, 3) each; ``size`` is a picture's long side in pixels.

    ``foot`` is the height of the legend, in lines of text; the font size follows from ``size``.
    """

    def __init__(self, size: int, images: Sequence[Image], titles: Sequence[str], *,
                 columns: int = COLUMNS, foot: float = 0.0) -> None:  # fmt: skip
        self.type_size = max(size / 30, 9.0)
        self.gap = gap = size // 30 + 1
        strip = round(2 * self.type_size) if any(titles) else 0
        self.foot = round(foot * self.type_size)
        self.tall, self.wide = images[0].shape[:2]
        across = min(len(images), columns)
        rows = -(-len(images) // across)
        self.width = across * (self.wide + gap) + gap
        self.height = rows * (strip + self.tall + gap) + gap + self.foot
        # plus half a pixel, since the size of the page is rounded down
        inches = (self.width + 0.5) / DPI, (self.height + 0.5) / DPI
        self.figure = Figure(figsize=inches, dpi=DPI, facecolor="white")
        FigureCanvasAgg(self.figure)
        for number, (image, title) in enumerate(zip(images, titles)):
            row, column = divmod(number, across)
            left = gap + column * (self.wide + gap)
            high = self.height - gap - row * (strip + self.tall + gap)
            self.figure.figimage(image, left, high - strip - self.tall, origin="upper")
            self._write(title, left + self.wide / 2, high - strip / 2, 1.0, self.wide)

    def _write(self, line: str, x: float, y: float, scale: float, room: float) -> None:
        """Write a line centred on (x, y), in pixels; smaller if it is wider than ``room``."""
        size = scale * self.type_size
        at = x / self.width, y / self.height
        # file names may hold dollar signs, which are no formulas
        text = self.figure.text(*at, line, ha="center", va="center", size=size, parse_math=False)
        wide = text.get_window_extent().width
        if wide > room:
            text.set_fontsize(size * room / wide)

    def add_line(self, line: str, y: float | None = None) -> None:
        """Add a line of text at the foot of the page."""
        y = self.foot / 2 if y is None else y
        self._write(line, self.width / 2, y, 0.9, self.width - 2 * self.gap)

    def add_bar(self, title: str, top: float, *, clipped: bool) -> None:
        """Add a colour bar from 0 to ``top``, with an arrow if ``clipped`` values lie beyond."""
        unit = self.type_size
        wide = min(1.2 * max(self.wide, self.tall), 0.8 * self.width)
        left, below = (self.width - wide) / 2, 2.0 * unit
        box = np.divide((left, below, wide, 0.8 * unit), (self.width, self.height) * 2)
        ax = self.figure.add_axes(tuple(box))
        self.figure.colorbar(
            ScalarMappable(Normalize(0, top), matplotlib.colormaps[COLOUR_MAP]),
            cax=ax,
            orientation="horizontal",
            extend="max" if clipped else "neither",
            ticks=MaxNLocator(4),
            format=FormatStrFormatter("%.3g"),
        )
        ax.tick_params(labelsize=0.8 * unit)
        self.add_line(title, below + 1.7 * unit)
