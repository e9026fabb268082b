"""False-colour cross-sections of a grid, before and after refinement.

Only the plane that is drawn is dense, never the fine lattice.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from super_sdf.errors import OptionError
from super_sdf.grid.cubic import cubic_grid
from super_sdf.grid.placement import as_triple
from super_sdf.grid.sdf_grid import SdfGrid
from super_sdf.steps.field import FineField

from .drawing import AXES
from .page import check_page, write_picture

COLOUR_MAP = "RdBu_r"  # blue inside, red outside, white at the surface
LIMIT = 3.0  # distance at both ends of the colour bar, in voxels
UNKNOWN = "#c4c4c4"
INCHES = 7.0  # width of a panel; the pixels per inch follow from the size in pixels
SECTIONS = 2  # most sections side by side
TALLEST = 3  # greatest ratio of a panel's height to its width
STRIP = 1.35  # inches for titles, labels and the colour bar
BAR_TITLE = f"signed distance (negative inside); colours end at {LIMIT:g} voxels, black line: 0"


@dataclass(frozen=True, eq=False)
class Section:
    """Values on a plane of a lattice; each is drawn as a rectangle around its point."""

    values: NDArray[np.float64]  # (n, m), in world units, negative inside, NaN where unknown
    first: tuple[float, float]  # world position of value (0, 0) along the two axes
    step: tuple[float, float]  # world distance between neighbours along them

    def places(self, along: int) -> NDArray[np.floating[Any]]:
        """Return the world positions of the values along an axis of the plane."""
        return self.first[along] + self.step[along] * np.arange(self.values.shape[along])

    def box(self) -> tuple[float, float, float, float]:
        """Return left, right, bottom and top of all cells."""
        low = np.array(self.first) - np.array(self.step) / 2
        high = low + np.array(self.step) * self.values.shape
        return low[0], high[0], low[1], high[1]


def render_section(
    grid: SdfGrid,
    target: Path,
    *,
    field: FineField | None = None,
    axis: str = "z",
    at: float | None = None,
    size: int = 700,
    force: bool = True,
) -> None:
    """Draw a cross-section of a grid, and beside it the same section refined, as a PNG file."""
    index, number = find_plane(grid, axis, at), AXES.index(axis)
    sections = {f"{' x '.join(map(str, grid.shape))} samples": coarse_section(grid, axis, index)}
    if field is not None:
        title = f"refined {field.factor} times (grey: far from the surface, not refined)"
        sections[title] = fine_section(field, grid, axis, index)
    figure = _draw(sections, axis, grid.voxel_size, size)
    position = own_origin(grid)[number] + grid.spacing[number] * index
    along = "" if grid.is_straight else ", along the grid's own axes"
    figure.suptitle(f"section at {axis} = {position:.4g}{along}")
    write_picture(figure, target, force=force)


def check_section(size: int) -> None:
    """Raise if panels of ``size`` pixels are too large to draw; see ``check_page``."""
    check_page(size, SECTIONS * TALLEST, columns=SECTIONS)


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
    across, along = _plane_of(axis)
    origin, spacing = own_origin(grid), grid.spacing
    return Section(values, (origin[across], origin[along]), (spacing[across], spacing[along]))


def fine_section(field: FineField, grid: SdfGrid, axis: str, index: int) -> Section:
    """Return the fine values on the plane of nodes that coincides with a plane of samples."""
    lattice, number, factor = cubic_grid(grid), AXES.index(axis), field.factor
    plane = round(index * grid.spacing[number] / lattice.spacing[number])
    values = _node_plane(field, axis, min(plane, lattice.shape[number] - 1))
    origin, spacing = own_origin(lattice), lattice.spacing
    (left, wide), (bottom, high) = ((origin[n], spacing[n]) for n in _plane_of(axis))
    first, step = (left - wide / 2, bottom - high / 2), (wide / factor, high / factor)
    return Section(values * (lattice.voxel_size / 2), first, step)


def _node_plane(field: FineField, axis: str, index: int) -> NDArray[np.float64]:
    """Return the values, in half voxels, on the middle nodes of a plane of voxels; else NaN."""
    factor, number, (across, along) = field.factor, AXES.index(axis), _plane_of(axis)
    in_grid = ((field.voxel_ijk >= 0) & (field.voxel_ijk < np.array(field.shape))).all(1)
    rows = np.flatnonzero(in_grid & (field.voxel_ijk[:, number] == index))
    blocks = field.blocks[:, rows].T.reshape(-1, *(factor + 1,) * 3)
    place = factor * field.voxel_ijk[rows, :, None] + np.arange(factor + 1)
    plane = np.full((factor * field.shape[across] + 1, factor * field.shape[along] + 1), np.nan)
    values = np.take(blocks, factor // 2, axis=number + 1)
    plane[place[:, across, :, None], place[:, along, None, :]] = values
    return plane


def _plane_of(axis: str) -> tuple[int, int]:
    """Return the two axes of a section's plane: to the right, and up."""
    across, along = (other for other in range(3) if other != AXES.index(axis))
    return across, along


def _draw(sections: dict[str, Section], axis: str, voxel: float, size: int) -> Figure:
    """Draw sections side by side under their titles, with one colour bar."""
    left, right, bottom, top = next(iter(sections.values())).box()
    tall = float(np.clip((top - bottom) / (right - left), 0.3, TALLEST))
    inches = INCHES * len(sections), INCHES * tall + STRIP
    figure = Figure(figsize=inches, dpi=size / INCHES, layout="constrained")
    plots = figure.subplots(1, len(sections), squeeze=False, sharex=True, sharey=True)[0]
    for ax, (title, section) in zip(plots, sections.items()):
        image = _draw_section(ax, section, LIMIT * voxel)
        ax.set(title=title, aspect="equal", xlim=(left, right), ylim=(bottom, top))
        ax.set_xlabel(AXES[_plane_of(axis)[0]])
    plots[0].set_ylabel(AXES[_plane_of(axis)[1]])
    where = {"ax": list(plots), "location": "bottom", "shrink": 0.5, "aspect": 35, "pad": 0.03}
    figure.colorbar(image, extend="both", **where).set_label(BAR_TITLE)
    return figure


def _draw_section(ax: Axes, section: Section, limit: float) -> AxesImage:
    """Draw the values of a section, and their zero line."""
    known, scale = np.ma.masked_invalid(section.values.T), {"vmin": -limit, "vmax": limit}
    ax.set_facecolor(UNKNOWN)
    image = ax.imshow(known, COLOUR_MAP, origin="lower", extent=section.box(),
                      interpolation="nearest", **scale)  # fmt: skip
    if known.count() and known.min() <= 0 < known.max():
        x, y = section.places(0), section.places(1)
        ax.contour(x, y, known, levels=[0], colors="black", linewidths=1.4)
    return image
