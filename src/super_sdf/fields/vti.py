"""Refined fields as VTK image data over the whole fine lattice, with VTK."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import numpy as np

from ..grid.sdf_grid import SdfGrid
from ..steps.field import FineField
from ..steps.lattice import fine_grid
from .dense import own_planes


class VtiWriter:
    """Gathers the fine lattice in memory and writes it as VTK image data at the end.

    The memory is filled at once, so that the plan of the work counts it.
    """

    def __init__(self, part: Path, shape: tuple[int, int, int], files: ExitStack) -> None:
        self.part = part
        self.values = np.full(shape[::-1], np.float32(np.inf))  # x is the fastest
        self.grid: SdfGrid | None = None

    def add(self, field: FineField) -> None:
        """Copy the planes of nodes of a slab."""
        self.grid = fine_grid(field)
        for first, planes in own_planes(field):
            self.values[:, :, first : first + len(planes)] = planes.transpose(2, 1, 0)

    def finish(self) -> None:
        """Write the file."""
        from vtkmodules.util.numpy_support import numpy_to_vtk
        from vtkmodules.vtkCommonDataModel import vtkImageData
        from vtkmodules.vtkCommonMisc import vtkErrorCode
        from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

        from .silence import discarded_stderr

        image = vtkImageData()
        image.SetDimensions(*self.values.shape[::-1])
        if self.grid:
            image.SetSpacing(*self.grid.spacing)
            image.SetOrigin(*self.grid.origin)
            image.SetDirectionMatrix(np.ravel(self.grid.direction).tolist())
        array = numpy_to_vtk(self.values.reshape(-1))
        array.SetName("distance")
        image.GetPointData().SetScalars(array)
        writer = vtkXMLImageDataWriter()
        writer.SetFileName(str(self.part))
        writer.SetInputData(image)
        writer.EncodeAppendedDataOff()
        writer.SetCompressorTypeToNone()
        with discarded_stderr():  # VTK's log
            written = writer.Write()
        if not written:
            reason = vtkErrorCode.GetStringFromErrorCode(writer.GetErrorCode())
            raise OSError(f"VTK says {reason!r}")
