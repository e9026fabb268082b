"""Optional packages: the extras that install them, and checks that they are installed."""

from __future__ import annotations

from importlib.util import find_spec

from ..errors import FileError

# Modules that each extra installs.
EXTRAS = {
    "nifti": ("nibabel",),
    "nrrd": ("nrrd",),
    "metaimage": ("SimpleITK",),
    "vti": ("vtkmodules",),
    "tiff": ("tifffile",),
    "hdf5": ("h5py",),
    "zarr": ("zarr",),
    "vdb": ("numcodecs",),
    "mrc": ("mrcfile",),
    "mat": ("h5py", "scipy"),
    "netcdf": ("h5py", "scipy"),
    "dicom": ("pydicom",),
    "3mf": ("lxml", "networkx"),
    "pyvista": ("pyvista",),
    "simplify": ("igl", "pyfqmr"),
    "eval": ("igl", "scipy"),
    "report": ("igl", "pyfqmr"),
    "cluster": ("distributed",),
}


def missing_modules(modules: tuple[str, ...]) -> list[str]:
    """Return the modules that are not installed."""
    return [name for name in modules if find_spec(name) is None]


def how_to_install(extra: str) -> str:
    """Return the command that installs an extra, from a clone of the sources."""
    return f"pip install -e '.[{extra}]' in a clone of super-sdf"


def check_modules(what: str, extra: str, modules: tuple[str, ...] | None = None) -> None:
    """Raise FileError if modules that ``what`` needs are missing, naming the extra to install.

    ``modules`` are the modules needed; by default all of the extra.
    """
    missing = missing_modules(EXTRAS[extra] if modules is None else modules)
    if missing:
        raise FileError(f"{what} needs {', '.join(missing)}: {how_to_install(extra)}")
