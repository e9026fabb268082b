"""Pictures of meshes side by side, off screen: PyVista draws each, matplotlib lays out the page.

All meshes of a picture share one parallel projection, so lengths can be compared.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from super_sdf.errors import DeviceError, OptionError
from super_sdf.mesh import Mesh
from super_sdf.truth.solid import Distances, Points, Solid

from .page import COLOUR_MAP, Image, Page, check_page, write_picture

AXES = ("x", "y", "z")
COLOURS = ("shaded", "normal", "error")
# For each axis that may point up: the directions to the right and towards the viewer.
RIGHT_AND_FRONT = {
    "x": ((0, 1, 0), (0, 0, -1)),
    "y": ((1, 0, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, -1, 0)),
}
THREE_QUARTER = 0.6, 1.0, 0.5  # right, front and up of the default view
MESH_COLOUR = "#b9c7df"
TOP_PERCENTILE = 99.0  # so that a single stray vertex does not stretch the colours
NORMALS_LEGEND = "colour: direction of the face; red, green, blue are (1 + normal)/2 along x, y, z"
ZOOMS = 0.01, 1000.0  # smallest and largest: beyond, a mesh is a dot or a flat colour
LARGEST_TOP = 1e30  # of the colour bar; the smallest is its inverse: VTK computes in float32
MARGIN = 1.06  # size of the frame over the size of the meshes
NARROWEST = 0.5  # least ratio of a panel's short side to its long one: titles need room
SUPERSAMPLING = 2  # pixels drawn per pixel of the picture, along each axis
DRAW = (  # what VTK does before it draws anything
    "from vtkmodules.vtkRenderingOpenGL2 import vtkOpenGLRenderer;"
    "from vtkmodules.vtkRenderingCore import vtkRenderWindow;"
    "window = vtkRenderWindow(); window.SetOffScreenRendering(1); window.Render()"
)
FOOT = {"shaded": 0.0, "normal": 2.0, "error": 5.0}  # height of the legend, in lines of text


@dataclass(frozen=True, eq=False)
class Panel:
    """One mesh of a picture."""

    mesh: Mesh
    title: str = ""
    values: NDArray[Any] | None = None  # one per vertex, shown with ``colour="error"``


@dataclass(frozen=True)
class Layout:
    """The camera's direction and the size of the panels."""

    view: tuple[float, float, float] | None = None  # from the meshes to the viewer
    zoom: float = 1.0  # at 1 every mesh fits into its panel
    size: int = 700  # pixels along the long side of a panel
    columns: int | None = None  # most panels in a row


DEFAULT_LAYOUT = Layout()


@dataclass(frozen=True, eq=False)
class Frame:
    """The view that all panels share: x to the right, y up, z to the viewer, long side -1 to 1."""

    axes: NDArray[np.float64]  # directions of x, y and z in the world, one per row
    centre: NDArray[np.float64]  # in coordinates along ``axes``
    half: float  # half the long side, in world units
    sides: tuple[float, float]  # width and height, each over the long side

    def place(self, vertices: NDArray[Any]) -> Points:
        """Return the positions of vertices (n, 3) in the frame, (n, 3) float64."""
        return (vertices.astype(np.float64) @ self.axes.T - self.centre) / self.half

    def pixels(self, size: int) -> tuple[int, int]:
        """Return width and height of a panel whose long side has ``size`` pixels."""
        return round(size * self.sides[0]), round(size * self.sides[1])


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
    layout: Layout = DEFAULT_LAYOUT,
    top: float | None = None,
    unit: str = "",
    force: bool = True,
) -> None:
    """Draw meshes side by side from one camera, as a PNG file."""
    _check(panels, colour, layout, top)
    frame = fit_frame(panels, view_axes(up, layout.view), layout.zoom)
    values = _values_of(panels)
    top = _top_of(values) if colour == "error" and top is None else top
    images = [draw_panel(panel, frame, layout.size, colour, top) for panel in panels]
    titles = [panel.title for panel in panels]
    page = Page(layout.size, images, titles, columns=layout.columns, foot=FOOT[colour])
    if colour == "normal":
        page.add_line(NORMALS_LEGEND)
    elif colour == "error" and top is not None and len(values):
        page.add_bar(_bar_title(unit), top, clipped=bool(values.max() > top))
    write_picture(page.figure, target, force=force)


def _bar_title(unit: str) -> str:
    """Return the title of the colour bar of errors."""
    return f"distance to the reference ({unit})" if unit else "distance to the reference"


def view_axes(up: str = "z", view: tuple[float, float, float] | None = None) -> NDArray[np.float64]:
    """Return the directions right, up and towards the viewer, one per row, (3, 3)."""
    if up not in RIGHT_AND_FRONT:
        raise OptionError(f"up is {up!r}: give one of {', '.join(RIGHT_AND_FRONT)}")
    right, front = np.array(RIGHT_AND_FRONT[up], np.float64)
    upward = np.eye(3)[AXES.index(up)]
    towards = np.array(THREE_QUARTER) @ [right, front, upward] if view is None else np.array(view)
    if not (np.isfinite(towards).all() and towards.any()):
        raise OptionError(f"view is {view}: give a direction, three numbers that are not all 0")
    towards = towards / np.linalg.norm(towards)
    if abs(towards @ upward) > 1 - 1e-9:  # straight from above or below
        upward = -front * np.sign(towards @ upward)
    across = np.cross(upward, towards)
    across /= np.linalg.norm(across)
    return np.array([across, np.cross(towards, across), towards])


