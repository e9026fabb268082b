"""Pictures of meshes side by side, off screen: PyVista draws each, matplotlib sets the page.

All meshes of a picture are seen by one parallel projection, so lengths can be compared.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError
from ..machine.extras import EXTRAS, check_modules, missing_modules
from ..mesh import Mesh
from ..truth.solid import Distances, Points, Solid
from .page import COLOUR_MAP, Image, Page, check_page, write_picture

COLOURS = ("shaded", "normal", "error")
# For each axis that may point up: the direction to the right, and the one towards the viewer.
RIGHT_AND_FRONT = {
    "x": ((0, 1, 0), (0, 0, -1)),
    "y": ((1, 0, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, -1, 0)),
}
THREE_QUARTER = 0.6, 1.0, 0.5  # right, front and up of the default view
BASE = "#b9c7df"
TOP_PERCENTILE = 99.0  # so that a single stray vertex does not stretch the colours
NORMALS_SAY = "colour: direction of the face; red, green, blue are (1 + normal)/2 along x, y, z"
ZOOMS = 0.01, 1000.0  # beyond, a mesh is a dot or a flat colour
LARGEST_TOP = 1e30  # of the colour bar, and one over the smallest: VTK's numbers are float32
MARGIN = 1.06  # of the frame over what it holds
NARROWEST = 0.5  # a panel's short side over its long one, at least: titles need room
SUPERSAMPLING = 2  # pixels drawn for each pixel of the picture, along an axis
FOOT = {"shaded": 0.0, "normal": 2.0, "error": 5.0}  # room for what explains them, in lines


@dataclass(frozen=True, eq=False)
class Panel:
    """A mesh of a picture.

    Attributes
    ----------
    mesh : Mesh
        What is drawn.
    title : str
        Stands above it.
    values : (n,), optional
        A number for each vertex, shown where colours tell the error.
    """

    mesh: Mesh
    title: str = ""
    values: NDArray[Any] | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """The one view of all panels: x to the right, y up, z nearer, the long side from -1 to 1.

    Attributes
    ----------
    axes : (3, 3)
        Those directions in the world, a row each.
    centre : (3,)
        What is in the middle, along these.
    half : float
        Of the long side, in world units.
    sides : two floats
        Width and height, over the long side.
    """

    axes: NDArray[np.float64]
    centre: NDArray[np.float64]
    half: float
    sides: tuple[float, float]

    def place(self, vertices: NDArray[Any]) -> Points:
        """Return where vertices (n, 3) lie in the frame."""
        return (vertices.astype(np.float64) @ self.axes.T - self.centre) / self.half

    def pixels(self, size: int) -> tuple[int, int]:
        """Return width and height of the panels if the long side has so many pixels."""
        return round(size * self.sides[0]), round(size * self.sides[1])


def can_render() -> bool:
    """Say whether PyVista is installed."""
    return not missing_modules(EXTRAS["view"])


def vertex_errors(mesh: Mesh, reference: Solid) -> Distances:
    """Return the unsigned distance of each vertex to a reference, (n,), in world units."""
    return reference.distance(np.ascontiguousarray(mesh.vertices, np.float64))


def render_panels(
    panels: Sequence[Panel],
    target: Path,
    *,
    colour: str = "shaded",
    up: str = "z",
    view: tuple[float, float, float] | None = None,
    zoom: float = 1.0,
    size: int = 700,
    top: float | None = None,
    unit: str = "",
    columns: int | None = None,
    force: bool = True,
) -> None:
    """Draw meshes side by side from one camera, as a PNG file.

    Parameters
    ----------
    panels : sequence of Panel
        From left to right.
    target : path
        The file.
    colour : str
        ``shaded``; ``normal``: of each face, (n + 1)/2 as red, green, blue; or ``error``: the
        vertices' values with a colour bar. A panel without values is shaded then.
    up : str
        The axis that points up: x, y or z.
    view : three floats, optional
        The direction from the meshes to the viewer, in world axes; from the front, the right and
        above unless given.
    zoom : float
        Closer in; at 1 everything is seen.
    size : int
        Pixels along the long side of a panel.
    top : float, optional
        The value at the end of the colour bar; most values lie below it unless given.
    unit : str
        Of the values, for the bar's title.
    columns : int, optional
        Panels in a row, at most.
    force : bool
        Replace a file that is there.

    Raises
    ------
    OptionError
        If an argument has no meaning.
    FileError
        If PyVista is not installed or the file cannot be written.
    """
    _check(panels, colour, zoom=zoom, size=size, top=top, columns=columns)
    frame = fit_frame(panels, view_axes(up, view), zoom)
    if colour == "error":
        top = _top_of(_values_of(panels)) if top is None else top
    images = [_draw(panel, frame, colour, frame.pixels(size), top) for panel in panels]
    titles = [panel.title for panel in panels]
    page = Page(size, images, titles, columns=columns, foot=FOOT[colour])
    values = _values_of(panels)
    if colour == "normal":
        page.add_line(NORMALS_SAY)
    elif colour == "error" and top is not None and len(values):
        title = f"distance to the reference ({unit})" if unit else "distance to the reference"
        page.add_bar(title, top, clipped=bool(values.max() > top))
    write_picture(page.figure, target, force=force)


def view_axes(up: str = "z", view: tuple[float, float, float] | None = None) -> NDArray[np.float64]:
    """Return the picture's right, up and towards the viewer, (3, 3), a row each."""
    if up not in RIGHT_AND_FRONT:
        raise OptionError(f"up is {up!r}: give one of {', '.join(RIGHT_AND_FRONT)}")
    right, front = np.array(RIGHT_AND_FRONT[up], np.float64)
    upward = np.eye(3)["xyz".index(up)]
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
    """Return the frame, seen along the axes, that just holds the faces of all panels."""
    drawn = [panel.mesh.vertices[np.unique(panel.mesh.faces)] for panel in panels]
    seen = np.concatenate(drawn).astype(np.float64) @ axes.T
    if not len(seen):
        raise OptionError("nothing to draw: no mesh has a face")
    low, high = seen.min(0), seen.max(0)
    sides = (high - low)[:2]
    longest = float(sides.max()) or 1.0
    wide, tall = (max(float(side) / longest, NARROWEST) for side in sides)
    return Frame(axes, (low + high) / 2, longest / 2 * MARGIN / zoom, (wide, tall))


