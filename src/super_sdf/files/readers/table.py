"""The readers, by the key of their format."""

from __future__ import annotations

from collections.abc import Callable

from ..volume import Request, Volume
from .hdf5 import read_hdf5
from .metaimage import read_metaimage
from .nifti import read_nifti
from .nrrd_file import read_nrrd
from .sdf import read_sdf
from .tiff import read_tiff
from .vdb import read_vdb
from .vti import read_vti
from .zarr_store import read_zarr

READERS: dict[str, Callable[[Request], Volume]] = {
    "nifti": read_nifti,
    "nrrd": read_nrrd,
    "metaimage": read_metaimage,
    "vti": read_vti,
    "tiff": read_tiff,
    "hdf5": read_hdf5,
    "zarr": read_zarr,
    "vdb": read_vdb,
    "sdf": read_sdf,
}
