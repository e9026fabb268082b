"""A white page with rows of pictures of one size, each under its title, and a legend."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, MaxNLocator
from numpy.typing import NDArray

from super_sdf.errors import OptionError
from super_sdf.files.output import replacing
from super_sdf.machine.memory import check_fits

Image = NDArray[np.uint8]

COLUMNS = 4  # default number of panels in a row
# Light where the error is small, so that the shading shows the shape there.
COLOUR_MAP = "magma_r"
LARGEST_SIZE = 8000  # pixels along a panel; it is drawn at twice that, which renderers can do
LARGEST_SIDE = 60_000  # pixels along a page: matplotlib's limit is 2^16, margins included
BYTES_PER_DRAWN_PIXEL = 180  # of memory while one panel is drawn, measured
BYTES_PER_PIXEL = 24  # of the page
DPI = 72  # so that a font size in points is one in pixels


def check_page(size: int, count: int, columns: int = COLUMNS) -> None:
    """Raise if a page of ``count`` pictures of ``size`` pixels is too large to draw."""
    if not 0 < size <= LARGEST_SIZE:
        raise OptionError(f"size is {size}: give 1 to {LARGEST_SIZE} pixels")
    across = min(count, columns)
    wide, tall = across * size, -(-count // across) * size
    what = f"a picture of {wide:,} x {tall:,} pixels"
    if max(wide, tall) > LARGEST_SIDE:
        raise OptionError(f"{what} cannot be written: give fewer meshes or a smaller size")
    need = BYTES_PER_DRAWN_PIXEL * size**2 + BYTES_PER_PIXEL * wide * tall
    check_fits(need, what, "give a smaller size")


def write_picture(figure: Figure, target: Path, *, force: bool = True) -> None:
    """Write a figure as a complete PNG file; ``force`` replaces an existing one."""
    with replacing(target, force=force) as part:
        figure.savefig(part, format="png", dpi=figure.dpi)


class Page:
    """A figure of pictures, (height, width, 3) each; ``size`` is a picture's long side in pixels.

    ``foot`` is the height of the legend, in lines of text; the font size follows from ``size``.
    """

    def __init__(
        self,
        size: int,
        images: Sequence[Image],
        titles: Sequence[str],
        *,
        columns: int = COLUMNS,
        foot: float = 0.0,
    ) -> None:
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
