"""The readers of grid files by the key of their format: each turns a Request into a Volume.

A reader says what the file says, in the world coordinates of the file, and imports its library when
it is called. It may raise anything: ``files.grids`` turns what a library raises into one line.
"""

from collections.abc import Callable

from ..volume import Request, Volume
from .hdf5 import read_hdf5, read_mat, read_netcdf
from .medical import read_analyze, read_dicom, read_mgh, read_nifti
from .nrrd_file import read_nrrd
from .raw_files import read_metaimage, read_mrc, read_sdf
from .tiff import read_tiff
from .vdb import read_vdb
from .vti import read_vti
from .vtk import read_vtk, read_vtkhdf
from .zarr_files import read_zarr

READERS: dict[str, Callable[[Request], Volume]] = {
    read.__name__.removeprefix("read_"): read
    for read in (
        *(read_nifti, read_nrrd, read_metaimage, read_vti, read_tiff, read_hdf5, read_zarr),
        *(read_vdb, read_sdf, read_mgh, read_analyze, read_mrc, read_vtk, read_vtkhdf, read_mat),
        *(read_netcdf, read_dicom),
    )
}
