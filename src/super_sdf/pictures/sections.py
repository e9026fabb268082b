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

from ..errors import OptionError
from ..grid.cubic import cubic_grid
from ..grid.placement import as_triple
from ..grid.sdf_grid import SdfGrid
from ..steps.field import FineField
from .choices import AXES
from .page import check_page, write_picture

COLOUR_MAP = "RdBu_r"  # blue inside, red outside, white at the surface
LIMIT = 3.0  # distance at both ends of the colour bar, in voxels
UNKNOWN = "#c4c4c4"
INCHES = 7.0  # width of a panel; the pixels per inch follow from the size in pixels
SECTIONS = 2  # most sections side by side
TALLEST = 3  # greatest ratio of a panel's height to its width
STRIP = 1.35  # inches for titles, labels and the colour bar


@dataclass(frozen=True, eq=False)
class Section:
    """Values on a plane of a lattice; each is drawn as a rectangle around its point.

    Attributes
    ----------
    values : (n, m) float64
        Signed distances in world units, negative inside, NaN where unknown.
    first : two floats
        World position of value (0, 0) along the two axes of the plane.
    step : two floats
        World distance between neighbouring values along these axes.
    """

    values: NDArray[np.float64]
    first: tuple[float, float]
    step: tuple[float, float]

    def places(self, along: int) -> NDArray[np.floating[Any]]:
        """Return the world positions of the values along an axis of the plane."""
        return self.first[along] + self.step[along] * np.arange(self.values.shape[along])

    def box(self) -> tuple[float, float, float, float]:
        """Return left, right, bottom and top of all cells."""
        (left, bottom), (wide, high) = self.first, self.step
        count, rows = self.values.shape
        right, top = left + wide * (count - 0.5), bottom + high * (rows - 0.5)
        return left - wide / 2, right, bottom - high / 2, top


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
    """Draw a cross-section of a grid, and beside it the same section refined, as a PNG file.

    Parameters
    ----------
    grid : SdfGrid
        The samples.
    target : path
        The PNG file.
    field : FineField, optional
        The refined field of the grid, from ``upsample``.
    axis : str
        The axis normal to the section: x, y or z.
    at : float, optional
        Position on that axis in world units, along the grid's own axes if it has a direction; the
        nearest plane of samples is drawn. Default: the middle of the surface.
    size : int
        Width of a panel in pixels.
    force : bool
        Replace an existing file.

    Raises
    ------
    OptionError
        If the axis is unknown, the position outside the grid, or the field of another grid.
    FileError
        If the file cannot be written.
    """
    check_section(size)
    index = find_plane(grid, axis, at)
    figure = _draw(_titled_sections(grid, field, axis, index), axis, grid.voxel_size, size)
    number = AXES.index(axis)
    position = own_origin(grid)[number] + grid.spacing[number] * index
    along = "" if grid.is_straight else ", along the grid's own axes"
    figure.suptitle(f"section at {axis} = {position:.4g}{along}")
    write_picture(figure, target, force=force)


def _titled_sections(
    grid: SdfGrid, field: FineField | None, axis: str, index: int
) -> dict[str, Section]:
    """Return the sections to draw, by title: the samples, and the refined field if given."""
    sections = {f"{' x '.join(map(str, grid.shape))} samples": coarse_section(grid, axis, index)}
    if field is not None:
        title = f"refined {field.factor} times (grey: far from the surface, not refined)"
        sections[title] = fine_section(field, grid, axis, index)
    return sections


def check_section(size: int) -> None:
    """Raise if panels of ``size`` pixels are too large to draw; see ``check_page``."""
    check_page(size, SECTIONS * TALLEST, columns=SECTIONS)


def find_plane(grid: SdfGrid, axis: str = "z", at: float | None = None) -> int:
    """Return the index of the plane of samples nearest to world position ``at`` on an axis.

    Without a position, the middle one of the planes that the surface crosses.

    Raises
    ------
    OptionError
        If the axis is unknown or the position outside the grid.
    """
    if axis not in AXES:
        raise OptionError(f"axis is {axis!r}: give one of {', '.join(AXES)}")
    number = AXES.index(axis)
    if at is None:
        return _middle_plane(grid, number)
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
    number = AXES.index(axis)
    values = np.take(grid.values, index, axis=number).astype(np.float64)
    across, along = _others(number)
    origin = own_origin(grid)
    first = origin[across], origin[along]
    return Section(values, first, (grid.spacing[across], grid.spacing[along]))