def face_colours(mesh: Mesh) -> Image:
    """Return the colour of each face's normal, (m, 3): (n + 1)/2 in world axes."""
    a, b, c = mesh.vertices.astype(np.float64)[mesh.faces.T]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    return np.round((normals + 1) / 2 * 255).astype(np.uint8)


def _check(
    panels: Sequence[Panel],
    colour: str,
    *,
    zoom: float,
    size: int,
    top: float | None,
    columns: int | None,
) -> None:
    """Raise OptionError if an argument has no meaning."""
    if not panels:
        raise OptionError("nothing to draw: give a mesh")
    if colour not in COLOURS:
        raise OptionError(f"colour is {colour!r}: give one of {', '.join(COLOURS)}")
    check_numbers(zoom=zoom, top=top, columns=columns)
    check_page(size, len(panels), columns)
    for panel in panels:
        count = len(panel.mesh.vertices)
        if panel.values is not None and panel.values.shape != (count,):
            shape = panel.values.shape
            raise OptionError(f"values have shape {shape}: give one for each of {count} vertices")


def check_numbers(
    *, zoom: float = 1.0, top: float | None = None, columns: int | None = None
) -> None:
    """Raise OptionError if a number has no meaning, whatever is drawn."""
    for name, number in {"zoom": zoom, "top": top, "columns": columns}.items():
        if number is not None and not 0 < number < np.inf:
            raise OptionError(f"{name} is {number:g}: give a number greater than 0")
    least, most = ZOOMS
    if not least <= zoom <= most:
        raise OptionError(f"zoom is {zoom:g}: give a number from {least:g} to {most:g}")
    if top is not None and not 1 / LARGEST_TOP <= top <= LARGEST_TOP:
        raise OptionError(f"top is {top:g}: no colour bar can be drawn to that")


def _values_of(panels: Sequence[Panel]) -> NDArray[Any]:
    """Return the values of all panels."""
    return np.concatenate([[], *(panel.values for panel in panels if panel.values is not None)])


def _top_of(values: NDArray[Any]) -> float:
    """Return the value at the end of the colour bar: nearly all values lie below it."""
    top = float(np.percentile(values, TOP_PERCENTILE)) if len(values) else 0.0
    return top if top > 0 else 1.0


def _pyvista() -> Any:
    """Import PyVista, which takes a second."""
    check_modules("drawing meshes", "view")
    return import_module("pyvista")


@contextmanager
def _quiet_without_display() -> Iterator[None]:
    """Keep VTK from telling that it found no display before it draws without one."""
    log = import_module("vtkmodules.vtkCommonCore").vtkLogger
    log.SetStderrVerbosity(log.VERBOSITY_ERROR)
    try:
        yield
    finally:
        log.SetStderrVerbosity(log.VERBOSITY_INFO)


def _draw(
    panel: Panel, frame: Frame, colour: str, pixels: tuple[int, int], top: float | None
) -> Image:
    """Return the picture of one mesh, (height, width, 3)."""
    pyvista = _pyvista()
    wide, tall = pixels
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
    """Return what tells PyVista how a mesh looks. Faces are flat, so that facets show."""
    if colour == "normal":
        return {"scalars": face_colours(panel.mesh), "rgb": True, "lighting": False}
    if colour == "error" and panel.values is not None:
        return {
            "scalars": panel.values,
            "cmap": COLOUR_MAP,
            "clim": (0, top),
            "interpolate_before_map": True,
            "smooth_shading": False,
            # mostly ambient: the colours have to be those of the bar
            "ambient": 0.5,
            "diffuse": 0.55,
            "specular": 0.0,
        }
    return {
        "color": BASE,
        "smooth_shading": False,
        "ambient": 0.25,
        "diffuse": 1.0,
        "specular": 0.25,
        "specular_power": 20,
    }
