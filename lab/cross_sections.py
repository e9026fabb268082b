"""False-colour cross-sections of a grid, before and after refinement.

Only the plane that is drawn is dense, never the fine lattice.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from super_sdf.errors import OptionError
from super_sdf.grid.cubic import cubic_grid
from super_sdf.grid.placement import as_triple
from super_sdf.grid.sdf_grid import SdfGrid
from super_sdf.refine.field import FineField

from .drawing import AXES, SIZE, write_picture

COLOUR_MAP = "RdBu_r"  # blue inside, red outside, white at the surface
LIMIT = 3.0  # distance at both ends of the colour bar, in voxels
UNKNOWN = "#c4c4c4"
INCHES = 7.0  # width of a panel
TALLEST = 3  # greatest ratio of a panel's height to its width
STRIP = 1.35  # inches for titles, labels and the colour bar
BAR_TITLE = f"signed distance (negative inside); colours end at {LIMIT:g} voxels, black line: 0"


@dataclass(frozen=True, eq=False)
class Section:
    """Values on a plane of a lattice; each is drawn as a rectangle around its point."""

    values: NDArray[np.float64]  # (n, m), in world units, negative inside, NaN where unknown
    first: tuple[float, float]  # world position of value (0, 0) along the two axes
    step: tuple[float, float]  # world distance between neighbours along them

    def box(self) -> tuple[float, float, float, float]:
        """Return left, right, bottom and top of all rectangles."""
        low = np.array(self.first) - np.array(self.step) / 2
        high = low + np.array(self.step) * self.values.shape
        return low[0], high[0], low[1], high[1]


def render_section(grid: SdfGrid, field: FineField, target: Path, axis: str, index: int) -> None:
    """Draw a plane of samples of a grid, and beside it the same plane refined, as a PNG file."""
    sections = {
        f"{' x '.join(map(str, grid.shape))} samples": coarse_section(grid, axis, index),
        f"refined {field.factor} times (grey: far from the surface, not refined)": fine_section(
            field, grid, axis, index
        ),
    }
    figure = draw_sections(sections, axis, grid.voxel_size)
    number = AXES.index(axis)
    position = own_origin(grid)[number] + grid.spacing[number] * index
    along = "" if grid.is_straight else ", along the grid's own axes"
    figure.suptitle(f"section at {axis} = {position:.4g}{along}")
    write_picture(figure, target)


def find_plane(grid: SdfGrid, axis: str = "z", at: float | None = None) -> int:
    """Return the index of the plane of samples nearest to world position ``at`` on an axis.

    Without a position, the middle one of the planes that the surface crosses.
    """
    number = AXES.index(axis)
    if at is None:
        planes = np.moveaxis(grid.values, number, 0)
        crossed = np.flatnonzero([plane.min() <= 0 < plane.max() for plane in planes])
        if not len(crossed):  # the surface passes between the samples, if there is one
            return int(np.argmin([np.abs(plane).min() for plane in planes]))
        return int(crossed[np.abs(crossed - (crossed[0] + crossed[-1]) / 2).argmin()])
    first, step, count = own_origin(grid)[number], grid.spacing[number], grid.shape[number]
    index = (at - first) / step
    if not -0.5 <= index <= count - 0.5:
        low, high = first - step / 2, first + step * (count - 0.5)
        raise OptionError(f"at is {at:g}: the grid goes from {low:g} to {high:g} along {axis}")
    return min(max(round(index), 0), count - 1)


def own_origin(grid: SdfGrid) -> tuple[float, float, float]:
    """Return the position of sample (0, 0, 0) along the grid's own axes, in world units."""
    if grid.is_straight:
        return grid.origin
    return as_triple(np.array(grid.direction).T @ np.array(grid.origin), "origin")


def coarse_section(grid: SdfGrid, axis: str, index: int) -> Section:
    """Return the plane of samples with this index along an axis."""
    values = np.take(grid.values, index, axis=AXES.index(axis)).astype(np.float64)
    across, up = plane_of(axis)
    origin, spacing = own_origin(grid), grid.spacing
    return Section(values, (origin[across], origin[up]), (spacing[across], spacing[up]))


def fine_section(field: FineField, grid: SdfGrid, axis: str, index: int) -> Section:
    """Return the fine values on the plane of nodes that coincides with a plane of samples."""
    lattice, number, (across, up) = cubic_grid(grid), AXES.index(axis), plane_of(axis)
    factor, origin, voxel = field.factor, own_origin(lattice), lattice.voxel_size
    plane = round(index * grid.spacing[number] / lattice.spacing[number])
    plane = min(plane, lattice.shape[number] - 1)
    inside = ((field.voxel_ijk >= 0) & (field.voxel_ijk < np.array(field.shape))).all(1)
    rows = np.flatnonzero(inside & (field.voxel_ijk[:, number] == plane))
    blocks = field.blocks[:, rows].T.reshape(-1, *(factor + 1,) * 3)
    node = factor * field.voxel_ijk[rows, :, None] + np.arange(factor + 1)
    values = np.full((factor * field.shape[across] + 1, factor * field.shape[up] + 1), np.nan)
    values[node[:, across, :, None], node[:, up, None, :]] = np.take(
        blocks, factor // 2, axis=number + 1
    )
    first = origin[across] - voxel / 2, origin[up] - voxel / 2
    return Section(values * (voxel / 2), first, (voxel / factor, voxel / factor))


def plane_of(axis: str) -> tuple[int, int]:
    """Return the two axes of a section's plane: to the right, and up."""
    across, up = (other for other in range(3) if other != AXES.index(axis))
    return across, up


def draw_sections(sections: dict[str, Section], axis: str, voxel: float) -> Figure:
    """Draw sections side by side under their titles, with one colour bar."""
    left, right, bottom, top = next(iter(sections.values())).box()
    tall = float(np.clip((top - bottom) / (right - left), 0.3, TALLEST))
    inches = INCHES * len(sections), INCHES * tall + STRIP
    figure = Figure(figsize=inches, dpi=SIZE / INCHES, layout="constrained")
    plots = figure.subplots(1, len(sections), squeeze=False, sharex=True, sharey=True)[0]
    for ax, (title, section) in zip(plots, sections.items()):
        image = draw_section(ax, section, LIMIT * voxel)
        ax.set(title=title, aspect="equal", xlim=(left, right), ylim=(bottom, top))
        ax.set_xlabel(AXES[plane_of(axis)[0]])
    plots[0].set_ylabel(AXES[plane_of(axis)[1]])
    where = {"ax": list(plots), "location": "bottom", "shrink": 0.5, "aspect": 35, "pad": 0.03}
    figure.colorbar(image, extend="both", **where).set_label(BAR_TITLE)
    return figure


def draw_section(ax: Axes, section: Section, limit: float) -> AxesImage:
    """Draw the values of a section, and their zero line."""
    known, place = np.ma.masked_invalid(section.values.T), {"extent": section.box()}
    ax.set_facecolor(UNKNOWN)
    image = ax.imshow(known, COLOUR_MAP, origin="lower", interpolation="nearest",
                      vmin=-limit, vmax=limit, **place)  # fmt: skip
    if known.count() and known.min() <= 0 < known.max():
        ax.contour(known, levels=[0], origin="lower", colors="black", linewidths=1.4, **place)
    return image