def fine_section(field: FineField, grid: SdfGrid, axis: str, index: int) -> Section:
    """Return the fine values on the plane of nodes that coincides with a plane of samples."""
    lattice = cubic_grid(grid)
    if field.shape != lattice.shape:
        shape = " x ".join(map(str, field.shape))
        raise OptionError(f"the field refines a grid of {shape}: give that grid")
    number = AXES.index(axis)
    origin = own_origin(lattice)
    (left, bottom), (wide, high) = (
        [at[n] for n in _others(number)] for at in (origin, lattice.spacing)
    )
    first = left - wide / 2, bottom - high / 2
    plane = round(index * grid.spacing[number] / lattice.spacing[number])
    plane = min(plane, lattice.shape[number] - 1)
    values = _node_plane(field, number, plane) * (lattice.voxel_size / 2)
    return Section(values, first, (wide / field.factor, high / field.factor))


def _middle_plane(grid: SdfGrid, number: int) -> int:
    """Return the plane nearest to the middle of all planes that the surface crosses."""
    planes = np.moveaxis(grid.values, number, 0)
    crossed = np.flatnonzero([plane.min() <= 0 < plane.max() for plane in planes])
    if not len(crossed):  # the surface passes between the samples, if there is one
        return int(np.argmin([np.abs(plane).min() for plane in planes]))
    return int(crossed[np.abs(crossed - (crossed[0] + crossed[-1]) / 2).argmin()])


def _node_plane(field: FineField, number: int, index: int) -> NDArray[np.float64]:
    """Return the values, in half voxels, on the middle nodes of a plane of voxels; else NaN."""
    factor = field.factor
    across, along = _others(number)
    in_grid = ((field.voxel_ijk >= 0) & (field.voxel_ijk < np.array(field.shape))).all(1)
    rows = np.flatnonzero(in_grid & (field.voxel_ijk[:, number] == index))
    blocks = field.blocks[:, rows].T.reshape(-1, *(factor + 1,) * 3)
    values = np.take(blocks, factor // 2, axis=number + 1)
    place = factor * field.voxel_ijk[rows, :, None] + np.arange(factor + 1)
    plane = np.full((factor * field.shape[across] + 1, factor * field.shape[along] + 1), np.nan)
    plane[place[:, across, :, None], place[:, along, None, :]] = values
    return plane


def _others(number: int) -> tuple[int, int]:
    """Return the two axes of a section's plane: to the right, and up."""
    across, along = (other for other in range(3) if other != number)
    return across, along


def _draw(sections: dict[str, Section], axis: str, voxel: float, size: int) -> Figure:
    """Draw sections side by side under their titles, with one colour bar."""
    boxes = [section.box() for section in sections.values()]
    left, right, bottom, top = boxes[0]
    tall = float(np.clip((top - bottom) / (right - left), 0.3, TALLEST))
    inches = INCHES * len(sections), INCHES * tall + STRIP
    figure = Figure(figsize=inches, dpi=size / INCHES, layout="constrained")
    plots = figure.subplots(1, len(sections), squeeze=False, sharex=True, sharey=True)[0]
    for ax, (title, section) in zip(plots, sections.items()):
        image = _draw_section(ax, section, LIMIT * voxel)
        ax.set(title=title, aspect="equal", xlim=(left, right), ylim=(bottom, top))
        ax.set_xlabel(AXES[_others(AXES.index(axis))[0]])
    plots[0].set_ylabel(AXES[_others(AXES.index(axis))[1]])
    _add_bar(figure, image, list(plots))
    return figure


def _draw_section(ax: Axes, section: Section, limit: float) -> AxesImage:
    """Draw the values of a section, and their zero line."""
    known = np.ma.masked_invalid(section.values.T)
    ax.set_facecolor(UNKNOWN)
    image = ax.imshow(
        known,
        origin="lower",
        extent=section.box(),
        interpolation="nearest",
        cmap=COLOUR_MAP,
        vmin=-limit,
        vmax=limit,
    )
    if known.count() and known.min() <= 0 < known.max():
        ax.contour(
            section.places(0), section.places(1), known, levels=[0], colors="black", linewidths=1.4
        )
    return image


def _add_bar(figure: Figure, image: AxesImage, plots: list[Any]) -> None:
    """Add a colour bar below all plots."""
    bar = figure.colorbar(
        image, ax=plots, location="bottom", extend="both", shrink=0.5, aspect=35, pad=0.03
    )
    bar.set_label(
        f"signed distance (negative inside); colours end at {LIMIT:g} voxels, black line: 0"
    )