def fit_frame(panels: Sequence[Panel], axes: NDArray[np.float64], zoom: float = 1.0) -> Frame:
    """Return the smallest frame with these axes that holds the faces of all panels."""
    drawn = [panel.mesh.vertices[np.unique(panel.mesh.faces)] for panel in panels]
    points = np.concatenate(drawn).astype(np.float64) @ axes.T
    if not len(points):
        raise OptionError("nothing to draw: no mesh has a face")
    low, high = points.min(0), points.max(0)
    sides = (high - low)[:2]
    longest = float(sides.max()) or 1.0
    wide, tall = (max(float(side) / longest, NARROWEST) for side in sides)
    return Frame(axes, (low + high) / 2, longest / 2 * MARGIN / zoom, (wide, tall))


def face_colours(mesh: Mesh) -> Image:
    """Return (n + 1)/2 of each face normal n, in world axes, as a colour, (m, 3) uint8."""
    a, b, c = mesh.vertices.astype(np.float64)[mesh.faces.T]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    return np.round((normals + 1) / 2 * 255).astype(np.uint8)


def _check(panels: Sequence[Panel], colour: str, layout: Layout, top: float | None) -> None:
    """Raise OptionError if an argument is out of range or unknown."""
    if not panels:
        raise OptionError("nothing to draw: give a mesh")
    if colour not in COLOURS:
        raise OptionError(f"colour is {colour!r}: give one of {', '.join(COLOURS)}")
    check_numbers(zoom=layout.zoom, top=top, columns=layout.columns)
    check_page(layout.size, len(panels), layout.columns)
    for panel in panels:
        count = len(panel.mesh.vertices)
        if panel.values is not None and panel.values.shape != (count,):
            shape = panel.values.shape
            raise OptionError(f"values have shape {shape}: give one for each of {count} vertices")


def check_numbers(
    *, zoom: float = 1.0, top: float | None = None, columns: int | None = None
) -> None:
    """Raise OptionError if a number is out of range, whatever is drawn."""
    for name, number in {"zoom": zoom, "top": top, "columns": columns}.items():
        if number is not None and not 0 < number < np.inf:
            raise OptionError(f"{name} is {number:g}: give a number greater than 0")
    least, most = ZOOMS
    if not least <= zoom <= most:
        raise OptionError(f"zoom is {zoom:g}: give a number from {least:g} to {most:g}")
    if top is not None and not 1 / LARGEST_TOP <= top <= LARGEST_TOP:
        raise OptionError(f"top is {top:g}: no colour bar can be drawn to that")


def _values_of(panels: Sequence[Panel]) -> NDArray[Any]:
    """Return the values of all panels, concatenated."""
    return np.concatenate([[], *(panel.values for panel in panels if panel.values is not None)])


def _top_of(values: NDArray[Any]) -> float:
    """Return the value for the end of the colour bar: 99 % of the values lie below it."""
    top = float(np.percentile(values, TOP_PERCENTILE)) if len(values) else 0.0
    return top if top > 0 else 1.0


def _pyvista() -> Any:
    """Import PyVista, which takes a second."""
    if not can_draw():
        raise DeviceError(
            "drawing meshes needs OpenGL, and VTK finds none here: on Debian and Ubuntu, "
            "apt-get install libegl1 libgl1-mesa-dri"
        )
    import pyvista

    return pyvista


@contextmanager
def _quiet_without_display() -> Iterator[None]:
    """Keep VTK from warning that it found no display: it draws without one."""
    from vtkmodules.vtkCommonCore import vtkLogger as log  # noqa: N813

    log.SetStderrVerbosity(log.VERBOSITY_ERROR)
    try:
        yield
    finally:
        log.SetStderrVerbosity(log.VERBOSITY_INFO)


def draw_panel(
    panel: Panel, frame: Frame, size: int, colour: str = "shaded", top: float | None = None
) -> Image:
    """Return the picture of one mesh, (height, width, 3); its long side has ``size`` pixels.

    ``colour`` and ``top`` are those of ``render_panels``.
    """
    pyvista = _pyvista()
    wide, tall = frame.pixels(size)
    window = wide * SUPERSAMPLING, tall * SUPERSAMPLING
    with _quiet_without_display():
        plotter = pyvista.Plotter(off_screen=True, window_size=window)
        plotter.set_background("white")
        if len(panel.mesh.faces):
            surface = pyvista.PolyData.from_regular_faces(
                frame.place(panel.mesh.vertices), panel.mesh.faces
            )
            plotter.add_mesh(surface, show_scalar_bar=False, **_appearance(panel, colour, top))
        plotter.camera_position = [(0, 0, 10), (0, 0, 0), (0, 1, 0)]
        plotter.camera.parallel_projection = True
        plotter.camera.parallel_scale = frame.sides[1]
        plotter.reset_camera_clipping_range()
        image = plotter.screenshot(return_img=True)
        plotter.close()
    blocks = image[..., :3].reshape(tall, SUPERSAMPLING, wide, SUPERSAMPLING, 3)
    return np.round(blocks.mean((1, 3))).astype(np.uint8)


def _appearance(panel: Panel, colour: str, top: float | None) -> dict[str, Any]:
    """Return PyVista's arguments for colour and lighting; flat shading shows the facets."""
    if colour == "normal":
        return {"scalars": face_colours(panel.mesh), "rgb": True, "lighting": False}
    if colour == "error" and panel.values is not None:
        return {
            "scalars": panel.values,
            "cmap": COLOUR_MAP,
            "clim": (0, top),
            "interpolate_before_map": True,
            "smooth_shading": False,
            # mostly ambient, so that the colours match the colour bar
            "ambient": 0.5,
            "diffuse": 0.55,
            "specular": 0.0,
        }
    return {
        "color": MESH_COLOUR,
        "smooth_shading": False,
        "ambient": 0.25,
        "diffuse": 1.0,
        "specular": 0.25,
        "specular_power": 20,
    }
