"""MetaImage files, with SimpleITK: arrays (z, y, x) in C order; world coordinates are LPS."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import GridError
from ..volume import Request, Volume, reversed_axes
from .silence import discarded_stderr


def read_metaimage(request: Request) -> Volume:
    """Read a ``.mha`` file, or a ``.mhd`` file and the data file that it names."""
    import SimpleITK as sitk  # noqa: N813, its usual name is sitk

    reader = sitk.ImageFileReader()
    reader.SetFileName(str(request.path))
    reader.SetImageIO("MetaImageIO")
    with _quiet(sitk):
        reader.ReadImageInformation()
    size = reader.GetSize()
    if len(size) != 3 or reader.GetNumberOfComponents() != 1:
        more = f" of {reader.GetNumberOfComponents()} numbers"
        what = f"shape {size}" + more * (reader.GetNumberOfComponents() > 1)
        raise GridError(f"{request.path} has {what}: give a file of three axes (x, y, z)")
    dtype = _dtype(sitk, reader.GetPixelID())
    direction = np.reshape(reader.GetDirection(), (3, 3))
    spacing, direction = reversed_axes(reader.GetSpacing(), direction)

    def read(first: int, last: int) -> NDArray[Any]:
        reader.SetExtractIndex((0, 0, first))
        reader.SetExtractSize((size[0], size[1], last - first))
        with _quiet(sitk):
            planes: NDArray[Any] = sitk.GetArrayFromImage(reader.Execute())
        return planes

    shape, at_once = size[::-1], request.planes_at_once(size[::-1], dtype)
    if prod(shape) * dtype.itemsize > request.room:
        at_once = max(at_once // 4, 1)  # the file's, SimpleITK's and our own copy of them
    return Volume(shape, dtype, read, spacing, reader.GetOrigin(), direction, at_once)


def _dtype(sitk: Any, pixel: int) -> np.dtype[Any]:
    """Return the type of the samples."""
    return np.dtype(sitk.GetArrayViewFromImage(sitk.Image(1, 1, 1, pixel)).dtype)


@contextmanager
def _quiet(sitk: Any) -> Iterator[None]:
    """Keep ITK from printing to stderr: what matters is raised.

    Its parser of headers writes to the file descriptor itself, so that is redirected meanwhile.
    """
    shown = sitk.ProcessObject.GetGlobalWarningDisplay()
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        with discarded_stderr():
            yield
    finally:
        sitk.ProcessObject.SetGlobalWarningDisplay(shown)
